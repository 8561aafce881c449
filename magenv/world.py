"""The plant: commanded EPM poses move the EPMs, the EPMs move the robots, substep by substep. One for all.

``World`` steps any number of episodes; the scalar environment is a world of one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magenv.dynamics import Physics, constants
from magenv.hold import AT_ONCE, LATE, LOSSES, TRAVELLING, hold_kernel
from magenv.kernels import kernel, law
from magenv.lanes import CONSTANTS_SIZE, ROUTE_SIZE
from magenv.params import Plant, System, TaskParams, require
from magenv.poses import EPM_SIZE, POSE_SIZE, epms_to_poses
from magenv.trajectories import SEGMENTS, Trajectory, extent, reference_of, trajectory_of
from magenv.travel import Motion
from magenv.workers import Workers

__all__ = ["LOSSES", "Measurements", "World"]

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]

_WIDTH = 16
"""Lanes of a batch: several vectors, so that the processor always has independent work."""
_FEW = 4
"""Up to so many episodes a single lane is faster."""


class Measurements:
    """What a world measures of one hold, from the true state; arrays of length ``n``, rows of two tables.

    Errors are means over both robots; without a suffix also over the substeps of the hold.

    Attributes
    ----------
    position_error_m, heading_error_rad, position_error_end_m, heading_error_end_rad, separation_min_m
        As named.
    separation_tracked_m
        Separation at the last instant of the episode at which both robots tracked; NaN where they never did.
    substeps
        Substeps taken in the hold: fewer than a whole hold's where control was lost.
    loss
        Code into ``LOSSES``.
    """

    NUMBERS = (
        "position_error_m",
        "heading_error_rad",
        "position_error_end_m",
        "heading_error_end_rad",
        "separation_min_m",
        "separation_tracked_m",
    )
    COUNTS = ("substeps", "loss")

    def __init__(self, n: int) -> None:
        self.numbers: Floats = np.zeros((len(self.NUMBERS), n))
        self.counts: NDArray[np.int64] = np.zeros((len(self.COUNTS), n), np.int64)
        self.numbers[4:] = np.nan

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name in self.NUMBERS + self.COUNTS:  # not kept: copies of this object would hold copies of the rows
            numbers = name in self.NUMBERS
            row: NDArray[Any] = (
                self.numbers[self.NUMBERS.index(name)] if numbers else self.counts[self.COUNTS.index(name)]
            )
            return row
        raise AttributeError(name)


def check_extent(reach_and_gap: tuple[float, float], plant: Plant, name: str, received: object) -> None:
    """Raise ``ValueError`` unless bodies fit that go so far from the workspace's centre, so near to each other (m)."""
    (reach, gap), width = reach_and_gap, plant.body.diameter_m
    must_be = f"such that bodies {1e3 * width:g} mm wide keep off each other and the wall at "
    must_be += f"{1e3 * plant.workspace_radius_m:g} mm"
    require(reach + 0.5 * width < plant.workspace_radius_m and gap > width, name, must_be, received)


@law
def _distance(dx: float, dy: float) -> float:
    """Return the length of (dx, dy): without the call that ``math.hypot`` is."""
    return math.sqrt(dx * dx + dy * dy)


@kernel
def begin_rows(
    first: int,
    last: int,
    mask: Bools,
    robots: Floats,
    coefficients: Floats,
    duration: Floats,
    tracking_distance: float,
    routes: Floats,
    step: Integers,
    numbers: Floats,
    counts: Integers,
) -> None:
    """Begin episodes where ``mask`` says, with the states and trajectories that the rows hold."""
    reference = np.empty((1, 2, 3))
    for i in range(first, last):
        if mask[i]:
            step[i] = 0
            counts[1, i] = 0
            if len(routes) > 0:
                routes[i] = 0.0  # the EPMs are at rest
            which = trajectory_of(i, len(duration))
            reference_of(coefficients, which, duration[which], 0.0, reference, 0)
            (x1, y1), (x2, y2) = (robots[i, 0, 0], robots[i, 0, 1]), (robots[i, 1, 0], robots[i, 1, 1])
            away1 = _distance(x1 - reference[0, 0, 0], y1 - reference[0, 0, 1])
            away2 = _distance(x2 - reference[0, 1, 0], y2 - reference[0, 1, 1])
            numbers[5, i] = _distance(x2 - x1, y2 - y1) if max(away1, away2) <= tracking_distance else math.nan


