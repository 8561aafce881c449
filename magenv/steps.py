"""What happens to many episodes in one compiled call: a step, a beginning, and what is told of either.

A call of a kernel from Python costs as much as a short hold, so the laws of the other modules are put together here.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magenv.hold import hold_rows
from magenv.home import start_rows
from magenv.kernels import kernel
from magenv.starts import place_rows
from magenv.task import observe_rows, reward_terms
from magenv.trajectories import trajectory_of
from magenv.world import begin_rows, describe_rows, time_of

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]
Observations = NDArray[np.float32]


@kernel
def tell_rows(
    first: int,
    last: int,
    mask: Bools,
    measured: Floats,
    before: Floats,
    coefficients: Floats,
    duration: Floats,
    step: Integers,
    counts: Integers,
    epms: Floats,
    period: float,
    substeps: int,
    r_max: float,
    carried: bool,
    bounds: Observations,
    time: Floats,
    references: Floats,
    poses: Floats,
    observations: Observations,
) -> None:
    """Write what is told of the rows where ``mask`` says: to the controller and, the last but one, to records."""
    describe_rows(
        first, last, mask, coefficients, duration, step, counts, period, substeps, epms, time, references, poses
    )
    observe_rows(
        first,
        last,
        mask,
        measured,
        before,
        coefficients,
        duration,
        step,
        epms,
        period,
        r_max,
        carried,
        bounds,
        observations,
    )


@kernel
def begin_episodes(
    first: int,
    last: int,
    mask: Bools,
    offsets: Floats,
    used: Integers,
    position_sd: float,
    heading_sd: float,
    home: Floats,
    tracking_distance: float,
    robots: Floats,
    numbers: Floats,
    projected: Bools,
    measured: Floats,
    before: Floats,
    coefficients: Floats,
    duration: Floats,
    step: Integers,
    counts: Integers,
    epms: Floats,
    period: float,
    substeps: int,
    r_max: float,
    carried: bool,
    bounds: Observations,
    time: Floats,
    references: Floats,
    poses: Floats,
    observations: Observations,
) -> None:
    """Begin episodes where ``mask`` says, by their next offsets, EPMs at home; then tell of these rows."""
    place_rows(
        first, last, mask, offsets, used, position_sd, heading_sd, coefficients, duration, robots, measured, before
    )
    start_rows(first, last, mask, measured, home, epms)
    begin_rows(first, last, mask, robots, coefficients, duration, tracking_distance, step, numbers, counts)
    for i in range(first, last):
        projected[i] &= not mask[i]
    tell_rows(
        first,
        last,
        mask,
        measured,
        before,
        coefficients,
        duration,
        step,
        counts,
        epms,
        period,
        substeps,
        r_max,
        carried,
        bounds,
        time,
        references,
        poses,
        observations,
    )


@kernel
def _settle_rows(
    first: int,
    last: int,
    active: Bools,
    robots: Floats,
    numbers: Floats,
    counts: Integers,
    step: Integers,
    duration: Floats,
    period: float,
    substeps: int,
    measured: Floats,
    before: Floats,
    paid: Floats,
    ended: Bools,
) -> None:
    """Measure the robots after a hold; write what it paid and how it ended. Inactive rows: nothing, not ended."""
    for i in range(first, last):
        paid[2, i], ended[0, i], ended[1, i] = 0.0, False, False
        if active[i]:
            for robot in range(2):
                for j in range(3):
                    before[i, robot, j] = measured[i, robot, j]
                    measured[i, robot, j] = robots[i, robot, j]
            paid[0, i], paid[1, i] = reward_terms(numbers[0, i], numbers[1, i])
            paid[2, i] = 0.5 * (paid[0, i] + paid[1, i])
            ended[0, i] = counts[1, i] > 0
            now = time_of(step[i], counts[0, i], counts[1, i], period, substeps)
            over = now >= duration[trajectory_of(i, len(duration))] - 1e-9 * period
            ended[1, i] = over and not ended[0, i]


@functools.cache
def step_kernel(n_epm: int, width: int) -> Callable[..., None]:
    """Return the kernel that steps episodes: the hold of ``hold_rows``, what it paid, what is told of all rows."""
    magnets, side_by_side = (0,) * n_epm, (0,) * width

    def step_rows(
        first: int,
        last: int,
        active: Bools,
        robots: Floats,
        epms: Floats,
        targets: Floats,
        constants: Floats,
        mass: Floats,
        epm_moment: Floats,
        coefficients: Floats,
        duration: Floats,
        step: Integers,
        numbers: Floats,
        counts: Integers,
        period: float,
        substeps: int,
        loss_distance: float,
        tracking_distance: float,
        diameter: float,
        wall_radius: float,
        paid: Floats,
        ended: Bools,
        every: Bools,
        measured: Floats,
        before: Floats,
        r_max: float,
        carried: bool,
        bounds: Observations,
        time: Floats,
        references: Floats,
        poses: Floats,
        observations: Observations,
    ) -> None:
        hold_rows(
            first,
            last,
            active,
            robots,
            epms,
            targets,
            constants,
            mass,
            epm_moment,
            coefficients,
            duration,
            step,
            numbers,
            counts,
            period,
            substeps,
            loss_distance,
            tracking_distance,
            diameter,
            wall_radius,
            magnets,
            side_by_side,
        )
        _settle_rows(
            first,
            last,
            active,
            robots,
            numbers,
            counts,
            step,
            duration,
            period,
            substeps,
            measured,
            before,
            paid,
            ended,
        )
        tell_rows(
            first,
            last,
            every,
            measured,
            before,
            coefficients,
            duration,
            step,
            counts,
            epms,
            period,
            substeps,
            r_max,
            carried,
            bounds,
            time,
            references,
            poses,
            observations,
        )

    return kernel(step_rows)
