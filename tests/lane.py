"""One lane of the plant, stepped by the integrator alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magenv.dynamics import Physics, advance, constants, may_touch, place_epm
from magenv.lanes import CONSTANTS, CONSTANTS_SIZE, fields
from magenv.params import Plant, System
from magenv.poses import pose_bounds, project, to_cartesian

Floats = NDArray[np.float64]

SYSTEM = System()


def magnets(rng: np.random.Generator, system: System = SYSTEM) -> Floats:
    """Allowed EPMs (N, 6)."""
    pose, _ = project(rng.uniform(*pose_bounds(system)), system)
    return np.concatenate(to_cartesian(pose), axis=-1)


def one_lane(robots: Floats, epms: Floats, physics: Physics, h: float) -> Floats:
    """A single lane (fields, 1) with these robots (2, 6) and EPMs (N, 6)."""
    lane, row = np.zeros((fields(len(epms), False), 1)), np.empty((1, CONSTANTS_SIZE))
    constants(physics, h, row)
    lane[:12, 0] = robots.T.reshape(-1)  # both robots' x, then both y, ...
    lane[CONSTANTS : CONSTANTS + CONSTANTS_SIZE, 0] = row
    for k, epm in enumerate(epms):
        place_epm(lane, 0, k, physics.epm_moment[0, k], *epm)
    return lane


def run(robots: Floats, epms: Floats, plant: Plant, h: float, steps: int, system: System = SYSTEM) -> Floats:
    """Return the states (steps + 1, 2, 6) of a run without contact."""
    lane = one_lane(robots, epms, Physics.of(system, plant, 1), h)
    path = [robots.copy()]
    for _ in range(steps):
        advance(lane, 0, len(epms), h, False)
        assert not may_touch(lane, 0, plant.body.diameter_m, plant.workspace_radius_m)
        path.append(lane[:12, 0].reshape(6, 2).T.copy())
    return np.array(path)
