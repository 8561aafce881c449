"""One point of each sweep: plain values in, rows of a table out, so that any process or cluster can compute it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from magenv.allocation import component_scales
from magenv.crosstalk.activation import Activations, Pair, activate, crosstalk
from magenv.crosstalk.frontier import authority
from magenv.crosstalk.holdable import holdable_separation
from magenv.crosstalk.stability import most_stable_hold, slowest_control_hz
from magenv.crosstalk.validity import clear_of_robots, exact_wrench
from magenv.params import PLANTS, System
from magenv.poses import to_cartesian
from magenv.wrench import IN_PLANE

Row = dict[str, Any]

HALF_SECOND = 0.5
"""The paper's control period, s."""
CLEAR_STARTS = 10
"""At most, by SciPy's optimiser, which takes a hundred times as long as ours."""
FARTHEST_M = 0.06
"""Where the search for the holdable separation begins."""


def _rows(found: Activations, common: Row) -> list[Row]:
    scale = component_scales()
    normalised = crosstalk(found.wrench, found.component, scale)
    raw = crosstalk(found.wrench, found.component)
    return [
        common
        | {
            "component": int(i),
            "activation": float(found.reached[k]),
            "crosstalk_normalised": float(normalised[k]),
            "crosstalk_raw": float(raw[k]),
        }
        | {f"u_{j}": float(value) for j, value in enumerate(found.wrench[k])}
        for k, i in enumerate(found.component)
    ]


def activation_rows(
    panel: str, n_epm: int, distance_m: float, angle_deg: float, first_deg: float, amplitude: float, starts: int
) -> list[Row]:
    """Return a row for each of the ten components, activated alone."""
    pair, system = Pair(distance_m, angle_deg, first_deg), System(n_epm=n_epm)
    common = {
        "panel": panel,
        "n_epm": n_epm,
        "distance_m": distance_m,
        "angle_deg": angle_deg,
        "amplitude": amplitude,
    }
    rows = _rows(activate(pair, system, amplitude, starts=starts), common)
    return [row | {"first_deg": first_deg, "starts": starts} for row in rows]


def frontier_rows(
    n_epm: int, distance_m: float, angle_deg: float, first_deg: float, component: int, limit: float, starts: int
) -> list[Row]:
    """Return the most of a component, of both signs and of the sign with less."""
    pair, system = Pair(distance_m, angle_deg, first_deg), System(n_epm=n_epm)
    most = {
        name: authority(pair, system, component, sign=sign, limit=limit, starts=starts).amplitude
        for name, sign in (("plus", 1.0), ("minus", -1.0))
    }
    least = min(most.values())
    return [
        {
            "n_epm": n_epm,
            "distance_m": distance_m,
            "angle_deg": angle_deg,
            "first_deg": first_deg,
            "component": component,
            "crosstalk_limit": limit,
            "amplitude": least,
            "amplitude_plus": most["plus"],
            "amplitude_minus": most["minus"],
            "wrench": least * float(component_scales()[component]),
            "starts": starts,
        }
    ]


def holdable_rows(n_epm: int, first_deg: float, second_deg: float, starts: int) -> list[Row]:
    """Return the holdable separation of robots whose moments have these angles against the line that joins them."""
    pair, system = Pair(FARTHEST_M, second_deg - first_deg, first_deg), System(n_epm=n_epm)
    return [
        {
            "n_epm": n_epm,
            "first_deg": first_deg,
            "second_deg": second_deg,
            "separation_m": holdable_separation(pair, system, starts=starts),
            "separation_in_plane_m": holdable_separation(pair, system, components=IN_PLANE, starts=starts),
            "starts": starts,
        }
    ]


def _time_constant(rate: float) -> float:
    return math.inf if rate <= 0.0 else 1.0 / rate


