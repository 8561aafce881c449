"""Reference trajectories of both robots: the named scenarios and the seeded random family for training.

A trajectory is a cubic spline through position and heading of both robots, in equal segments of time.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from magenv.kernels import kernel
from magenv.params import require

Floats = NDArray[np.float64]

SEGMENTS = 32
"""Spline segments of every trajectory."""
DURATION_S = 100.0
HALF_LENGTH_M = 0.060
"""The approach scenarios run from -60 mm to 60 mm in x."""
HALF_WIDTH_M = 0.050
"""Distance of each robot from the x axis at both ends of an approach scenario."""

SCENARIO_HELP = "random, approach-<s> or approach-<s>-anti with s from 12 to 100 (mm)"
_APPROACH = re.compile(r"approach-(\d+(?:\.\d+)?)(-anti)?", re.ASCII)

RANDOM_SEPARATION_M = (0.025, 0.100)
"""Range of the least separation in the random family."""
_RANDOM_RADIUS_M = 0.082
_RANDOM_SPEED_MIN_MPS = 2e-4
_RANDOM_TURN_MAX_RADPS = 0.1

# Interpolation is linear in the knots: this matrix (32 segments x 4 ascending powers, 33 knots) is SciPy's spline.
_SPLINE: Floats = (
    CubicSpline(np.arange(SEGMENTS + 1), np.eye(SEGMENTS + 1)).c[::-1].transpose(1, 0, 2).reshape(-1, SEGMENTS + 1)
)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Spline of both robots' reference: ``coefficients`` (2 robots, 32 segments, x / y / heading, 4 powers)."""

    duration_s: float
    coefficients: Floats

    @classmethod
    def through(cls, duration_s: float, knots: Floats) -> Trajectory:
        """Return the twice continuously differentiable spline through ``knots`` (33, 2, 3), equally spaced in time."""
        coefficients = (_SPLINE @ knots.reshape(SEGMENTS + 1, 6)).reshape(SEGMENTS, 4, 2, 3)
        return cls(duration_s, np.ascontiguousarray(coefficients.transpose(2, 0, 3, 1)))

    def at(self, time_s: float) -> Floats:
        """Return x, y (m) and heading (rad, not wrapped) of both robots (2, 3), held still outside the duration."""
        out = np.empty((2, 3))
        reference_kernel(self.coefficients, self.duration_s, float(time_s), out)
        return out


@kernel
def reference_kernel(coefficients: Floats, duration: float, time: float, out: Floats) -> None:
    """Write the reference (2, 3) at ``time`` (s) into ``out``."""
    position = min(max(time / duration, 0.0), 1.0) * SEGMENTS
    segment = min(int(position), SEGMENTS - 1)
    u = position - segment
    for robot in range(2):
        for axis in range(3):
            c = coefficients[robot, segment, axis]
            out[robot, axis] = c[0] + u * (c[1] + u * (c[2] + u * c[3]))


@kernel
def reference_rows(coefficients: Floats, duration: Floats, time: Floats, out: Floats) -> None:
    """Write the references (n, 2, 3) of n trajectories at their times (n,)."""
    for i in range(len(out)):
        reference_kernel(coefficients[i], duration[i], time[i], out[i])


def _along_path(positions: Floats, velocities: Floats, flip_second: bool) -> Floats:
    """Return knots (33, 2, 3) with headings along the velocities, robot 2's turned by pi where asked."""
    headings = np.unwrap(np.arctan2(velocities[..., 1], velocities[..., 0]), axis=0)
    if flip_second:
        headings[:, 1] += math.pi
    return np.concatenate([positions, headings[..., None]], axis=-1)


