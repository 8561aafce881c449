"""The plant: commanded EPM poses move the EPMs, the EPMs move the robots, substep by substep. One for all.

``World`` steps any number of episodes; the scalar environment is a world of one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magenv.dynamics import TOUCH, WALL, Physics, advance, drag_factors
from magenv.kernels import kernel
from magenv.params import Plant, System, TaskParams
from magenv.trajectories import SEGMENTS, Trajectory, reference_kernel, reference_rows

Floats = NDArray[np.float64]

LOSSES = ("none", "deviation", "touch", "wall")
"""Kinds of loss of control by code: too far from the reference, bodies touched, wall reached."""
_DEVIATION, _TOUCH, _WALL = 1, 2, 3


@dataclass
class Measurements:
    """What a world measures of one hold, from the true state; arrays of length ``n``.

    Errors are means over both robots; without a suffix also over the substeps of the hold.
    """

    position_error_m: Floats
    heading_error_rad: Floats
    position_error_end_m: Floats
    heading_error_end_rad: Floats
    separation_min_m: Floats
    separation_tracked_m: Floats
    """Separation at the last instant of the episode at which both robots tracked; NaN where they never did."""
    substeps: NDArray[np.int64]
    """Substeps taken in the hold: fewer than a whole hold's where control was lost."""
    loss: NDArray[np.int64]
    """Code into ``LOSSES``."""

    @classmethod
    def empty(cls, n: int) -> Measurements:
        """Return the measurements of ``n`` episodes that have not begun."""
        return cls(
            position_error_m=np.zeros(n),
            heading_error_rad=np.zeros(n),
            position_error_end_m=np.zeros(n),
            heading_error_end_rad=np.zeros(n),
            separation_min_m=np.full(n, np.nan),
            separation_tracked_m=np.full(n, np.nan),
            substeps=np.zeros(n, np.int64),
            loss=np.zeros(n, np.int64),
        )


