"""Figures of the system analysis, from the rows of the tables alone."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from magenv.allocation import FORCE_SCALE_N, TORQUE_SCALE_NM, component_scales
from magenv.crosstalk.plan import ANGLE_DISTANCES_M, ARRANGEMENTS, DISTANCE_ANGLES, LINE, SIDE, images
from magenv.crosstalk.tasks import Row
from magenv.wrench import WRENCH_SIZE

Floats = NDArray[np.float64]
Rows = Sequence[Row]

_SYMBOLS = tuple(f"${name}^{{{robot}}}$" for robot in (1, 2) for name in (r"\tau_y", r"\tau_z", "F_x", "F_y", "F_z"))
_LINES: tuple[dict[str, Any], ...] = (
    {"color": "#000000", "linestyle": "-", "marker": "o"},
    {"color": "#D55E00", "linestyle": "--", "marker": "s"},
    {"color": "#0072B2", "linestyle": "-.", "marker": "^"},
    {"color": "#909090", "linestyle": ":", "marker": "D"},
)
"""Told apart by colour-blind eyes and in grey."""
_TITLES = {LINE: "first moment along the joining line", SIDE: "first moment at right angles to it"}
_DPI = 130
_TEN = np.log(10.0)


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=_DPI)
    return content.getvalue()


def _figure(width: float, height: float, title: str) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title, fontsize=10)
    return figure


def _setting(rows: Rows, starts: str) -> str:
    """Return in words what the targets were."""
    amplitude = rows[0]["amplitude"]
    force, torque = 1e3 * amplitude * FORCE_SCALE_N, 1e3 * amplitude * TORQUE_SCALE_NM
    return (
        f"amplitude {amplitude:g} of the paper's targets: {force:g} mN, {torque:g} mN m; {starts}; radii 0.15 to 0.5 m"
    )


def _where(rows: Rows, **values: object) -> list[Row]:
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def _mean_over(rows: Rows, by: str) -> tuple[Floats, Floats]:
    """Return the sorted values of a column and the mean crosstalk at each, per cent."""
    at = np.array(sorted({row[by] for row in rows}))
    means = [np.mean([row["crosstalk_normalised"] for row in rows if row[by] == value]) for value in at]
    return at, 100.0 * np.array(means)


def _matrices(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    for first, arrangement in ARRANGEMENTS.items():
        panels = dict.fromkeys(row["panel"] for row in rows if "-epms-" in row["panel"] and row["first_deg"] == first)
        if not panels:
            continue
        across = min(len(panels), 4 if len(panels) == 4 else 3)
        down = -(-len(panels) // across)
        figure = _figure(
            4.4 * across,
            4.3 * down + 0.7,
            f"Activation of each component alone, {_TITLES[first]}\n{_setting(rows, starts)}",
        )
        grid = figure.subplots(down, across, squeeze=False)
        scale = component_scales()
        for axes in grid.ravel()[len(panels) :]:
            axes.axis("off")
        for axes, panel in zip(grid.ravel(), panels, strict=False):
            some = sorted(_where(rows, panel=panel), key=lambda row: row["component"])
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
        yield f"matrices-{arrangement}", _png(figure)


def _lines(axes: Axes, label: str, unit: str) -> None:
    axes.set_xlabel(label)
    axes.set_ylabel(unit)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _sweeps(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
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
        figure = _figure(
            9.6, 3.6 * len(numbers) + 0.6, f"Mean crosstalk of the ten components, normalised\n{_setting(rows, starts)}"
        )
        grid = figure.subplots(len(numbers), 2, squeeze=False, sharey=True)
        for (n, first), axes in zip(((n, first) for n in numbers for first in ARRANGEMENTS), grid.ravel(), strict=True):
            some = [row for row in _where(rows, n_epm=n, first_deg=first) if row["panel"].startswith(name)]
            for value, style in zip(values, _LINES, strict=True):
                at, mean = _mean_over(_where(some, **{other: value}), by)
                axes.plot(
                    factor * at, mean, label=told.format(value if by == "distance_m" else 1e3 * value), ms=4, **style
                )
            axes.set_title(f"{n} EPMs, {_TITLES[first]}", fontsize=9)
            axes.set_yscale("symlog", linthresh=1.0)
            axes.set_ylim(bottom=0.0)
            _lines(axes, label, "mean crosstalk (%)")
        yield name, _png(figure)
    if len(numbers) > 1:
        figure = _figure(
            9.6, 4.2, f"Two against more EPMs of the same total volume, parallel robots\n{_setting(rows, starts)}"
        )
        grid = figure.subplots(1, 2, squeeze=False, sharey=True)
        for first, axes in zip(ARRANGEMENTS, grid.ravel(), strict=True):
            for n, style in zip(numbers, _LINES, strict=False):
                some = _where(rows, n_epm=n, first_deg=first, angle_deg=0.0)
                at, mean = _mean_over([row for row in some if row["panel"].startswith("distance")], "distance_m")
                axes.plot(1e3 * at, mean, label=f"{n} EPMs", ms=4, **style)
            axes.set_title(_TITLES[first], fontsize=9)
            axes.set_yscale("symlog", linthresh=1.0)
            axes.set_ylim(bottom=0.0)
            _lines(axes, "distance between the robots (mm)", "mean crosstalk (%)")
        yield "epms", _png(figure)


def _frontier(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    numbers, angles = sorted({row["n_epm"] for row in rows}), sorted({row["angle_deg"] for row in rows})
    limit = rows[0]["crosstalk_limit"]
    for first, arrangement in ARRANGEMENTS.items():
        figure = _figure(
            14.0,
            2.9 * len(numbers) + 0.6,
            f"Most of each component, alone, at a crosstalk of at most {100 * limit:g} % (normalised), "
            f"{_TITLES[first]}\nless of both signs and of both robots; {starts}",
        )
        grid = figure.subplots(len(numbers), 5, squeeze=False, sharex=True, sharey="col")
        for (n, kind), axes in zip(np.ndindex(len(numbers), 5), grid.ravel(), strict=True):
            torque = kind < 2
            for angle, style in zip(angles, _LINES, strict=False):
                some = _where(rows, n_epm=numbers[n], first_deg=first, angle_deg=angle)
                at = np.array(sorted({row["distance_m"] for row in some}))
                most = [
                    min(row["wrench"] for row in some if row["distance_m"] == d and row["component"] % 5 == kind)
                    for d in at
                ]
                axes.plot(1e3 * at, 1e3 * np.array(most), label=f"{angle:g} degrees", ms=4, **style)
            if n == 0:
                axes.set_title(("$\\tau_y$", "$\\tau_z$", "$F_x$", "$F_y$", "$F_z$")[kind], fontsize=10)
            axes.set_ylim(bottom=0.0)
            axes.grid(alpha=0.3)
            axes.set_ylabel(f"{numbers[n]} EPMs: " * (kind == 0) + ("mN m" if torque else "mN"))
            if n == len(numbers) - 1:
                axes.set_xlabel("distance (mm)")
        grid[0, 0].legend(fontsize=8)
        yield f"frontier-{arrangement}", _png(figure)


def _holdable(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    numbers = sorted({row["n_epm"] for row in rows})
    figure = _figure(
        6.4 * len(numbers),
        6.2,
        f"Smallest distance at which both robots can be held still (mm); {starts} at each distance",
    )
    grid = figure.subplots(1, len(numbers), squeeze=False)
    for n, axes in zip(numbers, grid.ravel(), strict=True):
        known = {
            (int(row["first_deg"]), int(row["second_deg"])): 1e3 * row["separation_m"] for row in _where(rows, n_epm=n)
        }
        angles = sorted({angle for pair in known for image in images(*pair) for angle in image})
        table = np.full((len(angles), len(angles)), np.nan)
        for pair, value in known.items():
            for a, b in images(*pair):
                table[angles.index(b), angles.index(a)] = value
        half = [i for i, angle in enumerate(angles) if angle <= 180]
        table = table[:, half]
        step = angles[1] - angles[0]
        edges = (-0.5 * step, 180 + 0.5 * step, -0.5 * step, angles[-1] + 0.5 * step)
        shown = axes.imshow(table, origin="lower", extent=edges, cmap="Greys", aspect="auto")
        middle = 0.5 * (np.nanmin(table) + np.nanmax(table))
        for (j, i), value in np.ndenumerate(table):
            ink = "white" if value > middle else "black"
            axes.text(angles[half[i]], angles[j], f"{value:.0f}", ha="center", va="center", fontsize=6, color=ink)
        axes.set_xticks(range(0, 181, 45))
        axes.set_yticks(range(0, 360, 45))
        axes.set_xlabel("robot 1: angle of the moment against the joining line (degrees)")
        axes.set_ylabel("robot 2: the same (degrees)")
        axes.set_title(f"{n} EPMs", fontsize=10)
        figure.colorbar(shown, ax=axes, shrink=0.8).set_label("holdable separation (mm)")
    yield "holdable", _png(figure)


def _stability(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    numbers = sorted({row["n_epm"] for row in rows})
    kinds = {
        (SIDE, 0.0): "parallel, side by side",
        (SIDE, 180.0): "antiparallel, side by side",
        (LINE, 0.0): "head to tail",
    }
    figure = _figure(
        9.6, 4.4, f"Fastest unstable motion at the most stable hold found of {rows[0]['holds']} (plant paper)"
    )
    grid = figure.subplots(1, len(numbers), squeeze=False, sharey=True)
    for n, axes in zip(numbers, grid.ravel(), strict=True):
        for ((first, angle), told), style in zip(kinds.items(), _LINES, strict=False):
            some = sorted(_where(rows, n_epm=n, first_deg=first, angle_deg=angle), key=lambda row: row["distance_m"])
            at = 1e3 * np.array([row["distance_m"] for row in some])
            axes.plot(at, [row["growth_rate_per_s"] for row in some], label=told, ms=4, **style)
        axes.set_yscale("log")
        axes.set_title(f"{n} EPMs", fontsize=10)
        _lines(axes, "distance between the robots (mm)", "growth rate (1/s) = 1 / time constant")
        right = axes.secondary_yaxis("right", functions=(lambda rate: rate / _TEN, lambda hz: hz * _TEN))
        right.set_ylabel("control rate at which errors grow tenfold a period (Hz)")
    yield "stability", _png(figure)


def _validity(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    cases = dict.fromkeys((row["n_epm"], row["angle_deg"], row["distance_m"]) for row in rows)
    figure = _figure(
        11.0,
        4.8,
        f"What remains with magnets that are cylinders\n{_setting(rows, starts)}, first moment along the joining line",
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
            100 * np.mean([row[column] for row in _where(rows, r_min_from=source, n_epm=n, angle_deg=a, distance_m=d)])
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
    for source, style in zip(("centre", "robots"), _LINES, strict=False):
        some = _where(rows, r_min_from=source)
        nearest = [1e3 * row["nearest_epm_m"] for row in some]
        worst = [100 * max(abs(row[f"error_{j}"]) for j in range(WRENCH_SIZE)) for row in some]
        marks = {"color": style["color"], "marker": style["marker"]}
        right.plot(nearest, worst, linestyle="", label=f"r_min from the {source}", ms=4, **marks)
    right.set_yscale("log")
    right.set_xlabel("nearest robot to an EPM's centre (mm)")
    right.set_ylabel("largest error of a component (% of its target)")
    right.grid(alpha=0.3)
    right.legend(fontsize=8)
    yield "validity", _png(figure)


def _unlike(rows: Rows, starts: str) -> Iterator[tuple[str, bytes]]:
    numbers = sorted({row["n_epm"] for row in rows})
    distance = 1e3 * rows[0]["distance_m"]
    figure = _figure(9.6, 4.4, f"Unlike robots, parallel, {distance:g} mm apart\n{_setting(rows, starts)}")
    left, right = figure.subplots(1, 2, sharey=True)
    styles = iter(_LINES)
    for n in numbers:
        for first in ARRANGEMENTS:
            style = next(styles, _LINES[0])
            told = f"{n} EPMs, {'in line' if first == LINE else 'side by side'}"
            some = _where(rows, n_epm=n, first_deg=first)
            for axes, by, fixed in (
                (left, "mounting_deg", {"moment_ratio": 1.0}),
                (right, "moment_ratio", {"mounting_deg": 0.0}),
            ):
                line = sorted(_where(some, **fixed), key=lambda row: row[by])
                axes.plot(
                    [row[by] for row in line], [100 * row["crosstalk_mean"] for row in line], label=told, ms=4, **style
                )
    _lines(left, "angle of the second robot's magnet in its body (degrees)", "mean crosstalk (%)")
    _lines(right, "moment of the second robot's magnet over the first's", "mean crosstalk (%)")
    left.set_yscale("log")
    yield "unlike", _png(figure)


_DRAWN: Mapping[str, tuple[Callable[[Rows, str], Iterator[tuple[str, bytes]]], ...]] = {
    "crosstalk": (_matrices, _sweeps),
    "frontier": (_frontier,),
    "holdable": (_holdable,),
    "stability": (_stability,),
    "validity": (_validity,),
    "unlike": (_unlike,),
}


def draw(tables: Mapping[str, Rows], starts: str) -> Iterator[tuple[str, bytes]]:
    """Yield names and PNG images of all figures that the tables give."""
    for table, rows in tables.items():
        for function in _DRAWN[table]:
            yield from function(rows, starts)
