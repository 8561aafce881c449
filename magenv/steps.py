"""What happens to many episodes in one compiled call: a step, a beginning, and what is told of either.

A call of a kernel from Python costs as much as a short hold, so the laws of the other modules are put together here.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magenv.actions import ActionMode, pose_rows, step_rows, wrench_rows
from magenv.dynamics import Physics
from magenv.hold import hold_rows, hold_shape
from magenv.home import home_rows, start_rows
from magenv.kernels import kernel, typed
from magenv.magnets import copy_epms
from magenv.reach import make_allowed
from magenv.sensitivity import COORDINATES
from magenv.starts import place_rows
from magenv.state import State
from magenv.task import observe_rows, reward_terms
from magenv.trajectories import trajectory_of
from magenv.uncertainty import add_noise, draw_plants
from magenv.velocity import velocity_rows
from magenv.world import begin_rows, describe_rows, time_of

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Observations = NDArray[np.float32]
Step = Callable[[int, int, Bools, Floats, State, Observations], None]


@kernel
def clip(numbers: Floats) -> bool:
    """Clip ``numbers`` (k,) to [-1, 1] in place; return whether all were finite."""
    unfit = 0
    for i in range(len(numbers)):
        unfit += 0 if abs(numbers[i]) < math.inf else 1
        numbers[i] = min(max(numbers[i], -1.0), 1.0)
    return unfit == 0


_ONLY = typed(0), typed(1)
"""First and last of the only episode."""


@kernel
def _home(first: int, last: int, active: Bools, actions: Floats, s: State) -> None:
    home_rows(first, last, active, actions, s.measured, s.home, s.limits, s.targets, s.projected)


@kernel
def _pose(first: int, last: int, active: Bools, actions: Floats, s: State) -> None:
    pose_rows(first, last, active, actions, s.low, s.high, s.limits, s.targets, s.projected)


@kernel
def _step(first: int, last: int, active: Bools, actions: Floats, s: State) -> None:
    step_rows(first, last, active, actions, s.epms, s.limits, s.targets, s.projected)


@kernel
def _wrench(first: int, last: int, active: Bools, actions: Floats, s: State) -> None:
    wrench_rows(
        first,
        last,
        active,
        actions,
        s.measured,
        s.epms,
        s.wrench_starts,
        s.ipm_moment,
        s.nominal_epm_moment,
        s.wrench_scale,
        s.limits,
        s.targets,
        s.projected,
        s.solver,
    )


@kernel
def _velocity(first: int, last: int, active: Bools, actions: Floats, s: State) -> None:
    velocity_rows(
        first,
        last,
        active,
        actions,
        s.measured,
        s.expected,
        s.period,
        s.epms,
        s.steering,
        s.limits,
        s.targets,
        s.projected,
        s.solver,
    )


@kernel
def tell_rows(first: int, last: int, mask: Bools, s: State, observations: Observations) -> None:
    """Write what is told of the rows where ``mask`` says: to records, and to the controller in ``observations``."""
    describe_rows(
        first,
        last,
        mask,
        s.coefficients,
        s.duration,
        s.step,
        s.counts,
        s.period,
        s.substeps,
        s.epms,
        s.time,
        s.references,
        s.poses,
    )
    observe_rows(
        first,
        last,
        mask,
        s.measured,
        s.before,
        s.coefficients,
        s.duration,
        s.step,
        s.epms,
        s.period,
        s.r_max,
        s.carried,
        s.bounds,
        observations,
    )


@kernel
def begin_episodes(first: int, last: int, mask: Bools, s: State, observations: Observations) -> None:
    """Begin episodes where ``mask`` says, by their next offsets, EPMs at home; then tell of these rows."""
    if s.uncertain:
        draw_plants(
            first,
            last,
            mask,
            s.plant_keys,
            s.used,
            s.mismatch,
            s.nominal,
            s.substep,
            Physics(
                s.mass,
                s.inertia,
                s.drag_linear,
                s.drag_rotational,
                s.ipm_moments,
                s.epm_moment,
                s.epm_size,
                s.diameter,
                s.wall_radius,
            ),
            s.plant_key,
            s.slow,
            s.constants,
        )
    place_rows(
        first,
        last,
        mask,
        s.offsets,
        s.used,
        s.position_sd,
        s.heading_sd,
        s.coefficients,
        s.duration,
        s.robots,
        s.measured,
        s.before,
    )
    start_rows(first, last, mask, s.measured, s.home_epms, s.epms)
    if s.limits[4] < math.inf:
        epms, limits = s.epms, s.limits
        for i in range(first, last):
            if mask[i]:
                make_allowed(epms, i, limits)
    if len(s.held_epms) > 0:
        epms, held = s.epms, s.held_epms
        for i in range(first, last):
            if mask[i]:
                copy_epms(held, min(i, len(held) - 1), epms, i)
    begin_rows(
        first,
        last,
        mask,
        s.robots,
        s.coefficients,
        s.duration,
        s.tracking_distance,
        s.routes,
        s.step,
        s.numbers,
        s.counts,
    )
    projected, measured, before, stream = s.projected, s.measured, s.before, np.empty(1, np.uint64)
    present, targets = s.epms, s.targets
    for i in range(first, last):
        projected[i] &= not mask[i]
        if mask[i]:
            copy_epms(present, i, targets, i)  # what is held until something else is commanded
        if mask[i] and s.uncertain:
            add_noise(measured, i, s.plant_key[i], _ONLY[0], s.noise_position, s.noise_heading, stream)
            for j in range(COORDINATES):
                before[i, j // 3, j % 3] = measured[i, j // 3, j % 3]
    expected = s.expected
    for i in range(first, last):
        if mask[i]:
            for j in range(COORDINATES):
                expected[i, j], expected[i, COORDINATES + j] = measured[i, j // 3, j % 3], 0.0
    tell_rows(first, last, mask, s, observations)


@kernel
def begin_one(s: State) -> None:
    """Begin the only episode."""
    begin_episodes(*_ONLY, s.every, s, s.observation)


@kernel
def _settle_rows(first: int, last: int, active: Bools, s: State) -> None:
    """Measure the robots after a hold; write what it paid and how it ended. Inactive rows: nothing, not ended."""
    robots, measured, before, numbers, counts = s.robots, s.measured, s.before, s.numbers, s.counts
    paid, ended, step, duration = s.paid, s.ended, s.step, s.duration
    stream = np.empty(1, np.uint64)
    for i in range(first, last):
        paid[2, i], ended[0, i], ended[1, i] = 0.0, False, False
        if active[i]:
            for robot in range(2):
                for j in range(3):
                    before[i, robot, j] = measured[i, robot, j]
                    measured[i, robot, j] = robots[i, robot, j]
            if s.uncertain:
                add_noise(measured, i, s.plant_key[i], step[i], s.noise_position, s.noise_heading, stream)
            paid[0, i], paid[1, i] = reward_terms(numbers[0, i], numbers[1, i])
            paid[2, i] = 0.5 * (paid[0, i] + paid[1, i])
            ended[0, i] = counts[1, i] > 0
            now = time_of(step[i], counts[0, i], counts[1, i], s.period, s.substeps)
            over = now >= duration[trajectory_of(i, len(duration))] - 1e-9 * s.period
            ended[1, i] = over and not ended[0, i]


@kernel
def _hold(
    first: int,
    last: int,
    active: Bools,
    s: State,
    observations: Observations,
    magnets: tuple[int, ...],
    side_by_side: tuple[int, ...],
    moving: tuple[int, ...],
    rubbing: tuple[int, ...],
) -> None:
    """Hold the commanded EPMs for one control period; what that paid, and what is told of all rows."""
    hold_rows(
        first,
        last,
        active,
        s.robots,
        s.epms,
        s.targets,
        s.constants,
        s.mass,
        s.epm_moment,
        s.epm_size,
        s.coefficients,
        s.duration,
        s.step,
        s.numbers,
        s.counts,
        s.period,
        s.substeps,
        s.loss_distance,
        s.tracking_distance,
        s.diameter,
        s.wall_radius,
        s.motion,
        s.routes,
        s.queue,
        s.slow,
        s.rubs,
        magnets,
        side_by_side,
        moving,
        rubbing,
    )
    _settle_rows(first, last, active, s)
    tell_rows(first, last, s.every, s, observations)


@functools.cache
def step_kernel(mode: ActionMode, n_epm: int, width: int, moves: int, rough: bool) -> Step:
    """Return the kernel that steps episodes by ``actions`` (n, size) within [-1, 1].

    Mode, number of EPMs and of lanes, how commands act and whether the plant is rough are constants of the machine
    code: of the branches one is compiled.
    """
    shape = hold_shape(n_epm, width, moves, rough)

    def step_episodes(
        first: int, last: int, active: Bools, actions: Floats, s: State, observations: Observations
    ) -> None:
        if mode == "home":
            _home(first, last, active, actions, s)
        elif mode == "pose":
            _pose(first, last, active, actions, s)
        elif mode == "step":
            _step(first, last, active, actions, s)
        elif mode == "velocity":
            _velocity(first, last, active, actions, s)
        else:
            _wrench(first, last, active, actions, s)
        _hold(first, last, active, s, observations, *shape)

    return kernel(step_episodes)


@functools.cache
def one_kernel(
    mode: ActionMode, n_epm: int, width: int, moves: int, rough: bool
) -> Callable[[State], tuple[object, ...]]:
    """Return the kernel that steps the only episode by ``action``, clipped; one that is not finite moves nothing."""
    shape = hold_shape(n_epm, width, moves, rough)

    def step_one(s: State) -> tuple[object, ...]:
        fit = clip(s.action[0])
        if fit:
            if mode == "home":
                _home(*_ONLY, s.every, s.action, s)
            elif mode == "pose":
                _pose(*_ONLY, s.every, s.action, s)
            elif mode == "step":
                _step(*_ONLY, s.every, s.action, s)
            elif mode == "velocity":
                _velocity(*_ONLY, s.every, s.action, s)
            else:
                _wrench(*_ONLY, s.every, s.action, s)
            _hold(*_ONLY, s.every, s, s.observation, *shape)
        paid, ended, numbers, counts = s.paid, s.ended, s.numbers, s.counts
        return (
            fit,
            paid[2, 0],
            ended[0, 0],
            ended[1, 0],
            s.time[0],
            numbers[0, 0],
            numbers[1, 0],
            numbers[2, 0],
            numbers[3, 0],
            numbers[4, 0],
            numbers[5, 0],
            counts[0, 0],
            counts[1, 0],
            paid[0, 0],
            paid[1, 0],
            s.projected[0],
            s.solver[0],
        )

    return kernel(step_one)
