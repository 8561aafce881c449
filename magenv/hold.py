"""One control period of many episodes: command -> EPM motion -> substeps -> state and measurements.

This is the loop in which the time goes. Its laws are those of ``dynamics`` and ``trajectories``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magenv.angles import sincos, wrap
from magenv.arithmetic import dot2
from magenv.dynamics import TOUCH, WALL, advance, may_touch, resolve_contact
from magenv.kernels import in_cache_lines, kernel, law, typed, wide_vectors
from magenv.lanes import (
    COEFFICIENTS,
    CONSTANTS,
    CONSTANTS_SIZE,
    CONTACT,
    DONE,
    FRICTION,
    HEADING1,
    HEADING2,
    HEADING_END,
    HEADING_ERROR,
    MEASURED,
    MEASURED_SIZE,
    POSITION_END,
    POSITION_ERROR,
    PROGRESS,
    PUSH_X1,
    SEGMENT,
    SEGMENT_RATE,
    SEPARATION_MIN,
    SEPARATION_TRACKED,
    START,
    STATE_SIZE,
    TURN_FRICTION,
    X1,
    X2,
    Y1,
    Y2,
    fields,
)
from magenv.magnets import Size, copy_epms, place_all
from magenv.trajectories import SEGMENTS, cubic, spline_position, trajectory_of
from magenv.travel import Motion, carry, command, give_way, go_on, is_due, moves, put_down, set_off, take_up

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LOSSES = ("none", "deviation", "touch", "wall")
"""Kinds of loss of control by code: too far from the reference, bodies touched, wall reached."""
_DEVIATION, _TOUCH, _WALL = 1, 2, 3
AT_ONCE, LATE, TRAVELLING = range(3)
"""How commands act: EPMs are there as the hold begins, or some substeps later, or travel there, perhaps later."""
_STAND = 2
"""Substeps without motion after which EPMs need no carrying: they act from where they stand, in a move from halfway."""


@law
def _load_segment(lanes: Floats, i: int, position: float, coefficients: Floats) -> None:
    """Put the coefficients (32, 2, 3, 4) of the segment at ``position`` into lane ``i``."""
    segment = min(int(position), SEGMENTS - 1) if position >= 0.0 else 0
    lanes[SEGMENT, i] = segment
    for robot in range(2):
        for j in range(12):
            lanes[COEFFICIENTS + 2 * j + robot, i] = coefficients[segment, robot, j // 4, j % 4]


# Typed: for literals numba would compile ``_reference`` anew.
_FIRST, _SECOND = typed(0), typed(1)
_X, _Y, _HEADING = typed(0), typed(1), typed(2)


@law
def _reference(lanes: Floats, i: int, robot: int, axis: int) -> float:
    """Return a coordinate of the reference: x, y or heading of a robot."""
    c = COEFFICIENTS + 8 * axis + robot
    return cubic(lanes[c, i], lanes[c + 2, i], lanes[c + 4, i], lanes[c + 6, i], lanes[PROGRESS, i])


@law
def _count(lanes: Floats, i: int, h: float) -> bool:
    """Count the substep and place it on the reference; return whether the reference's segment has ended."""
    done = lanes[DONE, i] + 1.0
    progress = spline_position(lanes[START, i] + done * h, lanes[SEGMENT_RATE, i]) - lanes[SEGMENT, i]
    lanes[DONE, i], lanes[PROGRESS, i] = done, progress
    ended: bool = progress > 1.0
    return ended


@law
def _measure(lanes: Floats, i: int, substeps: float, loss_distance: float, tracking_distance: float) -> bool:
    """Add lane ``i`` at a substep's end to its measurements; return whether its hold is over."""
    x1, y1, x2, y2 = lanes[X1, i], lanes[Y1, i], lanes[X2, i], lanes[Y2, i]
    dx, dy = x1 - _reference(lanes, i, _FIRST, _X), y1 - _reference(lanes, i, _FIRST, _Y)
    first = math.sqrt(dot2(dx, dy, dx, dy))
    dx, dy = x2 - _reference(lanes, i, _SECOND, _X), y2 - _reference(lanes, i, _SECOND, _Y)
    second = math.sqrt(dot2(dx, dy, dx, dy))
    position_error = 0.5 * (first + second)
    turned1 = abs(wrap(lanes[HEADING1, i] - _reference(lanes, i, _FIRST, _HEADING)))
    turned2 = abs(wrap(lanes[HEADING2, i] - _reference(lanes, i, _SECOND, _HEADING)))
    heading_error = 0.5 * (turned1 + turned2)
    separation = dot2(x2 - x1, y2 - y1, x2 - x1, y2 - y1)  # squared: the root is drawn once, at the end
    lanes[POSITION_ERROR, i] += position_error
    lanes[HEADING_ERROR, i] += heading_error
    lanes[POSITION_END, i] = position_error
    lanes[HEADING_END, i] = heading_error
    lanes[SEPARATION_MIN, i] = min(lanes[SEPARATION_MIN, i], separation)
    tracks = (first <= tracking_distance) & (second <= tracking_distance)
    lanes[SEPARATION_TRACKED, i] = separation if tracks else lanes[SEPARATION_TRACKED, i]
    near = (first <= loss_distance) & (second <= loss_distance)  # false for NaN as well
    over: bool = (not near) | (lanes[CONTACT, i] > 0.0) | (lanes[DONE, i] == substeps)
    return over


