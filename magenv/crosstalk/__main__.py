"""Sweep the paper's system analysis and what goes beyond it: tables and figures in a folder."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from magenv.command import command_line, friendly, parse
from magenv.crosstalk.activation import is_positive
from magenv.crosstalk.plan import PARTS
from magenv.crosstalk.sweep import Engine, Task, run
from magenv.crosstalk.tasks import Row
from magenv.files import check_output_dir, write_file
from magenv.params import is_whole, require

Part = Literal["panels", "frontier", "holdable", "stability", "validity", "unlike"]


@dataclass(frozen=True)
class Options:
    """Analyse how independently two robots can be actuated: crosstalk.csv, other tables and figures in a folder."""

    n_epm: tuple[int, ...] = (2, 3)
    """Numbers of external permanent magnets; the frontier is drawn for four as well."""
    amplitude: float = 0.2
    """Amplitude of the targets, as a share of the paper's 0.5 N and 0.05 N m."""
    starts: int = 10
    """Random starts of each allocation."""
    parts: tuple[Part, ...] = ("panels", "frontier", "holdable", "stability", "validity", "unlike")
    """What to compute: the paper's panels, and beyond them the authority frontier, the holdable separation, the
    stability of the hold, the validity of the dipole model, unlike robots."""
    engine: Engine = "local"
    """Where: processes of this machine, or a Dask or Ray cluster."""
    workers: int = 2
    """Processes, where no cluster says how many."""
    out: Path = Path("runs/crosstalk")
    """Folder for the results; a run that was stopped goes on where it was."""

    def __post_init__(self) -> None:
        fits = len(self.n_epm) > 0 and all(is_whole(n) and n >= 1 for n in self.n_epm)
        require(fits, "n_epm", "whole numbers of at least 1, one at least", self.n_epm)
        require(is_positive(self.amplitude), "amplitude", "a positive, finite number", self.amplitude)
        for name in ("starts", "workers"):
            value = getattr(self, name)
            require(is_whole(value) and value >= 1, name, "a whole number of at least 1", value)
        require(len(self.parts) > 0, "parts", "one or more of " + ", ".join(PARTS), self.parts)


def as_csv(rows: Sequence[Row]) -> bytes:
    """Return rows of one table as CSV, numbers to the last digit; empty where a row lacks a column of others."""
    told = io.StringIO()
    writer = csv.DictWriter(told, list(dict.fromkeys(name for row in rows for name in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return told.getvalue().encode()


def main() -> None:
    """Compute what is wanted and not yet there; write tables and figures."""
    options = parse(Options)
    tasks: list[Task] = []
    for part in dict.fromkeys(options.parts):
        tasks += PARTS[part](sorted(set(options.n_epm)), options.amplitude, options.starts)
    require(
        len(tasks) > 0, "parts", f"such that there is something to compute for n_epm {options.n_epm}", options.parts
    )
    check_output_dir(options.out)
    tables = run(tasks, options.out / "points", engine=options.engine, workers=options.workers)
    for table, rows in tables.items():
        write_file(options.out / f"{table}.csv", as_csv(rows))
    told = asdict(options) | {"out": str(options.out), "command": command_line()}
    write_file(options.out / "settings.json", (json.dumps(told, indent=2) + "\n").encode())
    from magenv.crosstalk.figures import draw  # what plots is loaded by those who want plots

    for name, picture in draw(tables, f"{options.starts} starts"):
        write_file(options.out / f"{name}.png", picture)
        print(options.out / f"{name}.png")
    for panel, mean in means(tables.get("crosstalk", [])):
        print(f"{panel}: {mean}")


def means(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Return for each matrix its mean crosstalk in words."""
    panels: dict[str, list[Row]] = {}
    for row in rows:
        if "-epms-" in row["panel"]:
            panels.setdefault(row["panel"], []).append(row)

    def mean(some: Sequence[Row], column: str) -> float:
        return float(sum(row[column] for row in some)) / len(some)

    return [
        (
            panel,
            f"mean crosstalk {mean(some, 'crosstalk_normalised'):.1%} normalised, "
            f"{mean(some, 'crosstalk_raw'):.1%} raw; {mean(some, 'activation'):.0%} of the amplitude reached",
        )
        for panel, some in panels.items()
    ]


if __name__ == "__main__":
    friendly(main)
