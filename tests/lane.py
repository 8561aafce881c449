"""One lane of the plant, stepped by the integrator alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magenv.dynamics import Physics, advance, constants, may_touch
from magenv.lanes import CONSTANTS, CONSTANTS_SIZE, fields
from magenv.magnets import place_epm, robots_wrench
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
        place_epm(lane, 0, k, physics.epm_size, physics.epm_moment[0, k], *epm)
    return lane


def wrenches(robots: Floats, epms: Floats, physics: Physics) -> Floats:
    """F_x, F_y, tau_z (2, 3) on the robots."""
    lane = one_lane(robots, epms, physics, 0.005)
    out = robots_wrench(lane, 0, len(epms), physics.epm_size, *robots[0, :3], *robots[1, :3])
    return np.array(out).reshape(2, 3)


def run(robots: Floats, epms: Floats, plant: Plant, h: float, steps: int, system: System = SYSTEM) -> Floats:
    """Return the states (steps + 1, 2, 6) of a run without contact."""
    physics = Physics.of(system, plant, 1)
    lane = one_lane(robots, epms, physics, h)
    path = [robots.copy()]
    for _ in range(steps):
        advance(lane, 0, len(epms), physics.epm_size, h, False)
        assert not may_touch(lane, 0, plant.body.diameter_m, plant.workspace_radius_m)
        path.append(lane[:12, 0].reshape(6, 2).T.copy())
    return np.array(path)