@law
def _touch(lanes: Floats, i: int, bodies: Floats, mass: Floats, diameter: float, wall_radius: float) -> None:
    """Resolve contact in lane ``i``; ``bodies`` (2, 6) is scratch."""
    for j in range(2 * STATE_SIZE):
        bodies[j % 2, j // 2] = lanes[X1 + j, i]
    lanes[CONTACT, i] = resolve_contact(bodies, mass, diameter, wall_radius)
    for j in range(2 * STATE_SIZE):
        lanes[X1 + j, i] = bodies[j % 2, j // 2]


@law
def _loss(lanes: Floats, i: int, loss_distance: float) -> int:
    contact = int(lanes[CONTACT, i])
    if contact & TOUCH:
        return _TOUCH
    if contact & WALL:
        return _WALL
    dx1, dy1 = lanes[X1, i] - _reference(lanes, i, _FIRST, _X), lanes[Y1, i] - _reference(lanes, i, _FIRST, _Y)
    dx2, dy2 = lanes[X2, i] - _reference(lanes, i, _SECOND, _X), lanes[Y2, i] - _reference(lanes, i, _SECOND, _Y)
    first, second = math.sqrt(dot2(dx1, dy1, dx1, dy1)), math.sqrt(dot2(dx2, dy2, dx2, dy2))
    return 0 if (first <= loss_distance) & (second <= loss_distance) else _DEVIATION


@law
def _disturb(lanes: Floats, i: int, slow: Floats, rubs: tuple[float, float, float], now: float) -> None:
    """Write what pushes and rubs the robots of lane ``i`` in the hold that begins at ``now`` (s)."""
    amplitude, lanes[FRICTION, i], lanes[TURN_FRICTION, i] = rubs
    for robot in range(2):
        for axis in range(2):
            sine, _ = sincos(slow[robot, 0] * now + slow[robot, 1 + axis])
            lanes[PUSH_X1 + 2 * axis + robot, i] = amplitude * sine


@kernel
def hold_rows(
    first: int,
    last: int,
    active: Bools,
    robots: Floats,
    epms: Floats,
    targets: Floats,
    constants: Floats,
    mass: Floats,
    epm_moment: Floats,
    epm_size: Size,
    coefficients: Floats,
    duration: Floats,
    step: NDArray[np.int64],
    numbers: Floats,
    counts: NDArray[np.int64],
    period: float,
    substeps: int,
    loss_distance: float,
    tracking_distance: float,
    diameter: float,
    wall_radius: float,
    motion: Motion,
    routes: Floats,
    queue: Floats,
    slow: Floats,
    rubs: tuple[float, float, float],
    magnets: tuple[int, ...],
    side_by_side: tuple[int, ...],
    moving: tuple[int, ...],
    rubbing: tuple[int, ...],
) -> None:
    """Hold commands for one control period or until control is lost, several rows at a time.

    A lane whose hold is over takes the next active row, so that no lane waits for another; lanes without a row
    compute on, unseen. The lengths of the last tuples, which are types to numba, are the numbers of EPMs and of lanes,
    how commands act (``AT_ONCE``, ``LATE``, ``TRAVELLING``) and whether the plant is rough: constants of the machine
    code, so that the magnets are unrolled and the lanes vectorised; so is whether EPMs have a size (see ``magnets``).

    ``routes`` (n, N, 48) is how EPMs move from hold to hold, ``queue`` (n, 1 + wait, N, 6) the commands that do not act
    yet, ``slow`` (n, 2, 3) angular frequency (rad/s) and phases (rad) of the force that disturbs each robot, and
    ``rubs`` its amplitude (N) and dry friction (N, N m).
    """
    wide_vectors()
    n_epm, width, rough = len(magnets), len(side_by_side), len(rubbing) > 0
    late, travels = len(moving) >= LATE, len(moving) >= TRAVELLING
    lanes, bodies = in_cache_lines(fields(n_epm, travels), width), np.empty((2, STATE_SIZE))
    for j in range(len(lanes)):
        for i in range(width):
            lanes[j, i] = 0.0
    rows, flagged = np.full(width, -1), np.zeros(width, np.bool_)
    h, upcoming, busy, idle, calm = period / substeps, first, 0, True, 0
    while True:
        if idle:  # load rows into the lanes that have none
            idle, calm = False, 0
            for i in range(width):
                while rows[i] < 0 and upcoming < last:
                    row = upcoming
                    upcoming += 1
                    if not active[row]:
                        continue
                    rows[i] = row
                    busy += 1
                    for j in range(2 * STATE_SIZE):
                        lanes[X1 + j, i] = robots[row, j % 2, j // 2]
                    for j in range(CONSTANTS_SIZE):
                        lanes[CONSTANTS + j, i] = constants[row, j]
                    if late:
                        copy_epms(targets, row, queue[row], step[row] % queue.shape[1])
                    else:
                        copy_epms(targets, row, epms, row)
                    if travels:
                        take_up(lanes, i, epm_moment[row], epms[row], routes[row])
                    else:
                        place_all(lanes, i, epm_size, epm_moment, epms, row)
                    if rough:
                        _disturb(lanes, i, slow[row], rubs, step[row] * period)
                    which = trajectory_of(row, len(duration))
                    lanes[START, i], lanes[DONE, i], lanes[CONTACT, i] = step[row] * period, 0.0, 0.0
                    lanes[SEGMENT_RATE, i] = SEGMENTS / duration[which]
                    position = spline_position(lanes[START, i], lanes[SEGMENT_RATE, i])
                    _load_segment(lanes, i, position, coefficients[which])
                    lanes[POSITION_ERROR, i], lanes[HEADING_ERROR, i] = 0.0, 0.0
                    lanes[SEPARATION_MIN, i] = math.inf
                    lanes[SEPARATION_TRACKED, i] = numbers[SEPARATION_TRACKED - MEASURED, row] ** 2
            if busy == 0:
                return
        rare = False
        if late:
            for i in range(width):
                flagged[i] = (rows[i] >= 0) & (lanes[DONE, i] == motion.lag)
                if travels and calm < _STAND:
                    flagged[i] |= (rows[i] >= 0) & is_due(lanes, i, n_epm)
                rare |= flagged[i]
            if rare:
                calm = 0
                for i in range(width):
                    row = rows[i]
                    if flagged[i]:
                        sent = step[row] - motion.wait
                        if lanes[DONE, i] == motion.lag and sent >= 0:
                            if travels:
                                command(lanes, i, queue[row, sent % queue.shape[1]])
                            else:
                                copy_epms(queue[row], sent % queue.shape[1], epms, row)
                                place_all(lanes, i, epm_size, epm_moment, epms, row)
                        if travels:
                            set_off(lanes, i, n_epm, motion)
        if travels and calm < _STAND:
            calm, rare = calm + 1, False
            for i in range(width):
                flagged[i] = (rows[i] >= 0) & go_on(lanes, i, n_epm, motion)
                rare |= flagged[i]
            if rare:
                for i in range(width):
                    if flagged[i]:
                        give_way(lanes, i, n_epm, motion)
                calm = 0
            rare = False
            for k in range(n_epm):
                for i in range(width):
                    carry(lanes, i, n_epm, k, epm_size)
                    flagged[i] = (rows[i] >= 0) & moves(lanes, i, n_epm, k)
                    rare |= flagged[i]
            if rare:
                calm = 0
        rare = False
        for i in range(width):
            advance(lanes, i, n_epm, epm_size, h, rough)
            flagged[i] = (rows[i] >= 0) & (_count(lanes, i, h) | may_touch(lanes, i, diameter, wall_radius))
            rare |= flagged[i]
        if rare:
            for i in range(width):
                if flagged[i]:
                    _touch(lanes, i, bodies, mass[rows[i]], diameter, wall_radius)
                    if lanes[PROGRESS, i] > 1.0:
                        position = lanes[SEGMENT, i] + lanes[PROGRESS, i]
                        _load_segment(lanes, i, position, coefficients[trajectory_of(rows[i], len(duration))])
                        lanes[PROGRESS, i] = position - lanes[SEGMENT, i]
        over = False
        for i in range(width):
            flagged[i] = (rows[i] >= 0) & _measure(lanes, i, 1.0 * substeps, loss_distance, tracking_distance)
            over |= flagged[i]
        if over:
            for i in range(width):
                row = rows[i]
                if flagged[i]:
                    for j in range(2 * STATE_SIZE):
                        robots[row, j % 2, j // 2] = lanes[X1 + j, i]
                    if travels:
                        put_down(lanes, i, epms[row], routes[row])
                    for j in range(MEASURED_SIZE):
                        numbers[j, row] = lanes[MEASURED + j, i]
                    numbers[POSITION_ERROR - MEASURED, row] /= lanes[DONE, i]
                    numbers[HEADING_ERROR - MEASURED, row] /= lanes[DONE, i]
                    for j in (SEPARATION_MIN, SEPARATION_TRACKED):
                        numbers[j - MEASURED, row] = math.sqrt(lanes[j, i])
                    counts[0, row], counts[1, row] = int(lanes[DONE, i]), _loss(lanes, i, loss_distance)
                    step[row] += 1
                    rows[i], idle = -1, True
                    busy -= 1


def hold_shape(n_epm: int, width: int, moves: int = AT_ONCE, rough: bool = False) -> tuple[tuple[int, ...], ...]:
    """Return the last arguments of ``hold_rows``."""
    return (0,) * n_epm, (0,) * width, (0,) * moves, (0,) * rough


@functools.cache
def hold_kernel(n_epm: int, width: int, moves: int, rough: bool) -> Callable[..., None]:
    """Return ``hold_rows`` for a number of EPMs and of lanes, a way in which commands act, a rough plant or not."""
    shape = hold_shape(n_epm, width, moves, rough)

    def hold(*arguments: Any) -> None:
        hold_rows(*arguments, *shape)

    return kernel(hold)
