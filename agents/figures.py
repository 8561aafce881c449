"""Figures of one scenario, from records alone: paths in the plane, errors over time, separation over time."""

from __future__ import annotations

import io
import math
from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator
from numpy.typing import NDArray

from agents.metrics import by_controller, typical
from agents.records import Record
from magenv.params import plant_named

Floats = NDArray[np.float64]

# Okabe and Ito's palette, told apart by colour-blind eyes as well; a controller keeps its colour in every picture.
_COLOURS = {
    "baseline": "#D55E00",
    "tuned": "#E69F00",
    "predictive": "#009E73",
    "predictive-robust": "#004D38",
    "ppo": "#0072B2",
    "sac": "#56B4E9",
    "random": "#999999",
    "idle": "#CC79A7",
}
_OTHER_COLOURS = ("#000000", "#8C510A", "#7B3294", "#999933", "#CC6677", "#44AA99", "#555555")
_INK = "#222222"
_BAND = (10.0, 90.0)
HOLDABLE_MM = {"parallel": 19.0, "antiparallel": 12.8}
"""Least separation at which robots side by side can be held still, by their headings."""

DPI = 110
_ARROWS = 13


def colour_of(controller: str, controllers: list[str]) -> str:
    """Return the controller's own colour; those without one take turns in the order of ``controllers``."""
    if controller in _COLOURS:
        return _COLOURS[controller]
    others = [name for name in controllers if name not in _COLOURS]
    return _OTHER_COLOURS[others.index(controller) % len(_OTHER_COLOURS)]


def outcome(records: list[Record]) -> str:
    """Return in words how the episodes ended."""
    lost = [record.loss_time_s for record in records if record.loss_time_s is not None]
    if not lost:
        return f"held in all {len(records)}" if len(records) > 1 else "held"
    when = f"at {np.median(lost):.3g} s" if len(lost) == 1 else f"at {np.median(lost):.3g} s (median)"
    return f"lost in {len(lost)} of {len(records)}, {when}" if len(records) > 1 else f"lost {when}"


