"""Figures of the study: how errors are distributed, how trainings go."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from agents.figures import DPI, colour_of
from agents.statistics import bounds, share_above
from agents.study.entries import Curve
from agents.study.evidence import Measured, OfEpisodes, mean_kept, success_rate

Floats = NDArray[np.float64]

_COLOURS = ("#0072B2", "#56B4E9", "#CC79A7", "#999933", "#8C510A", "#7B3294", "#666666", "#117733")
"""Of agents, in their order; those of controllers are others."""
_INK, _GRID = "#222222", "#E5E5E5"
_POINTS = 150
_WIDTH = 0.8
"""Of a scenario's marks."""
_COLUMNS = 4
_LABELS = {"position_error_mm": "position error (mm)", "heading_error_deg": "heading error (degrees)"}
_BAND = 0.14
"""Opacity of bands."""
_UPWARDS, _ALONG = (1.0, 2.0, 5.0), (1.0, 3.0)
"""Numbers of a decade: upwards there is room for more."""
_LETTERS = 165
"""Of a legend's line."""


def style(one: Measured, measured: Sequence[Measured]) -> dict[str, object]:
    """Return colour and dashes of a line: agents are solid, controllers dashed."""
    agents = [other.label for other in measured if other.training is not None]
    if one.training is None:
        return {"color": colour_of(one.name, [other.name for other in measured]), "linestyle": (0, (4, 1.5))}
    return {"color": _COLOURS[agents.index(one.label) % len(_COLOURS)], "linestyle": "-"}


def overview(measured: Sequence[Measured], scenarios: Sequence[str]) -> Figure:
    """Draw success and errors on each scenario: per agent or controller the median of its seeds, and each seed."""
    figure = _figure(11.5, 8.2)
    rows: list[tuple[str, OfEpisodes]] = [
        ("success (%)", lambda outcomes: 100 * success_rate(outcomes)),
        *((label, mean_kept(column)) for column, label in _LABELS.items()),
    ]
    panels = figure.subplots(len(rows), 1, sharex=True)
    for axes, (title, of_episodes) in zip(panels, rows, strict=True):
        for index, one in enumerate(measured):
            beside = _WIDTH * ((index + 0.5) / len(measured) - 0.5)
            colour, mark = str(style(one, measured)["color"]), "D" if one.training is None else "o"
            for place, scenario in enumerate(scenarios):
                values = one.per_seed(scenario, of_episodes) if one.measured_on([scenario]) else np.zeros(0)
                values = values[~np.isnan(values)]
                at = np.full(len(values), place + beside)
                axes.plot(at, values, mark, color=colour, markersize=4, alpha=0.5, markeredgewidth=0)
                if len(values):
                    axes.plot(at[:1], [np.median(values)], mark, color=colour, markersize=8, markeredgewidth=0)
        if title != rows[0][0] and any(len(line.get_xdata()) > 0 for line in axes.lines):  # else all were lost
            axes.set_yscale("log")
            _plain_numbers(axes.yaxis, _UPWARDS)
        for border in range(1, len(scenarios)):
            axes.axvline(border - 0.5, color=_GRID, linewidth=1.0)
        axes.set_ylabel(title, fontsize=11)
        axes.grid(axis="y", color=_GRID, linewidth=0.6)
        axes.set_axisbelow(True)
    panels[0].set_ylim(-5.0, 105.0)
    panels[-1].set_xlim(-0.5, len(scenarios) - 0.5)
    panels[-1].set_xticks(range(len(scenarios)), scenarios, fontsize=10)
    figure.suptitle("Success, and mean errors of the episodes that were held: medians over the seeds", fontsize=13)
    handles = [
        Line2D(
            [],
            [],
            linestyle="",
            marker="D" if one.training is None else "o",
            markersize=8,
            color=str(style(one, measured)["color"]),
            label=_name(one),
        )
        for one in measured
    ]
    if any(len(one.made) > 1 for one in measured):
        handles.append(Line2D([], [], linestyle="", marker="o", markersize=4, alpha=0.5, color=_INK, label="each seed"))
    _legend_below(figure, handles)
    return figure


