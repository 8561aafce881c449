"""The authority frontier: how much of one wrench component can be had while the others stay small beside it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.allocation import allocate_batch, component_scales
from magenv.crosstalk.activation import Pair, is_positive
from magenv.margins import gap_margins, minimise_within
from magenv.params import System, is_whole, require
from magenv.poses import POSE_SIZE
from magenv.wrench import WRENCH_SIZE, robot_wrench, wrench_jacobian

Floats = NDArray[np.float64]

_LADDER = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
"""Amplitudes from whose allocations the search begins."""
_RADIUS_UNIT_M = 0.1
"""In which radii are searched, so that all variables are of one size."""
_SLACK, _GAP_SLACK = 1e-4, 1e-6
"""Shares by which a found crosstalk may be above its limit, and a gap below, and still count."""


_OPTIONS: Any = {"maxiter": 80, "ftol": 1e-6}


class Authority(NamedTuple):
    """The most of one component that was found."""

    amplitude: float
    """|U_i| over the paper's target; 0 where nothing was found."""
    pose: Floats
    """EPM poses (5 N); NaN where nothing was found."""
    wrench: Floats
    """U there (10), N m and N."""


def _climb(
    pair: Pair, system: System, component: int, sign: float, limit: float, pose: Floats
) -> tuple[float, Floats, Floats]:
    """Maximise sign U_i / scale from a pose under |U_j| / scale <= limit U_i / scale, bounds and gap."""
    positions, moments, scale = pair.positions, pair.moments(system), component_scales()
    unit = np.tile([1.0, 1.0, _RADIUS_UNIT_M, 1.0, 1.0], system.n_epm)
    others = np.arange(WRENCH_SIZE) != component

    def scaled(y: Floats) -> Floats:
        u: Floats = sign * robot_wrench(positions, moments, y * unit, system.epm_moment_am2) / scale
        return u

    def fall(y: Floats) -> float:
        return -float(scaled(y)[component])

    def fall_slopes(y: Floats) -> Floats:
        return np.asarray(-slopes(y)[component])

    def slopes(y: Floats) -> Floats:
        by_pose = wrench_jacobian(positions, moments, y * unit, system.epm_moment_am2)
        return np.asarray(sign * by_pose * unit / scale[:, None])

    def margins(y: Floats) -> Floats:
        u = scaled(y)
        gaps = gap_margins(y * unit, system.gap_min_m)[0]
        return np.concatenate([u[component] - u[others] / limit, u[component] + u[others] / limit, gaps])

    def margin_slopes(y: Floats) -> Floats:
        s = slopes(y)
        gaps = gap_margins(y * unit, system.gap_min_m)[1] * unit
        return np.concatenate([s[component] - s[others] / limit, s[component] + s[others] / limit, gaps])

    low, high = np.full(len(pose), -np.inf), np.full(len(pose), np.inf)
    low[2::POSE_SIZE], high[2::POSE_SIZE] = system.r_min_m / _RADIUS_UNIT_M, system.r_max_m / _RADIUS_UNIT_M
    found, _ = minimise_within(fall, fall_slopes, margins, margin_slopes, low, high, pose / unit, _OPTIONS)
    y = np.clip(found, low, high)
    u = scaled(y)
    kept = margins(y)
    crossing, gaps = kept[: 2 * int(others.sum())], kept[2 * int(others.sum()) :]
    fits = bool(u[component] > 0 and (crossing >= -_SLACK * u[component]).all() and (gaps >= -_GAP_SLACK).all())
    return (float(u[component]) if fits else 0.0), y * unit, sign * u * scale


def authority(
    pair: Pair,
    system: System,
    component: int,
    *,
    sign: float = 1.0,
    limit: float = 0.05,
    starts: int = 10,
    seed: int = 0,
) -> Authority:
    """Return the largest amplitude of a component whose crosstalk, normalised by the paper's targets, is in the limit.

    Allocations of several amplitudes give beginnings; from each, sequential quadratic programming climbs to a local
    maximum, and the highest is kept. What it returns can be had; that there is no more is not proven.

    Parameters
    ----------
    pair : Pair
        The robots.
    system : System
        Magnets and limits.
    component : int
        Index into U.
    sign : {1.0, -1.0}
        Of the component: the robots' mutual wrench makes a difference.
    limit : float
        Greatest crosstalk.
    starts, seed : int
        Random starts of each allocation, and their seed.

    Raises
    ------
    ValueError
        If a value is out of range.
    """
    fits = is_whole(component) and 0 <= component < WRENCH_SIZE
    require(fits, "component", f"an index from 0 to {WRENCH_SIZE - 1}", component)
    require(sign in (1.0, -1.0), "sign", "1 or -1", sign)
    require(is_positive(limit), "limit", "a positive, finite number", limit)
    targets = sign * np.outer(_LADDER, component_scales() * (np.arange(WRENCH_SIZE) == component))
    begun = allocate_batch(targets, pair.positions, pair.moments(system), system, starts=starts, seed=seed)
    best = Authority(0.0, np.full(POSE_SIZE * system.n_epm, np.nan), np.full(WRENCH_SIZE, np.nan))
    for pose in begun.pose:
        found = Authority(*_climb(pair, system, component, sign, limit, pose))
        if found.amplitude > best.amplitude:
            best = found
    return best
