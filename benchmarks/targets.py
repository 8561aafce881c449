"""The fixed problems on which allocation is measured: three classes of twenty targets, and the starts of each.

A
    Wrenches of random allowed poses on robots placed at random within 60 mm: reachable.
B
    One component of U at 5 mN m or 0.05 N, all others zero; robots 15 cm apart, both parallel and both orthogonal to
    the line between them: ten components in two orientations, mostly reachable.
C
    The same at the paper's 0.05 N m or 0.5 N: mostly out of reach, bounds and gap active.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.allocation import component_scales
from magenv.allocation_input import random_starts
from magenv.params import System
from magenv.poses import pose_bounds, project
from magenv.wrench import N_ROBOTS, WRENCH_SIZE, planar_moments, robot_wrench

Floats = NDArray[np.float64]
TargetClass = Literal["A", "B", "C"]

CLASSES: tuple[TargetClass, ...] = ("A", "B", "C")
TARGETS = 20
STARTS = 10
PLACEMENT_M, SPACING_M = 0.06, 0.03
"""Class A: robots' coordinates are at most the first, their distance at least the second."""
SEPARATION_M = 0.15
SHARES: dict[TargetClass, float] = {"B": 0.1, "C": 1.0}
"""Size of the one component as a share of the paper's 0.05 N m or 0.5 N."""


class Problem(NamedTuple):
    """Arguments of ``magenv.allocation.allocate``."""

    target: Floats
    """U_d (10), N m and N."""
    positions: Floats
    """Of the robots (2, 3), m."""
    moments: Floats
    """Of the robots (2, 3), A m^2."""
    system: System


def problem(target_class: TargetClass, index: int, n_epm: int = 2) -> Problem:
    """Return the problem of a class with the given index; class A has one for every index, B and C have 20."""
    system = System(n_epm=n_epm)
    positions = np.zeros((N_ROBOTS, 3))
    if target_class == "A":
        rng = np.random.default_rng(index)
        while np.linalg.norm(positions[0] - positions[1]) < SPACING_M:
            positions[:, :2] = rng.uniform(-PLACEMENT_M, PLACEMENT_M, (N_ROBOTS, 2))
        moments = planar_moments(rng.uniform(-np.pi, np.pi, N_ROBOTS), system.ipm_moment_am2)
        pose, _ = project(rng.uniform(*pose_bounds(system)), system)
        return Problem(robot_wrench(positions, moments, pose, system.epm_moment_am2), positions, moments, system)
    orientation, component = divmod(index, WRENCH_SIZE)
    positions[:, 0] = 0.5 * SEPARATION_M, -0.5 * SEPARATION_M
    target = np.zeros(WRENCH_SIZE)
    target[component] = SHARES[target_class] * component_scales()[component]
    headings = np.full(N_ROBOTS, (0.0, 0.5 * np.pi)[orientation])
    return Problem(target, positions, planar_moments(headings, system.ipm_moment_am2), system)


def starts(index: int, system: System) -> Floats:
    """Return the ten starts (10, 5 N) of a target: those of ``allocate`` with the index as its seed."""
    return random_starts(system, STARTS, np.random.default_rng(index))
