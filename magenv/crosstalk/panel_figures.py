"""Figures of the paper's panels: matrices of activation, crosstalk over distance and angle, more EPMs."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from magenv.allocation import component_scales
from magenv.crosstalk.plan import ANGLE_DISTANCES_M, ARRANGEMENTS, DISTANCE_ANGLES
from magenv.crosstalk.style import LINES, TITLES, Rows, finish, new_figure, png, setting, where
from magenv.wrench import WRENCH_SIZE

Floats = NDArray[np.float64]

_SYMBOLS = tuple(f"${name}^{{{robot}}}$" for robot in (1, 2) for name in (r"\tau_y", r"\tau_z", "F_x", "F_y", "F_z"))


def _mean_over(rows: Rows, by: str) -> tuple[Floats, Floats]:
    """Return the sorted values of a column and the mean crosstalk at each, per cent."""
    at = np.array(sorted({row[by] for row in rows}))
    means = [np.mean([row["crosstalk_normalised"] for row in rows if row[by] == value]) for value in at]
    return at, 100.0 * np.array(means)


def matrices(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    """Draw the matrices of activation."""
    for first, arrangement in ARRANGEMENTS.items():
        panels = dict.fromkeys(row["panel"] for row in rows if "-epms-" in row["panel"] and row["first_deg"] == first)
        if not panels:
            continue
        across = min(len(panels), 4 if len(panels) == 4 else 3)
        down = -(-len(panels) // across)
        figure = new_figure(
            4.4 * across,
            4.3 * down + 0.7,
            f"Activation of each component alone, {TITLES[first]}\n{setting(rows, starts)}",
        )
        grid = figure.subplots(down, across, squeeze=False)
        scale = component_scales()
        for axes in grid.ravel()[len(panels) :]:
            axes.axis("off")
        for axes, panel in zip(grid.ravel(), panels, strict=False):
            some = sorted(where(rows, panel=panel), key=lambda row: row["component"])
            u = np.abs([[row[f"u_{j}"] for j in range(WRENCH_SIZE)] for row in some]) / scale
            share = u / np.diag(u)[:, None]
            shown = axes.imshow(share, cmap="Greys", vmin=0.0, vmax=1.0)
            for i, j in np.ndindex(share.shape):
                if share[i, j] >= 0.005:
                    ink = "white" if share[i, j] > 0.5 else "black"
                    axes.text(j, i, f"{100 * share[i, j]:.0f}", ha="center", va="center", fontsize=7, color=ink)
            axes.set_xticks(range(WRENCH_SIZE), _SYMBOLS, fontsize=8)
            axes.set_yticks(range(WRENCH_SIZE), _SYMBOLS, fontsize=8)
            axes.set_xlabel("component $j$")
            axes.set_ylabel("component $i$ asked for")
            row = some[0]
            mean = 100 * np.mean([row["crosstalk_normalised"] for row in some])
            reached = 100 * np.mean([row["activation"] for row in some])
            axes.set_title(
                f"{row['n_epm']} EPMs, {row['angle_deg']:g} degrees, {1e3 * row['distance_m']:g} mm\n"
                f"mean crosstalk {mean:.1f} %, {reached:.0f} % of the amplitude reached",
                fontsize=9,
            )
        bar = figure.colorbar(shown, ax=grid, shrink=0.7)
        bar.set_label("$|U_j| / |U_i|$, normalised; numbers in per cent")
        yield f"matrices-{arrangement}", png(figure)


def _per_cent(axes: Axes) -> None:
    """Make the vertical axis logarithmic from 1 % on, linear down to 0."""
    axes.set_yscale("symlog", linthresh=1.0)
    axes.set_ylim(0.0, 130.0)
    ticks = (0, 1, 3, 10, 30, 100)
    axes.set_yticks(ticks, [str(tick) for tick in ticks])
    axes.set_yticks([], minor=True)


def sweeps(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    """Draw crosstalk over distance and over angle, and of more EPMs against fewer."""
    numbers = sorted({row["n_epm"] for row in rows})
    for name, by, label, factor, other, values, told in (
        (
            "distance",
            "distance_m",
            "distance between the robots (mm)",
            1e3,
            "angle_deg",
            DISTANCE_ANGLES,
            "{:g} degrees",
        ),
        ("angle", "angle_deg", "angle between the moments (degrees)", 1.0, "distance_m", ANGLE_DISTANCES_M, "{:g} mm"),
    ):
        figure = new_figure(
            9.6, 3.6 * len(numbers) + 0.6, f"Mean crosstalk of the ten components, normalised\n{setting(rows, starts)}"
        )
        grid = figure.subplots(len(numbers), 2, squeeze=False, sharey=True)
        for (n, first), axes in zip(((n, first) for n in numbers for first in ARRANGEMENTS), grid.ravel(), strict=True):
            some = [row for row in where(rows, n_epm=n, first_deg=first) if row["panel"].startswith(name)]
            for value, style in zip(values, LINES, strict=True):
                at, mean = _mean_over(where(some, **{other: value}), by)
                axes.plot(
                    factor * at, mean, label=told.format(value if by == "distance_m" else 1e3 * value), ms=4, **style
                )
            axes.set_title(f"{n} EPMs, {TITLES[first]}", fontsize=9)
            _per_cent(axes)
            finish(axes, label, "mean crosstalk (%)")
        yield name, png(figure)
    if len(numbers) > 1:
        figure = new_figure(
            9.6, 4.2, f"Two against more EPMs of the same total volume, parallel robots\n{setting(rows, starts)}"
        )
        grid = figure.subplots(1, 2, squeeze=False, sharey=True)
        for first, axes in zip(ARRANGEMENTS, grid.ravel(), strict=True):
            for n, style in zip(numbers, itertools.cycle(LINES), strict=False):
                some = where(rows, n_epm=n, first_deg=first, angle_deg=0.0)
                at, mean = _mean_over([row for row in some if row["panel"].startswith("distance")], "distance_m")
                axes.plot(1e3 * at, mean, label=f"{n} EPMs", ms=4, **style)
            axes.set_title(TITLES[first], fontsize=9)
            _per_cent(axes)
            finish(axes, "distance between the robots (mm)", "mean crosstalk (%)")
        yield "epms", png(figure)
