"""Figure and tables of climbs down the ladder, from their files alone: ``python -m agents.ladder_figures --help``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator
from matplotlib.transforms import ScaledTranslation
from tyro.conf import Positional

from agents.figures import DPI, HOLDABLE_MM, colour_of, png
from agents.ladder import APART, LADDER_MM, SURVIVED_RATE, TABLE, Rung, finished, load, survivable
from magenv.command import friendly, parse
from magenv.files import check_output_dir, write_file
from magenv.params import plant_named, require

_STYLES = (("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"))
"""Line and mark of each control rate."""
_INK, _LIMIT, _TOUCH = "#222222", "#777777", "#CCCCCC"
_RANGE_MM = (64.0, 10.2)
_STEP_PT = 1.8
"""By how much lines are drawn above each other, so that all are seen where they are equal."""

_NOT_SURVIVED = (
    f"not survived: success under {100 * SURVIVED_RATE:g} %, or robots over {APART:g} times as far apart as asked, "
    "here or on a wider rung"
)

Climb = list[Rung]
"""Rungs of one controller at one control rate, from the top."""


def by_panel(rungs: Sequence[Rung]) -> list[list[Climb]]:
    """Return the climbs of each plant, number of EPMs and kind of headings, in order of appearance.

    Raises
    ------
    ValueError
        If there are none, or a rung is there twice.
    """
    require(len(rungs) > 0, "ladders", "such that they have one rung at least", "none")
    panels: dict[str, dict[str, Climb]] = {}
    for rung in rungs:
        climb = panels.setdefault(_setting(rung), {}).setdefault(_name(rung), [])
        once = all(other.separation_mm != rung.separation_mm for other in climb)
        require(once, "ladders", "of different controllers or settings", f"{_name(rung)} on {_setting(rung)} twice")
        climb.append(rung)
    return [list(climbs.values()) for climbs in panels.values()]


def _name(rung: Rung) -> str:
    return f"{rung.controller}, {rung.control_hz:g} Hz"


def _setting(rung: Rung) -> str:
    return f"{rung.plant} plant, {rung.n_epm} EPMs, {'opposite' if rung.anti else 'parallel'} headings"


def reached(climb: Climb) -> str:
    """Return in words how far down a climb was survived."""
    lowest = survivable(climb)
    if lowest is None:
        return f"not even {climb[0].separation_mm:g} mm"
    return f"down to {lowest:g} mm" if finished(climb) else f"{lowest:g} mm so far"


def draw(rungs: Sequence[Rung]) -> Figure:
    """Draw success over separation: a panel per plant, number of EPMs and headings, a line per controller and rate."""
    panels = by_panel(rungs)
    names = list(dict.fromkeys(rung.controller for rung in rungs))
    rates = sorted({rung.control_hz for rung in rungs})
    figure = Figure(figsize=(11.5, 1.5 + 3.2 * len(panels)), dpi=DPI, layout="constrained")
    for axes, climbs in zip(figure.subplots(len(panels), squeeze=False).flat, panels, strict=True):
        _limits(axes, climbs[0][0])
        for index, climb in enumerate(climbs):
            style = _STYLES[rates.index(climb[0].control_hz) % len(_STYLES)]
            _line(axes, climb, colour_of(climb[0].controller, names), style, _STEP_PT * (index - (len(climbs) - 1) / 2))
        legend = axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=10, handlelength=3)
        legend.set_title(_setting(climbs[0][0]).replace("EPMs, ", "EPMs,\n"), {"size": 10, "weight": "bold"})
        legend.set_alignment("left")
    figure.axes[-1].set_xlabel("separation to which the references come (mm)", fontsize=11)
    figure.suptitle("How close two robots come under control", fontsize=14)
    meaning = [
        Line2D([], [], color=_INK, marker="o", linewidth=2.4, label="survived"),
        Line2D([], [], color=_INK, marker="o", linewidth=1.0, markerfacecolor="white", label=_NOT_SURVIVED),
        Patch(color=_INK, alpha=0.15, linewidth=0, label="95 % interval"),
    ]
    figure.legend(handles=meaning, loc="outside lower left", ncols=3, frameon=False, fontsize=9)
    return figure


def _limits(axes: Axes, rung: Rung) -> None:
    """Give a panel its axes, and what separations mean on the plant of this rung."""
    touch_mm = 1e3 * plant_named(rung.plant).body.diameter_m
    limit_mm = HOLDABLE_MM["antiparallel" if rung.anti else "parallel"]
    axes.set_xscale("log")
    axes.set_xlim(*_RANGE_MM)
    axes.set_xticks(LADDER_MM, [f"{separation_mm:g}" for separation_mm in LADDER_MM], fontsize=9)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_ylim(-6.0, 106.0)
    axes.set_ylabel("success (%)", fontsize=11)
    axes.grid(color="#E5E5E5", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.axvspan(touch_mm, _RANGE_MM[1], color=_TOUCH, linewidth=0)
    axes.axvline(limit_mm, color=_LIMIT, linestyle="-.", linewidth=1.4, zorder=1)
    across = axes.get_xaxis_transform()
    axes.text(limit_mm, 1.02, f"holdable at rest: {limit_mm:g} mm", transform=across, ha="center", fontsize=9.5)
    middle_mm = math.sqrt(touch_mm * _RANGE_MM[1])
    axes.text(middle_mm, 0.5, "bodies touch", transform=across, ha="center", va="center", rotation=90, fontsize=9.5)


def _line(axes: Axes, climb: Climb, colour: str, style: tuple[str, str], up_pt: float) -> None:
    """Draw one line, bold and its marks filled as far as survived, and the 95 % intervals as a band about it."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    shifted = axes.transData + ScaledTranslation(0.0, up_pt / 72, figure.dpi_scale_trans)
    dashes, mark = style
    label = f"{_name(climb[0])}: {reached(climb)}"
    separation_mm = np.array([rung.separation_mm for rung in climb])
    success = np.array([100 * rung.success_rate for rung in climb])
    survived = np.array([rung.survived for rung in climb])
    low, high = 100 * np.transpose([rung.success_rate_ci for rung in climb])
    axes.fill_between(separation_mm, low, high, color=colour, alpha=0.09, linewidth=0)
    axes.plot(separation_mm, success, dashes, color=colour, linewidth=1.0, transform=shifted)
    axes.plot(separation_mm[survived], success[survived], dashes, color=colour, linewidth=2.4, transform=shifted)
    for some, face in ((survived, colour), (~survived, "white")):
        xy = (separation_mm[some], success[some])
        axes.plot(*xy, mark, color=colour, markerfacecolor=face, markersize=6, transform=shifted, zorder=3)
    axes.plot([], [], dashes, marker=mark, color=colour, linewidth=2.4, markersize=6, label=label)


