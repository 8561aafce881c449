"""The five action modes: what a number in [-1, 1] does to the poses of the EPMs.

Mode         Size  An action is
``home``     5 N   an offset from the home configuration in the frame carried by the robots (measured headings)
``pose``     5 N   an absolute pose in the global frame, scaled from its bounds
``step``     5 N   a change of the present pose
``wrench``   6     F_x, F_y, tau_z on each robot in the global frame, turned into poses by ``allocation``
``velocity`` 6     v_x, v_y, rate of each robot in the frame carried by the robots, turned into poses by ``steering``
"""

from __future__ import annotations

import math
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from magenv.allocation import component_scales
from magenv.home import home_epms, home_rows, start_rows
from magenv.kernels import kernel, typed
from magenv.outcome import FELL_BACK, outcome_of
from magenv.params import Plant, System, require
from magenv.poses import (
    EPM_SIZE,
    LANES,
    LANES_SIZE,
    POSE_SIZE,
    command_lanes,
    epm_to_pose,
    home_pose,
    place_lanes,
    pose_bounds,
    pose_lanes,
    pose_to_epm,
    robots_frame,
)
from magenv.reach import EVERYWHERE, Shell, make_allowed, project_within
from magenv.sensitivity import COORDINATES
from magenv.solver import best_of, relative_scale
from magenv.steering_cost import Steering
from magenv.velocity import velocity_rows
from magenv.workers import Workers
from magenv.wrench import WRENCH_SIZE

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]
ActionMode = Literal["home", "pose", "step", "wrench", "velocity"]
PLANAR: tuple[ActionMode, ...] = ("wrench", "velocity")
"""Modes that ask for something of the robots, two axes and a turn of each, and solve for the poses."""

STEP_ANGLE_RAD = 0.3
STEP_RADIUS_M = 0.05
WRENCH_FORCE_N = 0.020
WRENCH_TORQUE_NM = 0.001

_FALLBACK_STARTS = 4
_TOLERANCE = 1e-6
_MAX_ITERATIONS, _STOP_EARLY = typed(60), typed(True)


@kernel
def pose_rows(
    first: int,
    last: int,
    active: Bools,
    actions: Floats,
    low: Floats,
    high: Floats,
    limits: Floats,
    targets: Floats,
    projected: Bools,
) -> None:
    """Write the EPMs (n, N, 6) at absolute poses: ``actions`` (n, 5 N) from ``low`` to ``high``."""
    lanes = np.zeros((LANES_SIZE, LANES))
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        for k in range(targets.shape[1]):
            for j in range(POSE_SIZE):
                at = POSE_SIZE * k + j
                for i in range(count):
                    lanes[j, i] = low[at] + 0.5 * (actions[start + i, at] + 1.0) * (high[at] - low[at])
            place_lanes(lanes)
            command_lanes(lanes, start, count, k, active, targets)
        for i in range(start, start + count):
            if active[i]:
                projected[i] = make_allowed(targets, i, limits)


@kernel
def step_rows(
    first: int,
    last: int,
    active: Bools,
    actions: Floats,
    epms: Floats,
    limits: Floats,
    targets: Floats,
    projected: Bools,
) -> None:
    """Write the EPMs (n, N, 6) whose poses differ by ``actions`` (n, 5 N) from those of ``epms``."""
    lanes = np.zeros((LANES_SIZE, LANES))
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        for k in range(targets.shape[1]):
            for i in range(count):
                for j in range(EPM_SIZE):
                    lanes[POSE_SIZE + j, i] = epms[start + i, k, j]
            pose_lanes(lanes)
            for i in range(count):
                for j in range(POSE_SIZE):
                    most = STEP_RADIUS_M if j == 2 else STEP_ANGLE_RAD
                    lanes[j, i] += actions[start + i, POSE_SIZE * k + j] * most
                lanes[2, i] = min(max(lanes[2, i], limits[0]), limits[1])
            place_lanes(lanes)
            command_lanes(lanes, start, count, k, active, targets)
        for i in range(start, start + count):
            if active[i]:
                projected[i] = make_allowed(targets, i, limits)


@kernel
def planar_target(wrench: Floats, heading_1: float, heading_2: float, target: Floats) -> None:
    """Write U_d (10) of planar wrenches (F_x, F_y, tau_z per robot, global frame); out-of-plane components zero."""
    for robot, heading in ((0, heading_1), (1, heading_2)):
        c, s = math.cos(heading), math.sin(heading)
        fx, fy = wrench[3 * robot], wrench[3 * robot + 1]
        at = 5 * robot
        target[at], target[at + 1] = 0.0, wrench[3 * robot + 2]
        target[at + 2], target[at + 3], target[at + 4] = c * fx + s * fy, c * fy - s * fx, 0.0