def _name(one: Measured) -> str:
    """Return what legends say."""
    several = "s" if len(one.made) > 1 else ""
    return f"{one.label}, {len(one.made)} seed{several}" if one.made else one.label


def profiles(measured: Sequence[Measured], scenarios: Sequence[str]) -> Figure:
    """Draw over all scenarios the share of episodes with an error below a threshold; lost episodes are below none."""
    figure = _figure(11.5, 5.0)
    chosen = [one for one in measured if one.measured_on(scenarios)]
    for axes, column in zip(figure.subplots(1, 2), _LABELS, strict=True):
        thresholds = _thresholds([one.errors(scenarios, column) for one in chosen])
        for one in chosen:
            _profile(axes, one.errors(scenarios, column), thresholds, style(one, measured))
        _profile_axes(axes, thresholds)
        axes.set_xlabel(f"{_LABELS[column]}: threshold", fontsize=11)
        axes.set_ylabel("held, with an error below the threshold (%)", fontsize=10)
    figure.suptitle(
        f"How exact: episodes of all {len(scenarios)} scenarios. Higher and further left is better", fontsize=13
    )
    _legend(figure, chosen, measured, "95 % interval over the seeds")
    return figure


def profiles_by_scenario(measured: Sequence[Measured], scenarios: Sequence[str]) -> Figure:
    """Draw the same of the position error, a panel per scenario."""
    rows = -(-len(scenarios) // _COLUMNS)
    figure = _figure(11.5, 1.2 + 2.6 * rows)
    panels = list(figure.subplots(rows, _COLUMNS, squeeze=False, sharex=True, sharey=True).flat)
    errors = {
        (one.label, scenario): one.errors([scenario], "position_error_mm")
        for one in measured
        for scenario in scenarios
        if one.measured_on([scenario])
    }
    thresholds = _thresholds(list(errors.values()))
    for index, (axes, scenario) in enumerate(zip(panels, scenarios, strict=False)):
        for one in measured:
            if (one.label, scenario) in errors:
                _profile(axes, errors[one.label, scenario], thresholds, style(one, measured))
        _profile_axes(axes, thresholds)
        axes.set_title(scenario, fontsize=11)
        axes.set_xlabel("position error (mm): threshold", fontsize=9)
        axes.tick_params(labelsize=8, labelbottom=True)
        if index % _COLUMNS == 0:
            axes.set_ylabel("held, with an error\nbelow the threshold (%)", fontsize=9)
    for axes in panels[len(scenarios) :]:
        axes.set_axis_off()
    figure.suptitle("How exact on each scenario. Higher and further left is better", fontsize=13)
    _legend(figure, measured, measured, "95 % interval over the seeds")
    return figure


def _thresholds(errors: Sequence[Floats]) -> Floats:
    """Return thresholds over the range of all finite errors."""
    finite = np.concatenate([np.zeros(0), *(each[np.isfinite(each) & (each > 0.0)] for each in errors)])
    low, high = (0.8 * finite.min(), 1.25 * finite.max()) if len(finite) else (0.1, 10.0)
    return np.geomspace(low, high, _POINTS)


def _profile(axes: Axes, errors: Floats, thresholds: Floats, line: dict[str, object]) -> None:
    """Draw one line from errors (seeds, episodes), and the interval over the seeds as a band about it."""
    per_seed = share_above(-errors[:, None], -thresholds)
    axes.plot(thresholds, 100 * per_seed.mean(axis=0), linewidth=2.2, **line)  # type: ignore[arg-type]
    if len(per_seed) > 1:
        low, high = 100 * bounds(lambda resampled: resampled.mean(axis=-2), per_seed, whole_runs=True)
        axes.fill_between(thresholds, low, high, color=str(line["color"]), alpha=_BAND, linewidth=0)


def _profile_axes(axes: Axes, thresholds: Floats) -> None:
    axes.set_xscale("log")
    axes.set_xlim(thresholds[0], thresholds[-1])
    _plain_numbers(axes.xaxis, _ALONG)
    axes.set_ylim(-3.0, 103.0)
    _grid(axes)


def curves(measured: Sequence[Measured], group: str) -> Figure:
    """Draw how trainings go, over steps and over wall-clock time: medians over the seeds, bands from least to most."""
    figure = _figure(11.5, 8.2)
    rows: list[tuple[str, Callable[[Curve], Sequence[float]]]] = [
        ("success (%)", lambda curve: [100 * rate for rate in curve.success_rate]),
        (_LABELS["position_error_mm"], lambda curve: curve.position_error_mm),
        (_LABELS["heading_error_deg"], lambda curve: curve.heading_error_deg),
    ]
    columns: list[tuple[str, Callable[[Curve], Sequence[float]]]] = [
        ("environment steps (thousands)", lambda curve: [step / 1e3 for step in curve.steps]),
        ("training time on the wall clock (minutes)", lambda curve: [second / 60 for second in curve.seconds]),
    ]
    panels = figure.subplots(3, 2, sharex="col", sharey="row")
    for row, (title, values) in zip(panels, rows, strict=True):
        row[0].set_ylabel(title, fontsize=11)
        for axes, (_, along) in zip(row, columns, strict=True):
            for one in measured:
                _curve(axes, [(along(made.curve), values(made.curve)) for made in one.made], style(one, measured))
            axes.set_xscale("log")
            _plain_numbers(axes.xaxis, _ALONG)
            if title != rows[0][0]:
                axes.set_yscale("log")
                _plain_numbers(axes.yaxis, _UPWARDS)
            _grid(axes)
    panels[0, 0].set_ylim(-3.0, 103.0)
    for axes, (title, _) in zip(panels[-1], columns, strict=True):
        axes.set_xlabel(title, fontsize=11)
    figure.suptitle(f"How trainings go ({group}): means over the last 200 episodes of training", fontsize=13)
    _legend(figure, measured, measured, "from the least to the greatest of the seeds")
    return figure


def _curve(axes: Axes, series: Sequence[tuple[Sequence[float], Sequence[float]]], line: dict[str, object]) -> None:
    """Draw median and range of several seeds where all of them have begun and none has ended."""
    begun = [next((one for one in at if one > 0.0), math.inf) for at, _ in series]  # quick ones begin after no seconds
    begin, end = max(begun), min(at[-1] for at, _ in series)
    if not begin < end:
        return
    grid = np.geomspace(begin, end, _POINTS)
    values = np.array([np.interp(grid, at, value) for at, value in series])
    axes.plot(grid, np.median(values, axis=0), linewidth=2.0, **line)  # type: ignore[arg-type]
    axes.fill_between(grid, values.min(axis=0), values.max(axis=0), color=str(line["color"]), alpha=_BAND, linewidth=0)


def _plain_numbers(axis: Axis, per_decade: tuple[float, ...]) -> None:
    """Write no powers of ten on a logarithmic axis, and more than one number a decade."""
    axis.set_major_locator(LogLocator(subs=per_decade))
    low, high = axis.get_view_interval()
    if sum(low <= at <= high for at in axis.get_majorticklocs()) < 2:  # of a short axis
        axis.set_major_locator(LogLocator(subs=tuple(range(1, 10))))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.6g}"))
    axis.set_minor_formatter(NullFormatter())


def _grid(axes: Axes) -> None:
    axes.grid(color=_GRID, linewidth=0.6)
    axes.set_axisbelow(True)


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def _legend(figure: Figure, chosen: Sequence[Measured], measured: Sequence[Measured], band: str) -> None:
    handles: list[Line2D | Patch] = [
        Line2D([], [], linewidth=2.2, label=_name(one), **style(one, measured))  # type: ignore[arg-type]
        for one in chosen
    ]
    if any(len(one.made) > 1 for one in chosen):
        handles.append(Patch(color=_INK, alpha=_BAND, linewidth=0, label=band))
    _legend_below(figure, handles)


def _legend_below(figure: Figure, handles: Sequence[Line2D | Patch]) -> None:
    """Draw a legend below all panels, in as many columns as find room."""
    longest = max(len(str(handle.get_label())) for handle in handles) + 6
    columns = max(1, min(4, len(handles), _LETTERS // longest))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=10)
