"""Where the dipole model breaks down: the same poses with magnets that are cylinders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.allocation import component_scales
from magenv.allocation_input import draw_starts
from magenv.crosstalk.activation import Activations, Pair
from magenv.cylinder import field_and_gradient
from magenv.margins import clearances, gap_margins, minimise_within
from magenv.params import System, require
from magenv.poses import POSE_SIZE, project, to_cartesian
from magenv.wrench import WRENCH_SIZE, robot_frames, robot_wrench, wrench_jacobian

Floats = NDArray[np.float64]

_OPTIONS: Any = {"maxiter": 300, "ftol": 1e-12}
_SLACK = 1e-6
"""Share by which a found distance may be below its limit and still count."""
_LEAST_RADIUS_M = 0.01
"""Of a centre, where it is the robots that it must keep from: the pose vector is undefined at the workspace centre."""


def exact_wrench(positions: ArrayLike, moments: ArrayLike, pose: ArrayLike, system: System) -> Floats:
    """Wrench U (10) as ``magenv.wrench.robot_wrench`` gives it, but the sources are cylinders and not dipoles.

    EPMs and robots' magnets alike make the field of a uniformly magnetised cylinder; what it does to a robot is what it
    does to the dipole at its centre, which is 5 mm across.

    Parameters
    ----------
    positions, moments : array_like, shape (2, 3)
        Robots' positions in m and moments in A m^2.
    pose : array_like, shape (5 N,)
        EPM poses.
    system : System
        Magnets.

    Raises
    ------
    ValueError
        If a shape does not fit or a number is not finite.
    """
    p, m, x = (np.asarray(value, dtype=np.float64) for value in (positions, moments, pose))
    for name, value, shape in (("positions", p, (2, 3)), ("moments", m, (2, 3)), ("pose", x, (5 * system.n_epm,))):
        fits = value.shape == shape and bool(np.isfinite(value).all())
        require(fits, name, f"a finite array of shape {shape}", value.shape)
    centres, directions = to_cartesian(x)
    epm, ipm = system.epm, system.ipm
    frames, u = np.empty((2, 3, 3)), np.empty(WRENCH_SIZE)
    robot_frames(p, m, frames, u)
    for robot, other in ((0, 1), (1, 0)):
        b, g = field_and_gradient(system.epm_moment_am2 * directions, epm.diameter_m, epm.length_m, centres, p[robot])
        mutual_b, mutual_g = field_and_gradient(m[other], ipm.diameter_m, ipm.length_m, p[other], p[robot])
        torque = frames[robot] @ np.cross(m[robot], b.sum(axis=0) + mutual_b)
        force = frames[robot] @ ((g.sum(axis=0) + mutual_g) @ m[robot])
        u[5 * robot : 5 * robot + 5] = [*torque[1:], *force]
    return u


def _solve_clear(pair: Pair, system: System, target: Floats, begun: Sequence[Floats]) -> Floats:
    """Return the poses that come nearest to a target (10) with r_min kept from each robot, from several beginnings."""
    positions, moments, scale = pair.positions, pair.moments(system), component_scales()
    weights = 1.0 / scale / np.linalg.norm(target / scale)
    low, high = np.full(len(begun[0]), -np.inf), np.full(len(begun[0]), np.inf)
    low[2::POSE_SIZE], high[2::POSE_SIZE] = _LEAST_RADIUS_M, system.r_max_m

    def error(x: Floats) -> Floats:
        return weights * (robot_wrench(positions, moments, x, system.epm_moment_am2) - target)

    def cost(x: Floats) -> float:
        return 0.5 * float(error(x) @ error(x))

    def cost_slopes(x: Floats) -> Floats:
        by_pose: Floats = weights[:, None] * wrench_jacobian(positions, moments, x, system.epm_moment_am2)
        return np.asarray(by_pose.T @ error(x))

    def margins(x: Floats) -> Floats:
        return np.concatenate([clearances(x, positions, system.r_min_m)[0], gap_margins(x, system.gap_min_m)[0]])

    def margin_slopes(x: Floats) -> Floats:
        return np.concatenate([clearances(x, positions, system.r_min_m)[1], gap_margins(x, system.gap_min_m)[1]])

    least, best = math.inf, np.full(len(begun[0]), np.nan)
    for start in begun:
        found, reached = minimise_within(cost, cost_slopes, margins, margin_slopes, low, high, start, _OPTIONS)
        if reached < least and (margins(found) >= -_SLACK).all():
            least, best = reached, found
    return best


def clear_of_robots(pair: Pair, system: System, found: Activations, *, starts: int = 10, seed: int = 0) -> Activations:
    """Solve the same targets with r_min kept from each robot instead of from the workspace centre.

    By SciPy's sequential quadratic programming, from the poses that were found and from random ones; slow.

    Parameters
    ----------
    pair, system
        The robots, magnets and limits.
    found : Activations
        Targets and poses with r_min from the centre.
    starts, seed : int
        Random starts and their seed.
    """
    random = [project(start, system)[0] for start in draw_starts(system, starts, seed, False)]
    poses = np.array(
        [
            _solve_clear(pair, system, target, [pose, *random])
            for target, pose in zip(found.target, found.pose, strict=True)
        ]
    )
    wrench = robot_wrench(pair.positions, pair.moments(system), poses, system.epm_moment_am2)
    return replace(found, pose=poses, wrench=wrench)