@kernel
def wrench_rows(
    first: int,
    last: int,
    active: Bools,
    actions: Floats,
    measured: Floats,
    epms: Floats,
    starts: Floats,
    ipm_moment: float,
    epm_moment: float,
    scale: Floats,
    limits: Floats,
    targets: Floats,
    projected: Bools,
    solver: Integers,
) -> None:
    """Write the EPMs (n, N, 6) that exert the wrenches ``actions`` (n, 6), as found from ``starts`` (k, 5 N).

    Writes into ``solver`` (n,) how that ended, codes into ``outcome.OUTCOMES``. Where nothing is found, ``targets``
    stay as they are: the last command. What is found is never worse, since the present poses are the first start.
    """
    n_epm = targets.shape[1]
    size = POSE_SIZE * n_epm
    positions, moments = np.zeros((2, 3)), np.zeros((2, 3))
    wrench, target, relative = np.empty(6), np.empty(WRENCH_SIZE), np.empty(WRENCH_SIZE)
    best_pose, best_wrench = np.empty(size), np.empty(WRENCH_SIZE)
    for i in range(first, last):
        if not active[i]:
            continue
        for robot in range(2):
            positions[robot, 0], positions[robot, 1] = measured[i, robot, 0], measured[i, robot, 1]
            moments[robot, 0] = ipm_moment * math.cos(measured[i, robot, 2])
            moments[robot, 1] = ipm_moment * math.sin(measured[i, robot, 2])
            for j in range(3):
                wrench[3 * robot + j] = actions[i, 3 * robot + j] * (WRENCH_TORQUE_NM if j == 2 else WRENCH_FORCE_N)
        planar_target(wrench, measured[i, 0, 2], measured[i, 1, 2], target)
        relative_scale(target, scale, relative)
        poses = starts.copy()
        frame = robots_frame(measured[i, 0, 2], measured[i, 1, 2])
        for k in range(n_epm):
            poses[1, POSE_SIZE * k] += frame
            poses[1, POSE_SIZE * k + 3] += frame
            epm_to_pose(epms[i, k], poses[0, POSE_SIZE * k : POSE_SIZE * k + POSE_SIZE])
        cost, _, _, _ = best_of(
            target,
            positions,
            moments,
            epm_moment,
            limits,
            relative,
            _TOLERANCE,
            _MAX_ITERATIONS,
            _STOP_EARLY,
            poses,
            best_pose,
            best_wrench,
        )
        solver[i] = outcome_of(math.sqrt(2.0 * cost))
        if solver[i] == FELL_BACK:
            projected[i] = False
            continue
        for k in range(n_epm):
            pose_to_epm(best_pose[POSE_SIZE * k : POSE_SIZE * k + POSE_SIZE], targets[i, k])
        projected[i] = project_within(targets[i], limits)