@law
def time_of(step: int, substeps_done: int, loss: int, period: float, substeps: int) -> float:
    """Return the time (s) of a row: the control instant, or the substep at which control was lost."""
    lost = (step - 1) * period + substeps_done * (period / substeps)
    return lost if loss > 0 else step * period


@kernel
def describe_rows(
    first: int,
    last: int,
    mask: Bools,
    coefficients: Floats,
    duration: Floats,
    step: Integers,
    counts: Integers,
    period: float,
    substeps: int,
    epms: Floats,
    time: Floats,
    references: Floats,
    poses: Floats,
) -> None:
    """Write times (n,), references (n, 2, 3) at these times and the EPMs' pose vectors (n, 5 N) where ``mask`` says."""
    n_epm, i = epms.shape[1], first
    while i < last:
        start = i
        while i < last and mask[i]:
            which = trajectory_of(i, len(duration))
            time[i] = time_of(step[i], counts[0, i], counts[1, i], period, substeps)
            if i > start and which < i and time[i] == time[i - 1]:  # on one trajectory for all, as the row before
                for j in range(6):
                    references[i, j // 3, j % 3] = references[i - 1, j // 3, j % 3]
            else:
                reference_of(coefficients, which, duration[which], time[i], references, i)
            i += 1
        if i > start:  # neighbours together, so that their angles are vectorised
            epms_to_poses(epms.reshape(-1, EPM_SIZE), start * n_epm, i * n_epm, poses.reshape(-1, POSE_SIZE))
        else:
            i += 1


class World:
    """The state of ``n`` episodes and the one law by which it moves.

    Parameters
    ----------
    n : int
        Number of episodes.
    system, plant, task
        Their parameters.
    trajectory : Trajectory, optional
        The one that all episodes follow; without, each has its own.
    workers : Workers, optional
        Threads to share the episodes; without, the calling one.

    Attributes
    ----------
    robots : ndarray, shape (n, 2, 6)
        True states (see ``magenv.dynamics``).
    epms : ndarray, shape (n, N, 6)
        Centres (m) and unit moments of the EPMs.
    step_count : ndarray, shape (n,)
        Control periods since the start.
    coefficients, duration_s : ndarray, shape (n or 1, 32, 2, 3, 4) and (n or 1,)
        The trajectories; one where all rows follow the same.
    constants : ndarray, shape (n, 10)
        Of a substep, see ``magenv.dynamics.constants``.
    shape : tuple
        Number of EPMs, lanes of the hold, how commands act, whether the plant is rough.
    routes, queue, slow, rubs
        How the EPMs move, commands that do not act yet, what disturbs and rubs the robots: see ``hold.hold_rows``.
    motion : Motion
        Limits of the EPMs' motion.
    held : tuple
        The last arguments of the hold, the same at every step.
    """

    def __init__(
        self,
        n: int,
        system: System,
        plant: Plant,
        task: TaskParams,
        trajectory: Trajectory | None = None,
        workers: Workers | None = None,
    ) -> None:
        if trajectory is not None:
            check_extent(extent(trajectory), plant, "trajectory", extent(trajectory))
        self._plant = plant
        self.physics = Physics.of(system, plant, n)
        self.period_s = task.period_s
        self.substeps = plant.substeps(task.period_s)
        self._tracking_distance = task.tracking_distance_m
        self._workers = workers or Workers()
        moves = TRAVELLING if not plant.epms_jump else LATE if plant.latency_s > 0.0 else AT_ONCE
        self.shape = (system.n_epm, 1 if n <= _FEW else _WIDTH, moves, plant.is_rough)
        self._hold = hold_kernel(*self.shape)
        self.robots: Floats = np.zeros((n, 2, 6))
        self.epms: Floats = np.zeros((n, system.n_epm, 6))
        own = n if trajectory is None else 1
        self.coefficients: Floats = np.zeros((own, SEGMENTS, 2, 3, 4))
        self.duration_s: Floats = np.ones(own)
        if trajectory is not None:
            self.coefficients[0], self.duration_s[0] = trajectory.coefficients, trajectory.duration_s
        self.step_count: Integers = np.zeros(n, np.int64)
        self.measurements = Measurements(n)
        self.motion = Motion.of(system, plant, task.period_s / self.substeps, self.substeps)
        travels = n if moves == TRAVELLING else 0
        self.routes: Floats = np.zeros((travels, system.n_epm, ROUTE_SIZE))
        late = n if moves != AT_ONCE else 0
        self.queue: Floats = np.zeros((late, 1 + self.motion.wait, system.n_epm, EPM_SIZE))
        self.slow: Floats = np.zeros((n if plant.is_rough else 0, 2, 3))
        self.rubs = plant.disturbance_n, plant.dry_friction_n, plant.dry_friction_nm
        self.constants: Floats = np.empty((n, CONSTANTS_SIZE))
        constants(self.physics, task.period_s / self.substeps, self.constants)
        self.held = (
            self.constants,
            self.physics.mass,
            self.physics.epm_moment,
            self.physics.epm_size,
            self.coefficients,
            self.duration_s,
            self.step_count,
            self.measurements.numbers,
            self.measurements.counts,
            self.period_s,
            self.substeps,
            task.loss_distance_m,
            task.tracking_distance_m,
            self.physics.body_diameter,
            self.physics.wall_radius,
            self.motion,
            self.routes,
            self.queue,
            self.slow,
            self.rubs,
        )

    def start(self, row: int, trajectory: Trajectory, robots: Floats, epms: Floats) -> None:
        """Begin an episode in ``row``, which has a trajectory of its own, with given states (2, 6) and EPMs (N, 6).

        Raises
        ------
        ValueError
            If states or EPMs are not such arrays of finite numbers, or the bodies do not fit at the start or on their
            references.
        """
        for name, value, shape in (("robots", robots, (2, 6)), ("epms", epms, self.epms.shape[1:])):
            fits = np.shape(value) == shape and bool(np.isfinite(value).all())
            require(fits, name, f"a finite array of shape {shape}", np.shape(value))
        check_extent(extent(trajectory), self._plant, "trajectory", extent(trajectory))
        reach, gap = float(np.hypot(*robots[:, :2].T).max()), math.dist(robots[0, :2], robots[1, :2])
        check_extent((reach, gap), self._plant, "robots", robots[:, :2].tolist())
        self.robots[row] = robots
        self.epms[row] = epms
        self.coefficients[row] = trajectory.coefficients
        self.duration_s[row] = trajectory.duration_s
        self.begin(np.arange(len(self.robots)) == row)

    def begin(self, mask: Bools) -> None:
        """Begin episodes where ``mask`` says, with the states, EPMs and trajectories that the rows hold."""
        m = self.measurements
        self._workers.run(
            begin_rows,
            len(mask),
            mask,
            self.robots,
            self.coefficients,
            self.duration_s,
            self._tracking_distance,
            self.routes,
            self.step_count,
            m.numbers,
            m.counts,
        )

    def trajectory(self, row: int) -> Trajectory:
        """Return the trajectory that a row follows."""
        which = min(row, len(self.duration_s) - 1)
        return Trajectory(float(self.duration_s[which]), self.coefficients[which])

    def step(self, targets: Floats, active: Bools) -> Measurements:
        """Hold the commanded EPMs (n, N, 6) for one control period in every active row.

        Where control is lost, the row stops at that substep. Returns the world's own ``measurements``, overwritten at
        the next step.
        """
        self._workers.run(self._hold, len(self.robots), active, self.robots, self.epms, targets, *self.held)
        return self.measurements

    def time_s(self, row: int) -> float:
        """Return the time of a row in s: the control instant, or the substep at which control was lost."""
        done, loss = self.measurements.counts[:, row].tolist()
        return time_of(int(self.step_count[row]), done, loss, self.period_s, self.substeps)
