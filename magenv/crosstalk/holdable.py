"""Holdable separation: how close two robots can be held still, each one's whole wrench zero against the mutual one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magenv.allocation import Solution, allocate, component_scales
from magenv.crosstalk.activation import Pair, is_positive
from magenv.params import System, require
from magenv.solver import NORM_FLOOR
from magenv.wrench import WRENCH_SIZE, robot_frames

Floats = NDArray[np.float64]

HELD = 1e-6
"""Share of the robots' mutual wrench that may be left over in a hold."""
_FINEST_M = 1e-9
_STEP = 0.92
"""Factor from one distance to the next on the way down: one half in eight steps."""


def _mutual_wrench(pair: Pair, system: System) -> float:
    """Return the norm of what the robots do to each other, in the paper's targets."""
    frames, mutual = np.empty((2, 3, 3)), np.empty(WRENCH_SIZE)
    robot_frames(pair.positions, pair.moments(system), frames, mutual)
    return float(np.linalg.norm(mutual / component_scales()))


def hold(
    pair: Pair,
    system: System,
    *,
    components: Sequence[int] | None = None,
    starts: int = 10,
    seed: int = 0,
    initial: Floats | None = None,
) -> Solution | None:
    """Return EPM poses that leave no wrench on either robot, in none of the ten components; None where none is found.

    Parameters
    ----------
    pair : Pair
        The robots.
    system : System
        Magnets and limits.
    components : sequence of int, optional
        The components that must vanish, such as ``IN_PLANE``; without, all ten.
    starts, seed : int
        Random starts and their seed; the first that holds ends the search.
    initial : ndarray, shape (5 N,), optional
        Poses to begin with.
    """
    tolerance = HELD * _mutual_wrench(pair, system) / NORM_FLOOR  # the norm of a target of zero
    found = allocate(
        np.zeros(WRENCH_SIZE),
        pair.positions,
        pair.moments(system),
        system,
        starts=starts,
        seed=seed,
        initial=initial,
        stop_early=True,
        tolerance=tolerance,
        components=components,
    )
    return found if found.relative_residual <= tolerance else None


def holdable_separation(
    pair: Pair,
    system: System,
    *,
    components: Sequence[int] | None = None,
    nearest_m: float = 0.011,
    precision_m: float = 5e-5,
    starts: int = 50,
    seed: int = 0,
) -> float:
    """Return the smallest distance (m) at which the pair can be held, from its own distance down.

    Parameters
    ----------
    pair : Pair
        The robots, as far apart as the search begins.
    system : System
        Magnets and limits.
    components : sequence of int, optional
        As in ``hold``.
    nearest_m : float
        Where it ends: the bodies' width.
    precision_m : float
        To which the last distance is bisected.
    starts, seed : int
        Random starts at each distance, beside the poses that held at the last.

    Returns
    -------
    float
        NaN where the pair can be held at no distance that was tried.

    Raises
    ------
    ValueError
        If ``nearest_m`` is not less than the pair's distance, or the precision is not positive.
    """
    fits = is_positive(nearest_m) and nearest_m < pair.distance_m
    require(fits, "nearest_m", f"positive and less than the distance {pair.distance_m}", nearest_m)
    fits = is_positive(precision_m) and precision_m >= _FINEST_M
    require(fits, "precision_m", f"a number of at least {_FINEST_M:g}", precision_m)
    held, lost, distance, found = math.nan, math.nan, pair.distance_m, None
    while True:  # the whole way down: some pairs can be held near each other and not farther apart
        near = replace(pair, distance_m=distance)
        initial = None if found is None else found.pose
        nearer = hold(near, system, components=components, starts=starts, seed=seed, initial=initial)
        if nearer is not None:
            held, found, lost = distance, nearer, math.nan
        elif math.isnan(lost):
            lost = distance
        if distance == nearest_m:
            break
        distance = max(_STEP * distance, nearest_m)
    if found is None or math.isnan(lost):
        return held
    while held - lost > precision_m:
        distance = 0.5 * (held + lost)
        near = replace(pair, distance_m=distance)
        nearer = hold(near, system, components=components, starts=starts, seed=seed, initial=found.pose)
        if nearer is None:
            lost = distance
        else:
            held, found = distance, nearer
    return held
