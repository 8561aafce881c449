"""Results as rows, and rows as text."""

from __future__ import annotations

import math
from dataclasses import dataclass

_PREFIXES = {-3: "n", -2: "µ", -1: "m", 0: "", 1: "k", 2: "M", 3: "G"}
_SI = ("s", "B", "steps/s", "pairs/s", "flop/s")
HEAD = ("what", "ours", "peer", "peer's", "ratio", "wanted", "met", "note")


def text(value: float, unit: str) -> str:
    """Return a number with its unit: three digits and a prefix where the unit takes one."""
    if unit not in _SI or value == 0 or not math.isfinite(value):
        return f"{value:.3g} {unit}"
    power = min(max(math.floor(math.log10(abs(float(f"{value:.3g}"))) / 3), -3), 3)
    digits = f"{value / 1000.0**power:.3g}"
    between = " " if "/" in unit and power else ""
    return f"{digits} {_PREFIXES[power]}{between}{unit}"


@dataclass(frozen=True)
class Limit:
    """What is wanted: of the ratio where the unit is "x", else of our own figure."""

    value: float
    unit: str = "x"
    at_least: bool = True

    def __str__(self) -> str:
        return f"{'≥' if self.at_least else '≤'} {text(self.value, self.unit)}"


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    what: str
    ours: float
    unit: str
    peer: str = ""
    theirs: float = math.nan
    ratio: float = math.nan
    """How many times better than the peer."""
    wanted: Limit | None = None
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether what is wanted is reached; None where nothing is wanted."""
        if self.wanted is None:
            return None
        value = self.ratio if self.wanted.unit == "x" else self.ours
        return value >= self.wanted.value if self.wanted.at_least else value <= self.wanted.value

    def cells(self) -> tuple[str, ...]:
        """Return the texts under ``HEAD``."""
        return (
            self.what,
            text(self.ours, self.unit),
            self.peer,
            "" if math.isnan(self.theirs) else text(self.theirs, self.unit),
            "" if math.isnan(self.ratio) else text(self.ratio, "x"),
            "" if self.wanted is None else str(self.wanted),
            {True: "yes", False: "**no**", None: ""}[self.met],
            self.note,
        )


@dataclass(frozen=True)
class LeftOut:
    """A line that could not be measured."""

    what: str
    why: str

    def __str__(self) -> str:
        return f"left out: {self.what} ({self.why})"


Line = Row | LeftOut


def console(row: Row) -> str:
    """Return a row in one line of plain text."""
    cells = dict(zip(HEAD, row.cells(), strict=True))
    parts = [f"{cells['what']}: {cells['ours']}"]
    if cells["peer"]:
        parts.append(f"{cells['peer']} {cells[HEAD[3]]}".strip())
    if cells["ratio"]:
        parts.append(cells["ratio"])
    if cells["wanted"]:
        parts.append(f"wanted {cells['wanted']}: {cells['met'].strip('*')}")
    return ", ".join(parts) + (f" [{cells['note']}]" if cells["note"] else "")


def markdown(rows: list[Row]) -> str:
    """Return the rows as a table, without the columns that are empty throughout."""
    cells = [row.cells() for row in rows]
    used = [i for i in range(len(HEAD)) if any(line[i] for line in cells)]
    lines = [HEAD, tuple("---" for _ in HEAD), *cells]
    return "\n".join("| " + " | ".join(line[i].replace("|", "\\|") for i in used) + " |" for line in lines)


def page(head: str, parts: dict[str, list[Line]]) -> str:
    """Return the whole page: the head, then a section per part."""
    sections = [head]
    for title, lines in parts.items():
        rows = [line for line in lines if isinstance(line, Row)]
        told = [markdown(rows)] if rows else []
        told += [f"* {line}" for line in lines if isinstance(line, LeftOut)]
        sections.append(f"## {title}\n\n" + "\n".join(told[:1]) + "".join(f"\n\n{line}" for line in told[1:]))
    judged = [line.met for lines in parts.values() for line in lines if isinstance(line, Row) and line.met is not None]
    sections.insert(1, f"Wanted and met: {sum(judged)} of {len(judged)}.")
    return "\n\n".join(sections) + "\n"
