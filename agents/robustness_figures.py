"""Figure and table of the robustness sweep, from its rows alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import ScaledTranslation
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from agents.figures import DPI, colour_of
from agents.robustness import BASE, CRITERIA, Criterion, Row, Score, Sweep, scores

_INK, _GRID = "#222222", "#E5E5E5"
_COLUMNS = 3
_STEP_PT = 1.8
"""By how much lines are drawn above each other, so that all are seen where they are equal."""
_CAPTION = (
    "Success in per cent, of a criterion the mean over its values; overall: the mean of the criteria. base: on the "
    "plant for which the controllers are made, no part of the score."
)


def draw(rows: Sequence[Row], sweep: Sweep, scenario: str) -> Figure:
    """Draw success over value on one scenario, a panel per criterion, a line per controller; last, the scores."""
    chosen = [row for row in rows if row.scenario == scenario]
    names = list(dict.fromkeys(row.controller for row in chosen))
    figure = Figure(figsize=(11.5, 7.6), dpi=DPI, layout="constrained")
    panels = list(figure.subplots(2, _COLUMNS).flat)
    for axes, criterion in zip(panels, CRITERIA, strict=False):
        values = [value for name, value, _ in sweep.points() if name == criterion.name and value is not None]
        _panel(axes, criterion, values)
        for index, name in enumerate(names):
            of_line = [row for row in chosen if row.controller == name and row.criterion in (BASE, criterion.name)]
            _line(axes, of_line, [None, *values], colour_of(name, names), _STEP_PT * (index - (len(names) - 1) / 2))
    for axes in panels[::_COLUMNS]:
        axes.set_ylabel("success (%)", fontsize=11)
    _bars(panels[len(CRITERIA)], scores(chosen, sweep), names)
    figure.suptitle(
        f"Robustness on {scenario}: {sweep.plant} plant, {sweep.n_epm} EPMs, {sweep.control_hz:g} Hz", fontsize=14
    )
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=colour_of(name, names), marker="o", linewidth=2.2, label=name) for name in names
    ]
    handles.append(Patch(color=_INK, alpha=0.15, linewidth=0, label="95 % interval"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=10)
    return figure


def _panel(axes: Axes, criterion: Criterion, values: Sequence[float]) -> None:
    """Give a panel its axes: the plant as it is, then the values from good to bad."""
    axes.set_title(criterion.name, fontsize=12)
    axes.set_xticks(range(len(values) + 1), [BASE, *(f"{value:g}" for value in values)])
    axes.set_xlabel(criterion.unit, fontsize=10)
    axes.set_ylim(-6.0, 106.0)
    axes.grid(color=_GRID, linewidth=0.6)
    axes.set_axisbelow(True)


def _line(axes: Axes, rows: Sequence[Row], values: Sequence[float | None], colour: str, up_pt: float) -> None:
    """Draw one line, and the 95 % intervals as a band about it."""
    if not rows:
        return
    figure = axes.get_figure(root=True)
    assert figure is not None
    shifted = axes.transData + ScaledTranslation(0.0, up_pt / 72, figure.dpi_scale_trans)
    at = [values.index(row.value) for row in rows]
    low, high = 100 * np.transpose([row.success_rate_ci for row in rows])
    axes.fill_between(at, low, high, color=colour, alpha=0.09, linewidth=0)
    success = [100 * row.success_rate for row in rows]
    axes.plot(at, success, "-o", color=colour, linewidth=2.2, markersize=6, transform=shifted)


def _bars(axes: Axes, found: Sequence[Score], names: list[str]) -> None:
    """Draw the overall scores; of a sweep broken off, those that are whole."""
    axes.set_title("overall score", fontsize=12)
    whole = [(score.controller, score.overall) for score in found if score.overall is not None]
    for place, (name, overall) in enumerate(whole):
        axes.barh(place, overall, color=colour_of(name, names), height=0.6)
        axes.text(overall + 1.5, place, f"{overall:.0f}", va="center", fontsize=10)
    axes.set_yticks(range(len(whole)), [name for name, _ in whole])
    axes.set_ylim(max(len(whole), 4) - 0.5, -0.5)
    axes.set_xlim(0.0, 112.0)
    axes.set_xlabel("%", fontsize=10)
    axes.grid(axis="x", color=_GRID, linewidth=0.6)
    axes.set_axisbelow(True)


def print_scores(found: Sequence[Score], sweep: Sweep, console: Console | None = None) -> None:
    """Print the scores for a person to read, a table per scenario; 80 columns are enough."""
    console = console or Console()
    for scenario in dict.fromkeys(score.scenario for score in found):
        title = (
            f"{scenario}: {sweep.plant} plant, {sweep.n_epm} EPMs, {sweep.control_hz:g} Hz, {sweep.episodes} episodes "
            f"from seed {sweep.seed} per value"
        )
        table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=0)
        table.add_column("controller", max_width=17, overflow="fold")
        for name in (BASE, *(criterion.name for criterion in CRITERIA), "overall"):
            table.add_column(name, justify="right", no_wrap=True)
        for score in found:
            if score.scenario == scenario:
                values = [score.base, *score.criteria.values(), score.overall]
                table.add_row(Text(score.controller), *("-" if v is None else f"{v:.0f}" for v in values))
        console.print(table)
    console.print(_CAPTION, style="dim")