def approach(separation_m: float, anti: bool = False) -> Trajectory:
    """Return the scenario in which the robots come to ``separation_m`` of each other side by side and part again.

    Robot 1 runs along x at constant speed, its y a parabola from -50 mm to half the separation, robot 2 mirrored;
    headings along the path, robot 2's turned by pi where ``anti``.
    """
    require(0.012 <= separation_m <= 0.100, "separation_m", "from 0.012 to 0.100", separation_m)
    u = np.linspace(-1.0, 1.0, SEGMENTS + 1)
    depth = HALF_WIDTH_M - separation_m / 2
    y = separation_m / 2 + depth * u**2
    positions = np.stack([np.stack([HALF_LENGTH_M * u, side * y], axis=-1) for side in (-1.0, 1.0)], axis=1)
    velocities = np.stack(
        [np.stack([np.full_like(u, HALF_LENGTH_M), side * 2 * depth * u], axis=-1) for side in (-1.0, 1.0)], axis=1
    )
    return Trajectory.through(DURATION_S, _along_path(positions, velocities, anti))


def random_trajectory(rng: np.random.Generator) -> Trajectory:
    """Draw a trajectory of the training family.

    The robots' midpoint travels through the workspace in a random direction on a bent path, while the line between
    them turns slowly and its length falls to a random least separation and grows again; either robot may be on the
    left. Headings are along the paths. Draws that leave the workspace, nearly stop or turn fast are drawn anew.
    """
    u = np.linspace(-1.0, 1.0, SEGMENTS + 1)
    while True:
        closest, widest = np.sort(rng.uniform(*RANDOM_SEPARATION_M, size=2))
        moment = rng.uniform(-0.6, 0.6)
        distance = closest + (widest - closest) * ((u - moment) / (1 + abs(moment))) ** 2
        distance_rate = 2 * (widest - closest) * (u - moment) / (1 + abs(moment)) ** 2
        bend = rng.normal(0.0, [0.010, 0.010, 0.006])
        line = rng.normal(0.0, [0.35, 0.25, 0.25]) + np.array([rng.choice([-0.5, 0.5]) * math.pi, 0.0, 0.0])
        half_length = rng.uniform(0.030, 0.065)
        centre = np.stack([half_length * u, bend[0] + bend[1] * u**2 + bend[2] * u**3], axis=-1)
        centre_rate = np.stack([np.full_like(u, half_length), 2 * bend[1] * u + 3 * bend[2] * u**2], axis=-1)
        angle = line[0] + line[1] * u + line[2] * u**2
        angle_rate = line[1] + 2 * line[2] * u
        along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        across = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
        half = 0.5 * distance[:, None] * along
        half_rate = 0.5 * (distance_rate[:, None] * along + (distance * angle_rate)[:, None] * across)
        direction = rng.uniform(-math.pi, math.pi)
        turn = np.array([[math.cos(direction), math.sin(direction)], [-math.sin(direction), math.cos(direction)]])
        positions = np.stack([centre - half, centre + half], axis=1) @ turn
        velocities = np.stack([centre_rate - half_rate, centre_rate + half_rate], axis=1) @ turn
        knots = _along_path(positions, velocities, flip_second=False)
        speed = np.linalg.norm(velocities, axis=-1) * 2 / DURATION_S
        turn_rate = np.abs(np.diff(knots[..., 2], axis=0)) * SEGMENTS / DURATION_S
        if (
            np.linalg.norm(positions, axis=-1).max() <= _RANDOM_RADIUS_M
            and speed.min() >= _RANDOM_SPEED_MIN_MPS
            and turn_rate.max() <= _RANDOM_TURN_MAX_RADPS
        ):
            return Trajectory.through(DURATION_S, knots)


def check_scenario(scenario: str) -> None:
    """Raise ``ValueError`` unless ``scenario`` names a scenario."""
    draw(scenario, np.random.default_rng(0))


def draw(scenario: str, rng: np.random.Generator) -> Trajectory:
    """Return the trajectory of a named scenario, drawing from ``rng`` for ``random`` alone.

    Raises
    ------
    ValueError
        If the name is unknown.
    """
    if scenario == "random":
        return random_trajectory(rng)
    match = _APPROACH.fullmatch(scenario) if isinstance(scenario, str) else None
    require(match is not None and 12 <= float(match[1]) <= 100, "scenario", SCENARIO_HELP, scenario)
    assert match is not None
    return approach(float(match[1]) / 1000, anti=match[2] is not None)