@kernel
def wrap(angle: float) -> float:
    """Return ``angle`` in [-pi, pi]."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@kernel
def move_epms(epms: Floats, targets: Floats) -> None:
    """Move the EPMs towards their targets for one substep. They jump, as in the paper; slower arms belong here."""
    epms[:] = targets


@kernel
def _hold(
    robots: Floats,
    epms: Floats,
    targets: Floats,
    physics: Physics,
    row: int,
    coefficients: Floats,
    duration: float,
    start: float,
    substeps: int,
    h: float,
    loss_distance: float,
    tracking_distance: float,
    tracked: float,
) -> tuple[float, float, float, float, float, float, int, int]:
    """Hold a command for one control period or until control is lost; return the fields of ``Measurements``."""
    force, reference, factors = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3, 2))
    drag_factors(physics, row, h, factors)
    position_sum, heading_sum, nearest = 0.0, 0.0, math.inf
    position_error, heading_error, loss, done = 0.0, 0.0, 0, 0
    while done < substeps and loss == 0:
        move_epms(epms, targets)
        contact = advance(robots, epms, physics, row, h, factors, force)
        done += 1
        reference_kernel(coefficients, duration, start + done * h, reference)
        first = math.hypot(robots[0, 0] - reference[0, 0], robots[0, 1] - reference[0, 1])
        second = math.hypot(robots[1, 0] - reference[1, 0], robots[1, 1] - reference[1, 1])
        position_error = 0.5 * (first + second)
        heading_error = 0.5 * (abs(wrap(robots[0, 2] - reference[0, 2])) + abs(wrap(robots[1, 2] - reference[1, 2])))
        position_sum += position_error
        heading_sum += heading_error
        separation = math.hypot(robots[1, 0] - robots[0, 0], robots[1, 1] - robots[0, 1])
        nearest = min(nearest, separation)
        farthest = max(first, second)
        if farthest <= tracking_distance:
            tracked = separation
        if contact & TOUCH:
            loss = _TOUCH
        elif contact & WALL:
            loss = _WALL
        elif not farthest <= loss_distance:  # true for NaN as well
            loss = _DEVIATION
    return position_sum / done, heading_sum / done, position_error, heading_error, nearest, tracked, done, loss


@kernel
def _hold_rows(
    active: NDArray[np.bool_],
    robots: Floats,
    epms: Floats,
    targets: Floats,
    physics: Physics,
    coefficients: Floats,
    duration: Floats,
    step: NDArray[np.int64],
    period: float,
    substeps: int,
    loss_distance: float,
    tracking_distance: float,
    position_error: Floats,
    heading_error: Floats,
    position_error_end: Floats,
    heading_error_end: Floats,
    separation_min: Floats,
    separation_tracked: Floats,
    substeps_done: NDArray[np.int64],
    loss: NDArray[np.int64],
) -> None:
    for i in range(len(active)):
        if active[i]:
            (
                position_error[i],
                heading_error[i],
                position_error_end[i],
                heading_error_end[i],
                separation_min[i],
                separation_tracked[i],
                substeps_done[i],
                loss[i],
            ) = _hold(
                robots[i],
                epms[i],
                targets[i],
                physics,
                i,
                coefficients[i],
                duration[i],
                step[i] * period,
                substeps,
                period / substeps,
                loss_distance,
                tracking_distance,
                separation_tracked[i],
            )
            step[i] += 1


class World:
    """The state of ``n`` episodes and the one law by which it moves.

    Attributes
    ----------
    robots : ndarray, shape (n, 2, 6)
        True states (see ``magenv.dynamics``).
    epms : ndarray, shape (n, N, 6)
        Centres (m) and unit moments of the EPMs.
    step_count : ndarray, shape (n,)
        Control periods since the start.
    """

    def __init__(self, n: int, system: System, plant: Plant, task: TaskParams) -> None:
        self.physics = Physics.of(system, plant, n)
        self.period_s = task.period_s
        # As many equal substeps as fit, none longer than the plant's.
        self.substeps = max(1, math.ceil(task.period_s / plant.substep_s - 1e-9))
        self._loss_distance = task.loss_distance_m
        self._tracking_distance = task.tracking_distance_m
        self.robots: Floats = np.zeros((n, 2, 6))
        self.epms: Floats = np.zeros((n, system.n_epm, 6))
        self.coefficients: Floats = np.zeros((n, 2, SEGMENTS, 3, 4))
        self.duration_s: Floats = np.ones(n)
        self.step_count: NDArray[np.int64] = np.zeros(n, np.int64)
        self.measurements = Measurements.empty(n)

    def start(self, row: int, trajectory: Trajectory, robots: Floats, epms: Floats) -> None:
        """Begin an episode in ``row`` with the given states (2, 6) and EPMs (N, 6)."""
        self.robots[row] = robots
        self.epms[row] = epms
        self.coefficients[row] = trajectory.coefficients
        self.duration_s[row] = trajectory.duration_s
        self.step_count[row] = 0
        self.measurements.loss[row] = 0
        away = np.hypot(*(robots[:, :2] - trajectory.at(0.0)[:, :2]).T)
        apart = float(np.hypot(*(robots[1, :2] - robots[0, :2])))
        self.measurements.separation_tracked_m[row] = apart if away.max() <= self._tracking_distance else np.nan

    def step(self, targets: Floats, active: NDArray[np.bool_]) -> Measurements:
        """Hold the commanded EPMs (n, N, 6) for one control period in every active row.

        Where control is lost, the row stops at that substep. Returns the world's own ``measurements``, overwritten at
        the next step.
        """
        m = self.measurements
        _hold_rows(
            active,
            self.robots,
            self.epms,
            targets,
            self.physics,
            self.coefficients,
            self.duration_s,
            self.step_count,
            self.period_s,
            self.substeps,
            self._loss_distance,
            self._tracking_distance,
            m.position_error_m,
            m.heading_error_rad,
            m.position_error_end_m,
            m.heading_error_end_rad,
            m.separation_min_m,
            m.separation_tracked_m,
            m.substeps,
            m.loss,
        )
        return m

    def time_s(self) -> Floats:
        """Return the time (n,) in s: the control instant, or the substep at which control was lost."""
        m = self.measurements
        instant = self.step_count.astype(np.float64) * self.period_s
        lost = (self.step_count - 1) * self.period_s + m.substeps * (self.period_s / self.substeps)
        return np.where(m.loss > 0, lost, instant)

    def references(self) -> Floats:
        """Return the references (n, 2, 3) at the current control instants: x, y (m), heading (rad)."""
        out = np.empty((len(self.robots), 2, 3))
        reference_rows(self.coefficients, self.duration_s, self.time_s(), out)
        return out

    def ended(self) -> NDArray[np.bool_]:
        """Return where the reference has come to its end."""
        ended: NDArray[np.bool_] = self.time_s() >= self.duration_s - 1e-9 * self.period_s
        return ended
