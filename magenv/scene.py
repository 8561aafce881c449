"""What a picture of an episode shows, at one time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magenv.params import require
from magenv.world import LOSSES, World

Floats = NDArray[np.float64]

PATH_SAMPLES = 201
"""Samples of the reference path in a ``Scene`` of a world."""


@dataclass(frozen=True, eq=False)
class Scene:
    """What a picture shows, at one time."""

    time_s: float
    duration_s: float
    """Of the whole reference."""
    robots: Floats
    """(2, 3) true x, y (m), heading (rad)."""
    reference: Floats
    """(2, 3) reference at this time: x, y (m), heading (rad)."""
    path: Floats
    """(k, 2, 2) reference of both robots over the whole duration: x, y (m)."""
    epm_positions: Floats
    """(N, 3) m."""
    epm_directions: Floats
    """(N, 3) unit moments."""
    loss: int = 0
    """Code into ``magenv.world.LOSSES``."""

    def __post_init__(self) -> None:
        require(self.robots.shape == (2, 3), "robots", "an array of shape (2, 3)", self.robots.shape)
        require(self.reference.shape == (2, 3), "reference", "an array of shape (2, 3)", self.reference.shape)
        require(self.path.shape[1:] == (2, 2), "path", "an array of shape (k, 2, 2)", self.path.shape)
        epms = self.epm_positions.shape
        require(len(epms) == 2 and epms[1] == 3, "epm_positions", "an array of shape (N, 3)", epms)
        require(self.epm_directions.shape == epms, "epm_directions", f"of shape {epms}", self.epm_directions.shape)
        require(self.loss in range(len(LOSSES)), "loss", f"from 0 to {len(LOSSES) - 1}", self.loss)

    @property
    def position_error_m(self) -> float:
        """Distance from the reference, mean of the robots, in m."""
        return float(np.hypot(*(self.robots - self.reference)[:, :2].T).mean())

    @property
    def heading_error_rad(self) -> float:
        """Angle to the reference, absolute, mean of the robots, in rad."""
        differences = (self.robots - self.reference)[:, 2]
        if not np.isfinite(differences).all():
            return math.nan
        return sum(abs(math.remainder(difference, 2 * math.pi)) for difference in differences) / 2

    @property
    def separation_m(self) -> float:
        """Distance of the robots' centres in m."""
        return math.dist(self.robots[0, :2], self.robots[1, :2])


def scene_of(world: World, row: int) -> Scene:
    """Return a copy of what there is to see of one episode; where control is lost, at that very instant."""
    trajectory = world.trajectory(row)
    time = world.time_s(row)
    samples = np.linspace(0.0, trajectory.duration_s, PATH_SAMPLES)
    return Scene(
        time_s=time,
        duration_s=trajectory.duration_s,
        robots=world.robots[row, :, :3].copy(),
        reference=trajectory.at(time),
        path=np.stack([trajectory.at(sample)[:, :2] for sample in samples]),
        epm_positions=world.epms[row, :, :3].copy(),
        epm_directions=world.epms[row, :, 3:].copy(),
        loss=int(world.measurements.loss[row]),
    )
