"""Stability of a hold: how fast a small deviation in the plane grows while the EPMs stand still.

Earnshaw's theorem forbids that all directions in space are stable, not that all in a plane are, whose normal is borne.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv import stiffness
from magenv.crosstalk.activation import Pair, is_positive
from magenv.crosstalk.holdable import hold
from magenv.params import Body, System, require
from magenv.poses import POSE_SIZE

Floats = NDArray[np.float64]

_FIRST_STEP, _GROW, _SHRINK = 0.2, 1.5, 0.9
"""Of the search's moves, rad; factors of Rechenberg's rule: one move in five should succeed."""
_RADIUS_UNIT_M = 0.2
"""By how much a radius moves where an angle moves by one radian."""


def growth_rates(pair: Pair, system: System, pose: ArrayLike, body: Body) -> NDArray[np.complex128]:
    """Return the rates (12, 1/s) at which small deviations from a hold grow, the fastest first.

    Real parts above 0 grow; see ``magenv.stiffness.growth_rates``.

    Parameters
    ----------
    pair : Pair
        The robots.
    system : System
        Magnets.
    pose : array_like, shape (5 N,)
        EPM poses of the hold.
    body : Body
        Mass, inertia, drag.
    """
    x = np.asarray(pose, dtype=np.float64)
    fits = x.shape == (POSE_SIZE * system.n_epm,) and bool(np.isfinite(x).all())
    require(fits, "pose", f"a finite array of shape ({POSE_SIZE * system.n_epm},)", x.shape)
    stiff = stiffness.planar_stiffness(pair.positions, pair.moments(system), x, system.epm_moment_am2)
    return stiffness.growth_rates(stiff, body)


def slowest_control_hz(rate: float, growth: float = 10.0) -> float:
    """Return the control rate (Hz) at which a deviation grows no more than ``growth``-fold from command to command.

    A controller that meets a deviation after it has grown can still bring it back, however large it is by then, as
    long as it stays where the motion is about linear: growth, not stability, is what limits the rate.
    """
    require(is_positive(growth) and growth > 1, "growth", "a number above 1", growth)
    return max(rate, 0.0) / math.log(growth)


def most_stable_hold(
    pair: Pair,
    system: System,
    body: Body,
    *,
    components: Sequence[int] | None = None,
    holds: int = 40,
    moves: int = 500,
    seed: int = 0,
) -> tuple[Floats, list[float]] | None:
    """Search the holds of a pair for that at which deviations grow slowest; None where there is no hold.

    The best of ``holds`` holds from as many seeds is moved at random, held again from there, and kept where it has
    become more stable: an evolution strategy of one parent and one child (1/5 rule). Better holds may exist.

    Parameters
    ----------
    pair, system, body
        The robots, the magnets, mass and drag.
    components : sequence of int, optional
        As in ``hold``.
    holds, moves, seed : int
        Holds to choose from, moves of the best, seed of the moves.

    Returns
    -------
    pose : ndarray, shape (5 N,)
        EPM poses of the most stable hold found.
    rates : list of float
        Fastest growth rates (1/s): of the holds to choose from, and last that of the pose.
    """
    found = [hold(pair, system, components=components, seed=first) for first in range(holds)]
    poses = [solution.pose for solution in found if solution is not None]
    if not poses:
        return None

    def rate_of(pose: Floats) -> float:
        return float(growth_rates(pair, system, pose, body)[0].real)

    rates = [rate_of(pose) for pose in poses]
    rng, step = np.random.default_rng(seed), _FIRST_STEP
    best, least = poses[int(np.argmin(rates))], min(rates)
    unit = np.tile([1.0, 1.0, _RADIUS_UNIT_M, 1.0, 1.0], system.n_epm)
    for _ in range(moves):
        moved = best + step * unit * rng.normal(size=len(best))
        moved[2::POSE_SIZE] = np.clip(moved[2::POSE_SIZE], system.r_min_m, system.r_max_m)
        held = hold(pair, system, components=components, starts=0, initial=moved)
        rate = math.inf if held is None else rate_of(held.pose)
        if held is not None and rate < least:
            best, least = held.pose, rate
            step *= _GROW
        else:
            step *= _SHRINK
    return best, [*rates, least]