def stability_rows(
    n_epm: int, distance_m: float, angle_deg: float, first_deg: float, in_plane: bool, holds: int
) -> list[Row]:
    """Return how fast deviations in the plane grow in the most stable hold found, the best of ``holds`` moved on.

    The time constant is infinite where none grows.
    """
    pair, system, body = Pair(distance_m, angle_deg, first_deg), System(n_epm=n_epm), PLANTS["paper"].body
    found = most_stable_hold(pair, system, body, components=IN_PLANE if in_plane else None, holds=holds)
    pose, rates = found if found is not None else (np.full(5 * n_epm, math.nan), [math.nan])
    slowest = rates[-1]
    return [
        {
            "n_epm": n_epm,
            "distance_m": distance_m,
            "angle_deg": angle_deg,
            "first_deg": first_deg,
            "in_plane": in_plane,
            "holds": holds,
            "growth_rate_per_s": slowest,
            "growth_rate_median_per_s": float(np.median(rates[:-1] or rates)),
            "time_constant_s": _time_constant(slowest),
            "growth_in_half_a_second": math.exp(HALF_SECOND * slowest),
            "slowest_control_hz": slowest_control_hz(slowest),
        }
        | {f"x_{j}": float(value) for j, value in enumerate(pose)}
    ]


def validity_rows(
    n_epm: int,
    distance_m: float,
    angle_deg: float,
    first_deg: float,
    amplitude: float,
    starts: int,
    r_min_from: str,
) -> list[Row]:
    """Return what becomes of each activation when all magnets are cylinders; r_min from the centre or the robots."""
    pair, system = Pair(distance_m, angle_deg, first_deg), System(n_epm=n_epm)
    found = activate(pair, system, amplitude, starts=starts)
    if r_min_from == "robots":
        found = clear_of_robots(pair, system, found, starts=min(starts, CLEAR_STARTS))
    moments = pair.moments(system)
    exact = replace(found, wrench=np.array([exact_wrench(pair.positions, moments, x, system) for x in found.pose]))
    scale = component_scales()
    rows = []
    for k, (i, pose) in enumerate(zip(found.component, found.pose, strict=True)):
        centres, _ = to_cartesian(pose)
        nearest = np.linalg.norm(centres[:, None] - pair.positions, axis=-1).min()
        off = (exact.wrench[k] - found.wrench[k]) / scale / amplitude
        rows.append(
            {
                "n_epm": n_epm,
                "distance_m": distance_m,
                "angle_deg": angle_deg,
                "first_deg": first_deg,
                "amplitude": amplitude,
                "r_min_from": r_min_from,
                "component": int(i),
                "nearest_epm_m": float(nearest),
                "activation_dipole": float(found.reached[k]),
                "activation_exact": float(exact.reached[k]),
                "crosstalk_dipole": float(crosstalk(found.wrench[k], i, scale)),
                "crosstalk_exact": float(crosstalk(exact.wrench[k], i, scale)),
                "starts": starts,
            }
            | {f"error_{j}": float(value) for j, value in enumerate(off)}
        )
    return rows


def unlike_rows(
    n_epm: int, distance_m: float, first_deg: float, mounting_deg: float, ratio: float, amplitude: float, starts: int
) -> list[Row]:
    """Return the crosstalk of parallel robots, the second's magnet turned in its body and of another size."""
    pair, system = Pair(distance_m, mounting_deg, first_deg, ratio), System(n_epm=n_epm)
    found = activate(pair, system, amplitude, starts=starts)
    normalised = crosstalk(found.wrench, found.component, component_scales())
    torques = np.isin(found.component % 5, (0, 1))
    return [
        {
            "n_epm": n_epm,
            "distance_m": distance_m,
            "first_deg": first_deg,
            "mounting_deg": mounting_deg,
            "moment_ratio": ratio,
            "amplitude": amplitude,
            "crosstalk_mean": float(normalised.mean()),
            "crosstalk_torques": float(normalised[torques].mean()),
            "crosstalk_forces": float(normalised[~torques].mean()),
            "activation_mean": float(found.reached.mean()),
            "starts": starts,
        }
    ]


TASKS: Mapping[str, Callable[..., list[Row]]] = {
    "crosstalk": activation_rows,
    "frontier": frontier_rows,
    "holdable": holdable_rows,
    "stability": stability_rows,
    "validity": validity_rows,
    "unlike": unlike_rows,
}
"""By the name of the table that they fill."""
