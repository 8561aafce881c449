"""The report of a comparison, from records alone: summary, tables, figures, animations and the page that shows them."""

from __future__ import annotations

import csv
import io
import json
import platform
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from agents import figures
from agents.metrics import Episode, Interval, Summary, by_controller, by_scenario, measure, summarise
from agents.records import Record, save
from agents.replay import animate
from magenv.files import check_output_dir, write_file
from magenv.params import require

PAPER = {
    "approach-60": "the paper's controller (Davy et al. 2023): held, 8.7 mm, 16.7\N{DEGREE SIGN}",
    "approach-30": "the paper's controller (Davy et al. 2023): lost at 51 s, robots 33 mm apart",
}
"""What the paper reports, by scenario."""

_PACKAGES = ("magenv", "numpy", "gymnasium", "stable-baselines3", "torch", "numba")
_COLUMNS = (
    "controller",
    "success",
    "position error (mm)",
    "heading error (\N{DEGREE SIGN})",
    "error until end (mm)",
    "least separation (mm)",
    "lost at (s)",
    "apart before (mm)",
    "lost first",
    "ms per step",
)
_UNPRINTED = ("error until end (mm)", "lost first")
"""Columns that only the page has room for."""
_CAPTION = (
    "Errors: mean over the successful episodes, below it the 95 % interval. Separation "
    "and loss: medians; apart before: at the last instant at which both robots were near their references. "
    "ms: median, below it the 99th percentile."
)
_MEANING = """\
- **success**: share of the episodes in which control was kept to the end, with its 95 % Wilson interval. Control is \
lost where a robot is over 30 mm from its reference, the bodies touch, or one reaches the wall.
- **position error, heading error**: from the true state against the reference at every substep, mean over both robots \
and the successful episodes, with the 95 % bootstrap interval of the mean over episodes.
- **error until end**: the position error over all episodes, each until its end or its loss of control.
- **least separation, lost at, apart before**: medians, the last two over the lost episodes; apart before is the \
distance of the robots at the last instant at which both were within 15 mm of their references.
- **lost first**: in how many lost episodes which of these was lost for good before the robots left their references: \
*solver*, the command does not do what was asked for (of wrenches: misses them by over a tenth); *bounds*, it does \
not, and the EPMs stand at a limit; *unstable*, the EPMs stand where an error grows over 10-fold until the next \
command; *other*, none of these.
- **ms per step**: median wall time of a decision, with its 99th percentile.
- Every controller meets the same episodes: an episode is fixed by scenario, plant and seed.
- Figures: the typical episode is the one in the middle, ordered by the time of loss and then by position error; lines \
over time are medians, bands 10 to 90 % of the episodes, drawn while at least half of the episodes are under control. \
The robots can be held at rest only above the separation that a line marks; brief passes below it are possible."""


def write_summary(records: list[Record], folder: Path) -> list[Summary]:
    """Write ``summary.json``, ``episodes.csv`` and the records to ``folder``; return the rows of the summary."""
    rows = summarise(records)
    text = json.dumps({"rows": [asdict(row) for row in rows]}, indent=1, allow_nan=False)
    write_file(folder / "summary.json", (text + "\n").encode())
    write_file(folder / "episodes.csv", as_csv(asdict(measure(record)) for record in records))
    (folder / "records").mkdir(exist_ok=True)
    written = []
    for scenario, of_scenario in by_scenario(records).items():
        for controller, episodes in by_controller(of_scenario).items():
            written.append(f"{file_name(controller)}_{scenario}.npz")
            save(episodes, folder / "records" / written[-1])
    drop_others(folder / "records", ["*_*.npz"], written)
    return rows


