"""Where plans and trims are sought: poses that hold the robots by statics, poses a little beside others.

And by what they are compared before it is known how well the state is: the growth of a doubt that is always the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magenv.actions import planar_target
from magenv.allocation import allocate
from magenv.params import InputError, Plant, System
from magenv.poses import to_cartesian
from magenv.sensitivity import COORDINATES
from magenv.wrench import IN_PLANE, WRENCH_SIZE, planar_moments

Floats = NDArray[np.float64]

DOUBT = np.diag([1e-3, 1e-3, 0.03] * 2 + [0.0] * COORDINATES)
"""(12, 12) root of a state's covariance: errors of the coordinates, m and rad, none of the rates."""


class Statics:
    """Static holds on a nominal plant, found from random poses on: their wrench is what drag and a push ask for."""

    def __init__(self, system: System, plant: Plant) -> None:
        self._system, body = system, plant.body
        self._drag = np.array([body.drag_linear_nspm, body.drag_linear_nspm, body.drag_rotational_nmsprad] * 2)

    def hold(self, coordinates: Floats, rates: Floats, pushing: Floats, rng: np.random.Generator) -> Floats | None:
        """Return EPMs (N, 6) that hold the robots' coordinates (6,) at rates (6,), as nearly as a search finds.

        ``pushing`` (6,) acts besides, N and N m. Moments are the nominal ones. None where nothing can be sought.
        """
        target, positions = np.empty(WRENCH_SIZE), np.zeros((2, 3))
        planar_target(self._drag * rates - pushing, coordinates[2], coordinates[5], target)
        positions[:, :2] = coordinates.reshape(2, 3)[:, :2]
        moments = planar_moments(coordinates[2::3], self._system.ipm_moment_am2)
        try:
            held = allocate(target, positions, moments, self._system, starts=1, seed=rng, components=IN_PLANE)
        except InputError:  # robots on the same spot, or a state that is not finite
            return None
        epms: Floats = np.concatenate(to_cartesian(held.pose), axis=-1)
        return epms


def beside(epms: Floats, deviation: Floats, rng: np.random.Generator) -> Floats:
    """Return EPMs (..., 6) a little beside the given ones, by standard deviations (6,)."""
    moved: Floats = epms + rng.normal(size=epms.shape) * deviation
    moved[..., 3:] /= np.linalg.norm(moved[..., 3:], axis=-1, keepdims=True)
    return moved