def png(figure: Figure) -> bytes:
    """Return the figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def paths(records: list[Record]) -> Figure:
    """Draw the paths of both robots on one scenario, a panel per controller, the typical episode bold."""
    groups = by_controller(records)
    columns = min(3, len(groups)) if len(groups) != 4 else 2
    rows = math.ceil(len(groups) / columns)
    figure = _figure(0.6 + 4.2 * columns, 1.0 + 4.3 * rows)
    wall_mm = 1e3 * plant_named(records[0].plant).workspace_radius_m
    for index, (name, episodes) in enumerate(groups.items()):
        axes = figure.add_subplot(rows, columns, index + 1)
        colour = colour_of(name, list(groups))
        chosen = typical(episodes)
        axes.add_patch(Circle((0, 0), wall_mm, fill=False, color=_INK, linewidth=1.2))
        for episode in episodes:
            _path(axes, episode, colour, bold=False)
        for robot in range(2):
            axes.plot(*(1e3 * chosen.reference[:, robot, :2].T), color=_INK, linestyle=(0, (4, 3)), linewidth=1.1)
        _path(axes, chosen, colour, bold=True)
        axes.set_title(f"{name}\n{outcome(episodes)}", fontsize=10, color=_INK)
        axes.set_aspect("equal")
        axes.set_xlim(-1.05 * wall_mm, 1.05 * wall_mm)
        axes.set_ylim(-1.05 * wall_mm, 1.05 * wall_mm)
        axes.set_xlabel("x (mm)")
        if index % columns == 0:
            axes.set_ylabel("y (mm)")
    narrow = columns == 1
    between = "\n" if narrow else " "
    figure.suptitle(f"{_title(records)}:{between}paths of both robots", fontsize=12)
    handles = [
        Line2D([], [], color=_INK, linestyle=(0, (4, 3)), linewidth=1.1, label="reference"),
        Line2D([], [], color="#555555", linewidth=2.0, label="typical episode, with headings"),
        Line2D([], [], color="#555555", linewidth=0.8, alpha=0.4, label="other episodes"),
        Line2D([], [], color=_INK, marker="x", markersize=8, markeredgewidth=2, linestyle="", label="control lost"),
        Line2D([], [], color=_INK, linewidth=1.2, label="wall"),
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=2 if narrow else 2 + columns, frameon=False, fontsize=9
    )
    return figure


def _path(axes: Axes, record: Record, colour: str, bold: bool) -> None:
    for robot in range(2):
        x, y = 1e3 * record.robots[:, robot, 0], 1e3 * record.robots[:, robot, 1]
        axes.plot(x, y, color=colour, linewidth=2.0 if bold else 0.7, alpha=1.0 if bold else 0.3)
        if bold:
            start = 1e3 * record.reference[0, robot, :2]
            at_x, at_y = start + 9.0 * np.sign(start)
            axes.text(at_x, at_y, str(robot + 1), color=_INK, ha="center", va="center", fontsize=11, weight="bold")
            at = np.unique(np.linspace(0, len(record.reference) - 1, _ARROWS).astype(int))
            at = at[at < len(x)]
            heading = record.robots[at, robot, 2]
            axes.quiver(x[at], y[at], np.cos(heading), np.sin(heading), color=_INK, scale=18, width=0.005, zorder=3)
        if not record.success:
            size, edge = (9, 2.4) if bold else (5, 1.0)
            axes.plot(x[-1], y[-1], "x", color=_INK, markersize=size, markeredgewidth=edge, alpha=1.0 if bold else 0.5)


def errors(records: list[Record]) -> Figure:
    """Draw position and heading error over time on one scenario, per controller, with the losses of control marked."""
    figure = _figure(9.0, 6.4)
    above, below = figure.subplots(2, 1, sharex=True)
    _over_time(above, records, lambda r: (r.time_s[1:], 1e3 * r.position_error_end_m))
    _over_time(below, records, lambda r: (r.time_s[1:], np.degrees(r.heading_error_end_rad)))
    above.set_yscale("log")
    above.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    above.yaxis.set_major_formatter("{x:g}")
    above.yaxis.set_minor_formatter("")
    above.set_ylabel("position error (mm)")
    below.set_ylabel("heading error (degrees)")
    below.set_ylim(bottom=0.0)
    below.set_xlabel("time (s)")
    figure.suptitle(f"{_title(records)}: errors, mean of both robots at the control instants", fontsize=12)
    _time_legend(figure, records, [])
    return figure


def separation(records: list[Record]) -> Figure:
    """Draw the distance of the robots over time on one scenario, per controller, with its limits."""
    figure = _figure(9.0, 4.6)
    axes = figure.add_subplot()
    _over_time(axes, records, lambda r: (r.time_s, 1e3 * _distance(r.robots)))
    reference = records[0].reference
    axes.plot(np.arange(len(reference)) / records[0].control_hz, 1e3 * _distance(reference), color=_INK, linestyle="--")
    turned = "antiparallel" if records[0].scenario.endswith("-anti") else "parallel"
    touch_mm = 1e3 * plant_named(records[0].plant).body.diameter_m
    axes.axhline(HOLDABLE_MM[turned], color="#777777", linestyle="-.", linewidth=1.2)
    axes.axhspan(0.0, touch_mm, color="#CCCCCC", linewidth=0)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time (s)")
    axes.set_ylabel("distance of the robots' centres (mm)")
    figure.suptitle(f"{_title(records)}: separation of the robots", fontsize=12)
    limits = [
        Line2D([], [], color=_INK, linestyle="--", label="reference"),
        Line2D([], [], color="#777777", linestyle="-.", label=f"holdable at rest: {HOLDABLE_MM[turned]:g} mm"),
        Line2D([], [], color="#CCCCCC", linewidth=7, label=f"bodies touch: {touch_mm:g} mm"),
    ]
    _time_legend(figure, records, limits)
    return figure


def _over_time(axes: Axes, records: list[Record], series: Callable[[Record], tuple[Floats, Floats]]) -> None:
    """Draw each controller's median and the band of its episodes, while at least half of them are under control."""
    groups = by_controller(records)
    for name, episodes in groups.items():
        colour = colour_of(name, list(groups))
        drawn = [series(episode) for episode in episodes]
        longest = max((time for time, _ in drawn), key=len)
        middle, low, high = [], [], []
        for k in range(len(longest)):
            present = [values[k] for _, values in drawn if k < len(values)]
            if 2 * len(present) < len(drawn):
                break
            middle.append(np.median(present))
            low.append(np.percentile(present, _BAND[0]))
            high.append(np.percentile(present, _BAND[1]))
        time = longest[: len(middle)]
        axes.plot(time, middle, color=colour, linewidth=1.8)
        axes.fill_between(time, low, high, color=colour, alpha=0.2, linewidth=0)
        ends = [(t[-1], v[-1]) for (t, v), episode in zip(drawn, episodes, strict=True) if not episode.success]
        if ends:
            axes.plot(*np.transpose(ends), "x", color=colour, markersize=7, markeredgewidth=1.8, clip_on=False)
    duration = (len(records[0].reference) - 1) / records[0].control_hz
    axes.set_xlim(0.0, duration)
    axes.grid(color="#E5E5E5", linewidth=0.6)
    axes.set_axisbelow(True)


def _time_legend(figure: Figure, records: list[Record], more: list[Line2D]) -> None:
    groups = by_controller(records)
    handles = [
        Line2D([], [], color=colour_of(name, list(groups)), linewidth=2, label=f"{name}: {outcome(episodes)}")
        for name, episodes in groups.items()
    ]
    handles += [
        *more,
        Line2D([], [], color=_INK, marker="x", linestyle="", label="control lost (each episode)"),
    ]
    note = "line: median; band: 10 to 90 % of the episodes; both while at least half of them are under control"
    figure.legend(
        handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=9, title=note, title_fontsize=9
    )


def _title(records: list[Record]) -> str:
    first = records[0]
    return f"{first.scenario}, {first.plant} plant, {first.n_epm} EPMs, {first.control_hz:g} Hz"


def _distance(poses: Floats) -> Floats:
    apart: Floats = np.hypot(*(poses[:, 1, :2] - poses[:, 0, :2]).T)
    return apart


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), dpi=DPI, layout="constrained")
