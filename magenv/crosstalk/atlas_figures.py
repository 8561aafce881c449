"""Figures of what goes beyond the paper: frontier, holdable separation, stability, validity, unlike robots."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from magenv.crosstalk.plan import ARRANGEMENTS, LINE, SIDE, images
from magenv.crosstalk.style import BOUNDS, LINES, TITLES, Rows, finish, new_figure, png, setting, where
from magenv.crosstalk.tasks import CLEAR_STARTS, FARTHEST_M
from magenv.wrench import WRENCH_SIZE

Floats = NDArray[np.float64]


def frontier(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    """Draw the most of each component."""
    numbers, angles = sorted({row["n_epm"] for row in rows}), sorted({row["angle_deg"] for row in rows})
    limit = rows[0]["crosstalk_limit"]
    for first, arrangement in ARRANGEMENTS.items():
        figure = new_figure(
            14.0,
            2.9 * len(numbers) + 0.6,
            f"Most of each component, alone, at a crosstalk of at most {100 * limit:g} % (normalised), "
            f"{TITLES[first]}\nless of both signs and of both robots; {starts}; {BOUNDS}",
        )
        grid = figure.subplots(len(numbers), 5, squeeze=False, sharex=True, sharey="col")
        for (n, kind), axes in zip(np.ndindex(len(numbers), 5), grid.ravel(), strict=True):
            torque = kind < 2
            for angle, style in zip(angles, LINES, strict=False):
                some = where(rows, n_epm=numbers[n], first_deg=first, angle_deg=angle)
                at = np.array(sorted({row["distance_m"] for row in some}))
                most = [
                    min(row["wrench"] for row in some if row["distance_m"] == d and row["component"] % 5 == kind)
                    for d in at
                ]
                axes.plot(1e3 * at, 1e3 * np.array(most), label=f"{angle:g} degrees", ms=4, **style)
            if n == 0:
                axes.set_title(("$\\tau_y$", "$\\tau_z$", "$F_x$", "$F_y$", "$F_z$")[kind], fontsize=10)
            axes.grid(alpha=0.3)
            axes.set_ylabel(f"{numbers[n]} EPMs: " * (kind == 0) + ("mN m" if torque else "mN"))
            if n == len(numbers) - 1:
                axes.set_xlabel("distance (mm)")
        for axes in grid[0]:  # shared by its column
            axes.set_ylim(bottom=0.0)
        grid[0, 0].legend(fontsize=8)
        yield f"frontier-{arrangement}", png(figure)


def holdable(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    """Draw the maps of the holdable separation."""
    numbers = sorted({row["n_epm"] for row in rows})
    least = max(row["starts"] for row in rows)
    figure = new_figure(
        max(6.0 * len(numbers), 7.0),
        11.0,
        "Smallest distance at which both robots can be held still (mm)\n"
        f"{least} starts at each distance; empty where none is found from {1e3 * FARTHEST_M:g} mm down; {BOUNDS}",
    )
    grid = figure.subplots(2, len(numbers), squeeze=False)
    kinds = {"separation_m": "all ten components vanish", "separation_in_plane_m": "the six in the plane vanish"}
    values = [1e3 * row[column] for row in rows for column in kinds]
    low, high = np.nanmin(values), np.nanmax(values)
    for (column, told), line in zip(kinds.items(), grid, strict=True):
        for n, axes in zip(numbers, line, strict=True):
            angles, table = _map(where(rows, n_epm=n), column)
            across = [angle for angle in angles if angle <= 180]
            half = 0.5 * (angles[1] - angles[0])
            shown = axes.imshow(
                table[:, : len(across)],
                origin="lower",
                extent=(-half, across[-1] + half, -half, angles[-1] + half),
                cmap="Greys",
                aspect="auto",
                vmin=low,
                vmax=high,
            )
            for (j, i), value in np.ndenumerate(table[:, : len(across)]):
                if np.isfinite(value):
                    ink = "white" if value > 0.5 * (low + high) else "black"
                    axes.text(across[i], angles[j], f"{value:.0f}", ha="center", va="center", fontsize=6, color=ink)
            axes.set_xticks(range(0, 181, 45))
            axes.set_yticks(range(0, 360, 45))
            axes.set_xlabel("robot 1: angle of the moment against the joining line (degrees)")
            axes.set_ylabel("robot 2: the same (degrees)")
            axes.set_title(f"{n} EPMs: {told}", fontsize=10)
    figure.colorbar(shown, ax=grid, shrink=0.6).set_label("holdable separation (mm)")
    yield "holdable", png(figure)


def _map(rows: Rows, column: str) -> tuple[list[int], Floats]:
    """Return the angles (degrees) and the values (second robot, first robot) in mm, images filled in."""
    known = {(int(row["first_deg"]), int(row["second_deg"])): 1e3 * row[column] for row in rows}
    angles = sorted({angle for pair in known for image in images(*pair) for angle in image})
    table = np.full((len(angles), len(angles)), np.nan)
    for pair, value in known.items():
        for first, second in images(*pair):
            table[angles.index(second), angles.index(first)] = value
    return angles, table


def stability(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    """Draw how fast deviations grow."""
    numbers = sorted({row["n_epm"] for row in rows})
    kinds = {
        (SIDE, 0.0): "parallel, side by side",
        (SIDE, 180.0): "antiparallel, side by side",
        (LINE, 0.0): "head to tail",
    }
    figure = new_figure(
        max(5.0 * len(numbers), 7.0),
        7.6,
        f"Growth of a small deviation in the plane, most stable of {max(row['holds'] for row in rows)} holds moved on "
        "(plant paper)\nbelow 0 it decays; tenfold growth from command to command at a control rate of 0.43 times it\n"
        f"{BOUNDS}",
    )
    grid = figure.subplots(2, len(numbers), squeeze=False, sharey=True, sharex=True)
    for line, in_plane, held in zip(grid, (False, True), ("all ten vanish", "six in the plane vanish"), strict=True):
        for n, axes in zip(numbers, line, strict=True):
            for ((first, angle), told), style in zip(kinds.items(), LINES, strict=False):
                some = where(rows, n_epm=n, first_deg=first, angle_deg=angle, in_plane=in_plane)
                some = sorted(some, key=lambda row: float(row["distance_m"]))
                at = 1e3 * np.array([row["distance_m"] for row in some])
                axes.plot(at, [row["growth_rate_per_s"] for row in some], label=told, ms=4, **style)
            axes.set_yscale("symlog", linthresh=0.1)
            ticks = (-0.1, 0, 0.1, 0.3, 1, 3, 10, 30)
            axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.set_yticks([], minor=True)
            axes.axhline(0.0, color="black", linewidth=0.8)
            axes.set_title(f"{n} EPMs, {held}", fontsize=10)
            finish(axes, "distance between the robots (mm)", "growth rate (1/s) = 1 / time constant")
    yield "stability", png(figure)


def validity(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    """Draw what remains with cylinders."""
    cases = dict.fromkeys((row["n_epm"], row["angle_deg"], row["distance_m"]) for row in rows)
    figure = new_figure(
        11.0,
        4.8,
        f"What remains with magnets that are cylinders, first moment along the joining line\n{setting(rows, starts)}\n"
        f"r_min from the robots: at most {CLEAR_STARTS} starts, radii from 0.01 m",
    )
    left, right = figure.subplots(1, 2)
    labels = [f"{n} EPMs\n{angle:g} deg\n{1e3 * d:g} mm" for n, angle, d in cases]
    bars = (
        ("centre", "crosstalk_dipole", "r_min from the centre, dipoles", "#FFFFFF", ""),
        ("centre", "crosstalk_exact", "the same poses, cylinders", "#606060", ""),
        ("robots", "crosstalk_dipole", "r_min from the robots, dipoles", "#FFFFFF", "///"),
        ("robots", "crosstalk_exact", "the same poses, cylinders", "#B0B0B0", "///"),
    )
    for k, (source, column, told, colour, hatch) in enumerate(bars):
        means = [
            100 * np.mean([row[column] for row in where(rows, r_min_from=source, n_epm=n, angle_deg=a, distance_m=d)])
            for n, a, d in cases
        ]
        left.bar(
            np.arange(len(cases)) + 0.2 * (k - 1.5),
            means,
            0.2,
            label=told,
            color=colour,
            hatch=hatch,
            edgecolor="black",
        )
    left.set_xticks(range(len(cases)), labels, fontsize=8)
    left.set_ylabel("mean crosstalk, normalised (%)")
    left.legend(fontsize=8)
    for source, style in zip(("centre", "robots"), LINES, strict=False):
        some = where(rows, r_min_from=source)
        nearest = [1e3 * row["nearest_epm_m"] for row in some]
        worst = [100 * max(abs(row[f"error_{j}"]) for j in range(WRENCH_SIZE)) for row in some]
        marks = {"color": style["color"], "marker": style["marker"]}
        right.plot(nearest, worst, linestyle="", label=f"r_min from the {source}", ms=4, **marks)
    right.set_yscale("log")
    ticks = (1, 2, 5, 10, 20, 50)
    right.set_yticks(ticks, [str(tick) for tick in ticks])
    right.set_yticks([], minor=True)
    right.set_xlabel("nearest robot to an EPM's centre (mm)")
    right.set_ylabel("largest error of a component (% of its target)")
    right.grid(alpha=0.3)
    right.legend(fontsize=8)
    yield "validity", png(figure)


def unlike(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    """Draw crosstalk of unlike robots."""
    numbers = sorted({row["n_epm"] for row in rows})
    distance = 1e3 * rows[0]["distance_m"]
    figure = new_figure(
        9.6,
        4.4,
        f"Unlike robots, bodies parallel, {distance:g} mm apart, both asked for the same\n{setting(rows, starts)}",
    )
    left, right = figure.subplots(1, 2, sharey=True)
    styles = itertools.cycle(LINES)
    for n in numbers:
        for first in ARRANGEMENTS:
            style = next(styles)
            told = f"{n} EPMs, {'in line' if first == LINE else 'side by side'}"
            some = where(rows, n_epm=n, first_deg=first)
            for axes, by, fixed in (
                (left, "mounting_deg", {"moment_ratio": 1.0}),
                (right, "moment_ratio", {"mounting_deg": 0.0}),
            ):
                line = sorted(where(some, **fixed), key=lambda row: row[by])
                axes.plot(
                    [row[by] for row in line], [100 * row["crosstalk_mean"] for row in line], label=told, ms=4, **style
                )
    finish(left, "angle of the second robot's magnet in its body (degrees)", "mean crosstalk (%)")
    finish(right, "moment of the second robot's magnet over the first's", "mean crosstalk (%)")
    left.set_ylim(bottom=0.0)
    yield "unlike", png(figure)