def tables(rungs: Sequence[Rung]) -> str:
    """Return Markdown tables, one per panel: success and position error on each rung, a column per line drawn."""
    panels = [_table(climbs) for climbs in by_panel(rungs)]
    return "\n\n".join([*panels, _NOT_SURVIVED[0].upper() + _NOT_SURVIVED[1:] + "."])


def _table(climbs: list[Climb]) -> str:
    head = ["separation (mm)", *(_name(climb[0]) for climb in climbs)]
    rows = []
    for separation_mm in sorted({rung.separation_mm for climb in climbs for rung in climb}, reverse=True):
        of_row = [next((rung for rung in climb if rung.separation_mm == separation_mm), None) for climb in climbs]
        rows.append([f"{separation_mm:g}", *("" if rung is None else _cell(rung) for rung in of_row)])
    rows.append(["survived", *(reached(climb) for climb in climbs)])
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    title = f"{_setting(climbs[0][0])}; success and mean position error of the successful episodes"
    return "\n".join([title, "", lines[0], "|---:" * len(head) + "|", *lines[1:]])


def _cell(rung: Rung) -> str:
    error = "-" if rung.position_error_mm is None else f"{rung.position_error_mm:.2f} mm"
    return f"{100 * rung.success_rate:.0f} % / {error}"


@dataclass(frozen=True)
class FiguresConfig:
    """Draw climbs of evaluate.py --ladder in one figure, a panel per plant, and print their tables."""

    folders: Positional[tuple[Path, ...]]
    """Folders with ladder.json."""
    out: Path = Path("ladder.png")
    """The figure."""


def main() -> None:
    """Read, draw, print."""
    config = parse(FiguresConfig)
    require(len(config.folders) > 0, "folders", "one or more with ladder.json", list(map(str, config.folders)))
    rungs = [rung for folder in config.folders for rung in load(folder / TABLE.file)[1]]
    picture = png(draw(rungs))
    check_output_dir(config.out.parent)
    write_file(config.out, picture)
    print(tables(rungs))


if __name__ == "__main__":
    friendly(main)