def as_csv(episodes: Iterable[Mapping[str, object]]) -> bytes:
    """Return the fields of ``metrics.Episode`` as CSV, one row per episode."""
    table = io.StringIO()
    writer = csv.DictWriter(table, [field.name for field in fields(Episode)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(episodes)
    return table.getvalue().encode()


def drop_others(folder: Path, patterns: list[str], written: list[str]) -> None:
    """Remove what an earlier report left in the folder and this one did not write anew."""
    for path in (path for pattern in patterns for path in folder.glob(pattern)):
        if path.name not in written:
            path.unlink()


def print_table(rows: list[Summary], console: Console | None = None) -> None:
    """Print the rows for a person to read, a table per scenario, without ``_UNPRINTED``; 80 columns are enough."""
    console = console or Console()
    for scenario in dict.fromkeys(row.scenario for row in rows):
        chosen = [row for row in rows if row.scenario == scenario]
        table = Table(title=_setting(chosen), title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=0)
        table.caption, table.caption_justify = _below(chosen), "left"
        widest = max(len(row.controller) for row in chosen)
        table.add_column(_COLUMNS[0], min_width=min(max(widest, len(_COLUMNS[0])), 16), overflow="fold")
        printed = [index for index, column in enumerate(_COLUMNS[1:]) if column not in _UNPRINTED]
        for index in printed:
            table.add_column(_COLUMNS[1 + index].replace(" ", "\n"), justify="right", no_wrap=True)
        for row in chosen:
            cells = _cells(row)
            values = [Text.assemble(cells[index][0], (f"\n{cells[index][1]}", "dim")) for index in printed]
            table.add_row(Text(row.controller), *values)
        console.print(table)
    console.print(_CAPTION, style="dim")


def write_report(records: list[Record], folder: Path, command: str) -> list[Summary]:
    """Write everything that can be told of the records to ``folder``, ``report.md`` last; return the summary's rows.

    Parameters
    ----------
    records : list of Record
        Of one plant, number of EPMs and control rate; one per controller, scenario and seed.
    folder : Path
        Where to; made if missing.
    command : str
        The command line that made the records.
    """
    settings = {(record.plant, record.n_epm, record.control_hz) for record in records}
    require(len(settings) == 1, "records", "episodes of one plant, number of EPMs and control rate", sorted(settings))
    check_output_dir(folder)
    rows = write_summary(records, folder)
    written = []
    page = ["# Comparison of controllers", "", "Made by", "", "```", command, "```"]
    for scenario, of_scenario in by_scenario(records).items():
        pictures = {
            f"paths-{scenario}.png": ("Paths of both robots in the plane", figures.paths),
            f"errors-{scenario}.png": ("Errors over time", figures.errors),
            f"separation-{scenario}.png": ("Separation of the robots over time", figures.separation),
        }
        page += ["", f"## {scenario}", "", *_markdown_table([row for row in rows if row.scenario == scenario])]
        for name, (title, draw) in pictures.items():
            write_file(folder / name, figures.png(draw(of_scenario)))
            page += ["", f"![{title}]({name})"]
        write_file(folder / f"replay-{scenario}.gif", animate(of_scenario))
        page += ["", f"![One episode under several controllers](replay-{scenario}.gif)"]
        written += [*pictures, f"replay-{scenario}.gif"]
    drop_others(folder, ["paths-*.png", "errors-*.png", "separation-*.png", "replay-*.gif"], written)
    page += ["", "## What the numbers mean", "", _MEANING, "", "## Versions", ""]
    page += [", ".join(f"{name} {number}" for name, number in versions().items())]
    write_file(folder / "report.md", ("\n".join(page) + "\n").encode())
    return rows


def _setting(rows: list[Summary]) -> str:
    first, counts = rows[0], sorted({row.episodes for row in rows})
    episodes = f"{counts[0]} to {counts[-1]}" if len(counts) > 1 else f"{counts[0]}"
    return (
        f"{first.scenario}: {first.plant} plant, {first.n_epm} EPMs, {first.control_hz:g} Hz, "
        f"{episodes} episodes from seed {first.seed}"
    )


def _below(rows: list[Summary]) -> Text:
    """Return what is printed below the table of a scenario."""
    lost = [f"{row.controller} {_counts(row.lost_first)}" for row in rows if row.lost_first]
    return Text("\n".join(filter(None, [f"Lost first: {'; '.join(lost)}." if lost else "", _paper(rows[0].scenario)])))


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _paper(scenario: str) -> str:
    return f"For comparison, {PAPER[scenario]}." if scenario in PAPER else ""


def _markdown_table(rows: list[Summary]) -> list[str]:
    lines = [_setting(rows), "", "| " + " | ".join(_COLUMNS) + " |", "|---" + "|---:" * (len(_COLUMNS) - 1) + "|"]
    for row in rows:
        values = [f"{value} ({detail})" if detail else value for value, detail in _cells(row)]
        lines.append("| " + " | ".join([row.controller, *values]) + " |")
    return [*lines, "", _paper(rows[0].scenario)]


def _cells(row: Summary) -> list[tuple[str, str]]:
    """Return the row's values and their details, in the order of the columns after the first."""
    low, high = row.success_rate_ci
    return [
        (f"{100 * row.success_rate:.0f} %", f"{100 * low:.0f}\N{EN DASH}{100 * high:.0f}"),
        _estimate(row.position_error_mm, row.position_error_mm_ci),
        _estimate(row.heading_error_deg, row.heading_error_deg_ci),
        _estimate(row.position_error_until_end_mm, row.position_error_until_end_mm_ci),
        _median(row.min_separation_mm),
        _median(row.loss_of_control_s),
        _median(row.separation_before_loss_mm),
        (_counts(row.lost_first) or "-", ""),
        (f"{row.control_step_ms_p50:.1f}", f"{row.control_step_ms_p99:.1f}"),
    ]


def _estimate(value: float | None, interval: Interval | None) -> tuple[str, str]:
    """Return three significant digits and the interval; a dash where there is nothing."""
    if value is None or interval is None:
        return "-", ""
    return three_digits(value), f"{three_digits(interval[0])}\N{EN DASH}{three_digits(interval[1])}"


def three_digits(value: float) -> str:
    """Return a number to three significant digits."""
    return f"{value:#.3g}".rstrip(".")


def _median(value: float | None) -> tuple[str, str]:
    return "-" if value is None else f"{value:.1f}", ""


def file_name(controller: str) -> str:
    """Return the part of file names that stands for a controller."""
    return re.sub(r"[^\w.-]+", "-", controller)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on."""
    return {"Python": platform.python_version()} | {name: _version(name) for name in _PACKAGES}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