class Actions:
    """One action mode for a system: turns actions (n, size) into commanded EPMs (n, N, 6) within reach."""

    def __init__(
        self,
        mode: ActionMode,
        system: System,
        workers: Workers | None = None,
        shell: Shell = EVERYWHERE,
        plant: Plant | None = None,
        period_s: float = 0.5,
    ) -> None:
        require(mode in get_args(ActionMode), "action", "one of " + ", ".join(get_args(ActionMode)), mode)
        self.mode = mode
        self.size = COORDINATES if mode in PLANAR else POSE_SIZE * system.n_epm
        self._system = system
        self._workers = workers or Workers()
        self._limits = np.array([system.r_min_m, system.r_max_m, system.gap_min_m, *shell])
        turn = (plant or Plant()).home_turn_rad
        self._home = home_pose(system.n_epm, turn)
        self.home_epms = home_epms(system.n_epm, turn)
        self._low, self._high = pose_bounds(system)
        # Starts of the allocation in ``wrench``: the present pose, the home pose, a few fixed ones.
        fallback = np.random.default_rng(0).uniform(self._low, self._high, (_FALLBACK_STARTS, len(self._low)))
        self._starts = np.concatenate([self._home[None], self._home[None], fallback])
        self._scale = 1.0 / component_scales()
        self._period_s = period_s
        body = (plant or Plant()).body
        dragged = min(body.drag_linear_nspm, body.drag_rotational_nmsprad) > 0.0
        require(dragged or mode != "velocity", "plant", "one with linear and rotational drag in velocity", body)
        self._steering = Steering.of(system, plant if plant is not None and dragged else Plant(), period_s)

    def constants(self) -> dict[str, Any]:
        """Return what the kernels of all modes take that never changes, by the names of ``magenv.state.State``."""
        return {
            "home": self._home,
            "low": self._low,
            "high": self._high,
            "limits": self._limits,
            "wrench_starts": self._starts,
            "wrench_scale": self._scale,
            "ipm_moment": self._system.ipm_moment_am2,
            "nominal_epm_moment": self._system.epm_moment_am2,
            "home_epms": self.home_epms,
            "steering": self._steering,
        }

    def home(self, measured: Floats) -> Floats:
        """Return the EPMs (n, N, 6) at home for robots measured at (n, 2, 3)."""
        epms = np.empty((len(measured), self._system.n_epm, 6))
        self.start(np.ones(len(measured), np.bool_), measured, epms)
        return epms

    def start(self, mask: Bools, measured: Floats, epms: Floats) -> None:
        """Put the EPMs (n, N, 6) at home where ``mask`` says, for robots measured at (n, 2, 3)."""
        self._workers.run(start_rows, len(mask), mask, measured, self.home_epms, epms)

    def to_epms(
        self,
        actions: Floats,
        measured: Floats,
        epms: Floats,
        active: Bools | None = None,
        expected: Floats | None = None,
    ) -> tuple[Floats, Bools]:
        """Return the commanded EPMs (n, N, 6) and where the least gap or reach made them differ from the action.

        Parameters
        ----------
        actions : ndarray, shape (n, size)
            Within [-1, 1].
        measured : ndarray, shape (n, 2, 3)
            Measured x, y (m) and heading (rad) of the robots.
        epms : ndarray, shape (n, N, 6)
            Present EPMs.
        active : ndarray, shape (n,), optional
            Where a command is wanted; elsewhere the answer is undefined.
        expected : ndarray, shape (n, 12), optional
            State in which the last command was to bring the robots (in ``velocity``); by default they are at rest. The
            state that these commands should lead to is written there.
        """
        active = np.ones(len(epms), np.bool_) if active is None else active
        targets, projected, solver = np.array(epms), np.empty(len(epms), np.bool_), np.zeros(len(epms), np.int64)
        present = np.ascontiguousarray(epms)
        measured = np.ascontiguousarray(measured)
        if expected is None:
            expected = np.concatenate([measured.reshape(-1, COORDINATES), np.zeros((len(epms), COORDINATES))], axis=1)
        self.command(actions, measured, expected, present, active, targets, projected, solver)
        return targets, projected

    def command(
        self,
        actions: Floats,
        measured: Floats,
        expected: Floats,
        epms: Floats,
        active: Bools,
        targets: Floats,
        projected: Bools,
        solver: Integers,
    ) -> None:
        """Write what ``to_epms`` returns into ``targets`` (n, N, 6) and ``projected`` (n,), in active rows alone.

        ``targets`` hold the last commands, and ``solver`` (n,) is written in the modes ``PLANAR`` alone.
        """
        n, run = len(epms), self._workers.run
        if self.mode == "home":
            run(home_rows, n, active, actions, measured, self._home, self._limits, targets, projected)
        elif self.mode == "pose":
            run(pose_rows, n, active, actions, self._low, self._high, self._limits, targets, projected)
        elif self.mode == "step":
            run(step_rows, n, active, actions, epms, self._limits, targets, projected)
        elif self.mode == "velocity":
            run(
                velocity_rows,
                n,
                active,
                actions,
                measured,
                expected,
                self._period_s,
                epms,
                self._steering,
                self._limits,
                targets,
                projected,
                solver,
            )
        else:
            run(
                wrench_rows,
                n,
                active,
                actions,
                measured,
                epms,
                self._starts,
                self._system.ipm_moment_am2,
                self._system.epm_moment_am2,
                self._scale,
                self._limits,
                targets,
                projected,
                solver,
            )


def pose_to_action(pose: Floats, system: System) -> NDArray[np.float32]:
    """Return the ``pose`` action (5 N) that commands a pose vector (5 N) given in canonical angles."""
    low, high = pose_bounds(system)
    return np.clip(2 * (pose - low) / (high - low) - 1, -1, 1).astype(np.float32)
