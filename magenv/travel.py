"""EPMs that move at finite speed and acceleration: how they go on from where they are to where they are commanded.

An EPM's centre goes round the workspace centre on the great circle to its goal while its radius changes in step, so
that it comes no nearer than the nearer end; its moment turns the shortest way. A move begins and ends at rest: speed
rises evenly, stays, and falls evenly; the centre has its full speed where its radius is largest. A command that comes
during a move lets the EPM brake on its way, then set off anew. What the EPMs do to the robots in a substep is what they
do halfway. Where two centres would come closer than the least gap they brake, creep, are moved apart as commands are,
and step aside, always to the same side. Where the way would leave the shell within an arm's reach it is gone in parts,
from rest to rest: along the radius to where the whole way round is within reach, round, and along the radius again.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.arithmetic import dot2, dot3
from magenv.kernels import kernel, law
from magenv.lanes import ROUTE_SIZE, carried_moment, route
from magenv.magnets import Size, place_epm
from magenv.params import Plant, System
from magenv.poses import EPM_SIZE, GAP_TOLERANCE_M
from magenv.reach import REACH_TOLERANCE_M, Shell, project_reach, room, shoulder, stays
from magenv.ways import (
    Vector,
    at_rest,
    brake,
    go_way,
    goes_on,
    is_waiting,
    norm,
    ramp,
    read,
    set_way,
    stop,
    stopping,
    unit,
    way_round,
    write,
)

Floats = NDArray[np.float64]

_CENTRE, _MOMENT, _GOAL, _GOAL_MOMENT, _NEXT, _RADIUS, _GROWTH, _BEND, _WAY, _TURN = 0, 3, 6, 9, 12, 15, 16, 17, 18, 33
"""Within an EPM's fields: its centre (m) and unit moment, those commanded, its centre at the substep's end; its radius,
what that grows by in a substep, and by what this changes while the speed does (m); the way of its direction from the
workspace centre, and that of its moment."""
_ASIDE = 0.25
"""Share of a centre's step by which it steps aside: less than the half that it goes, so that it never stands for it."""


class Motion(NamedTuple):
    """What limits the EPMs' motion in a substep."""

    reach: float
    """m a centre moves at most."""
    turn: float
    """rad a moment turns at most."""
    r_min: float
    """m."""
    r_max: float
    """m."""
    gap: float
    """m."""
    rise: float
    """Share of ``reach`` by which a centre's speed changes at most."""
    turn_rise: float
    """Share of ``turn`` by which a moment's does."""
    lag: int
    """Substeps of a hold after which a command acts,"""
    wait: int
    """so many holds after its own."""
    shell: Shell
    """Within the arms' reach."""

    @classmethod
    def of(cls, system: System, plant: Plant, substep_s: float, substeps: int) -> Motion:
        """Return the limits of a substep; of no use, but of the same types, where the EPMs jump."""
        reach, turn = plant.epm_speed_mps * substep_s, plant.epm_turn_radps * substep_s
        rise = plant.epm_acceleration_mps2 * substep_s / plant.epm_speed_mps if not plant.epms_jump else math.inf
        turn_rise = (
            plant.epm_turn_acceleration_radps2 * substep_s / plant.epm_turn_radps if not plant.epms_jump else math.inf
        )
        lag = round(plant.latency_s / substep_s)
        limits = (system.r_min_m, system.r_max_m, system.gap_min_m)
        return cls(reach, turn, *limits, rise, turn_rise, lag % substeps, lag // substeps, Shell.of(system, plant))


@kernel
def _draw_way(lanes: Floats, i: int, n_epm: int, k: int, motion: Motion) -> None:
    """Draw the way of the ``k``-th EPM's centre to its goal, or the first part of it.

    No chord of a substep is longer than what the centre moves at most: none is longer than the arc at the largest
    radius.
    """
    e, whole = route(n_epm, k), True
    x, y, z = read(lanes, i, e + _CENTRE)
    gx, gy, gz = read(lanes, i, e + _GOAL)
    radius, goal = norm(x, y, z), norm(gx, gy, gz)
    u = (x / radius, y / radius, z / radius)
    angle, across = way_round(u, (gx / goal, gy / goal, gz / goal))
    if motion.shell.outer < math.inf:
        base = shoulder(motion.shell, k, n_epm)
        whole = stays(motion.shell, base, u, across, angle, radius, goal, REACH_TOLERANCE_M)
        if not whole:
            most = room(motion.shell, base, u, across, angle)
            angle, goal = (0.0, most) if radius > most + GAP_TOLERANCE_M else (angle, min(goal, most))
    arc, out = max(radius, goal) * angle, goal - radius
    up, flat = ramp(math.sqrt(dot2(arc, out, arc, out)) / motion.reach, motion.rise)
    set_way(lanes, i, e + _WAY, u, across, angle, up, flat)
    if not whole:
        goes_on(lanes, i, e + _WAY)
    lanes[e + _RADIUS, i], lanes[e + _GROWTH, i], lanes[e + _BEND, i] = radius, 0.0, out / (up * (up + flat))


@law
def _go(lanes: Floats, i: int, e: int) -> None:
    """Write where the centre of the EPM whose fields begin at ``e`` goes, alone, in a substep."""
    (x, y, z), change, moves, there = go_way(lanes, i, e + _WAY)
    growth = lanes[e + _GROWTH, i] + change * lanes[e + _BEND, i] if moves else 0.0
    radius = lanes[e + _RADIUS, i] + growth
    lanes[e + _GROWTH, i], lanes[e + _RADIUS, i] = growth, radius
    gx, gy, gz = read(lanes, i, e + _GOAL)
    cx, cy, cz = read(lanes, i, e + _CENTRE)
    x, y, z = (gx if there else radius * x), (gy if there else radius * y), (gz if there else radius * z)
    write(lanes, i, e + _NEXT, x if moves else cx, y if moves else cy, z if moves else cz)


@kernel
def _draw_turn(lanes: Floats, i: int, e: int, turn: float, rise: float) -> None:
    """Draw the way of the moment of the EPM whose fields begin at ``e`` to that commanded, ``turn`` (rad) a substep."""
    u = read(lanes, i, e + _MOMENT)
    angle, across = way_round(u, read(lanes, i, e + _GOAL_MOMENT))
    set_way(lanes, i, e + _TURN, u, across, angle, *ramp(angle / turn, rise))


@law
def _turn(lanes: Floats, i: int, e: int) -> Vector:
    """Turn the moment of the EPM whose fields begin at ``e`` for a substep and return it."""
    (x, y, z), _, moves, there = go_way(lanes, i, e + _TURN)
    gx, gy, gz = read(lanes, i, e + _GOAL_MOMENT)
    mx, my, mz = read(lanes, i, e + _MOMENT)
    x, y, z = (gx if there else x), (gy if there else y), (gz if there else z)
    x, y, z = (x if moves else mx), (y if moves else my), (z if moves else mz)
    write(lanes, i, e + _MOMENT, x, y, z)
    return x, y, z


@law
def is_due(lanes: Floats, i: int, n_epm: int) -> bool:
    """Return whether an EPM of lane ``i`` is at rest and has a goal to set off for."""
    due = False
    for k in range(n_epm):
        for w in (route(n_epm, k) + _WAY, route(n_epm, k) + _TURN):
            due |= is_waiting(lanes, i, w)
    return due


@law
def moves(lanes: Floats, i: int, n_epm: int, k: int) -> bool:
    """Return whether the ``k``-th EPM of lane ``i`` is on its way; one that waits to set off is not."""
    e = route(n_epm, k)
    return not (at_rest(lanes, i, e + _WAY) & at_rest(lanes, i, e + _TURN))


@kernel
def set_off(lanes: Floats, i: int, n_epm: int, motion: Motion) -> None:
    """Draw the ways that are due in lane ``i``."""
    for k in range(n_epm):
        e = route(n_epm, k)
        if is_waiting(lanes, i, e + _WAY):
            _draw_way(lanes, i, n_epm, k, motion)
        if is_waiting(lanes, i, e + _TURN):
            _draw_turn(lanes, i, e, motion.turn, motion.turn_rise)


@kernel
def command(lanes: Floats, i: int, targets: Floats) -> None:
    """Give the EPMs of lane ``i`` goals (N, 6): where they are new they brake, then set off."""
    n_epm = len(targets)
    for k in range(n_epm):
        e = route(n_epm, k)
        for goal, w, first in ((e + _GOAL, e + _WAY, 0), (e + _GOAL_MOMENT, e + _TURN, 3)):
            same = True
            for axis in range(3):
                same &= lanes[goal + axis, i] == targets[k, first + axis]
                lanes[goal + axis, i] = targets[k, first + axis]
            if not same:
                brake(lanes, i, w)


@law
def _distance2(lanes: Floats, i: int, a: int, b: int) -> float:
    """Return the squared distance of two points of lane ``i`` whose fields begin at ``a`` and ``b``."""
    (ax, ay, az), (bx, by, bz) = read(lanes, i, a), read(lanes, i, b)
    return dot3(bx - ax, by - ay, bz - az, bx - ax, by - ay, bz - az)


@law
def go_on(lanes: Floats, i: int, n_epm: int, motion: Motion) -> bool:
    """Find where the centres in lane ``i`` would go in a substep; return whether two of them have to look out.

    They have where they would come too close, or could if they braked from now on only.
    """
    near, least = False, motion.gap - 2.0 * GAP_TOLERANCE_M  # goals are allowed within the tolerance
    for k in range(n_epm):
        _go(lanes, i, route(n_epm, k))
    for k in range(1, n_epm):
        for j in range(k):
            a, b = route(n_epm, j), route(n_epm, k)
            now, then = _distance2(lanes, i, a, b), _distance2(lanes, i, a + _NEXT, b + _NEXT)
            braking = 0.5 * max(stopping(lanes, i, a + _WAY), stopping(lanes, i, b + _WAY))
            closing = max(math.sqrt(now) - math.sqrt(then), 0.0)
            near |= math.sqrt(then) - braking * closing < least
    return near


@kernel
def _step_aside(a: Floats, b: Floats, gap: float, way: float) -> None:
    """Move two centres that are too close by ``way`` (m) to opposite sides, round each other: else they might stand."""
    nx, ny, nz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    if norm(nx, ny, nz) < gap:
        rx, ry, rz = b[0] + a[0], b[1] + a[1], b[2] + a[2]
        x, y, z = unit(ny * rz - nz * ry, nz * rx - nx * rz, nx * ry - ny * rx)
        for axis, part in ((0, x), (1, y), (2, z)):
            a[axis] -= way * part
            b[axis] += way * part


@kernel
def give_way(lanes: Floats, i: int, n_epm: int, motion: Motion) -> None:
    """Let centres of lane ``i`` that have to look out brake; at rest, let them pass each other.

    Then they go half as far as they may from rest and step aside, and are projected as commands are; where that would
    take one farther than it may go, all wait for a substep. Two always pass; of three or more, in one command of some
    hundreds, some stand before each other until the next command. Where braking is too late, as ways are bent, all stop
    at once: the gap goes before the acceleration.
    """
    least, slow, close = motion.gap - 2.0 * GAP_TOLERANCE_M, True, False
    for k in range(n_epm):
        slow &= stopping(lanes, i, route(n_epm, k) + _WAY) == 0.0
        for j in range(k):
            close |= _distance2(lanes, i, route(n_epm, j) + _NEXT, route(n_epm, k) + _NEXT) < least * least
    if not slow and not close:
        for k in range(n_epm):
            brake(lanes, i, route(n_epm, k) + _WAY)
        return
    centres, waits, creep = np.zeros((n_epm, EPM_SIZE)), not slow, min(motion.rise, 1.0) * motion.reach
    steps = np.empty(n_epm)
    for k in range(n_epm):
        e = route(n_epm, k)
        steps[k] = math.sqrt(_distance2(lanes, i, e + _CENTRE, e + _NEXT))
        for axis in range(3):
            centres[k, axis] = 0.5 * (lanes[e + _CENTRE + axis, i] + lanes[e + _NEXT + axis, i])
    for k in range(1, n_epm):
        for j in range(k):
            _step_aside(centres[j], centres[k], motion.gap, _ASIDE * max(steps[j], steps[k]))
    project_reach(centres, motion.r_min, motion.r_max, motion.gap, motion.shell)
    for k in range(n_epm):
        x, y, z = read(lanes, i, route(n_epm, k) + _CENTRE)
        waits |= not norm(centres[k, 0] - x, centres[k, 1] - y, centres[k, 2] - z) <= creep
    for k in range(n_epm):
        e = route(n_epm, k)
        for axis in range(3):
            lanes[e + _NEXT + axis, i] = lanes[e + _CENTRE + axis, i] if waits else centres[k, axis]
        stop(lanes, i, e + _WAY)


@law
def carry(lanes: Floats, i: int, n_epm: int, k: int, size: Size) -> None:
    """Carry the ``k``-th EPM of lane ``i`` to where it goes; put what acts on the robots where it is halfway."""
    e = route(n_epm, k)
    x, y, z = read(lanes, i, e + _CENTRE)
    p, q, r = read(lanes, i, e + _NEXT)
    write(lanes, i, e + _CENTRE, p, q, r)
    ux, uy, uz = read(lanes, i, e + _MOMENT)
    vx, vy, vz = _turn(lanes, i, e)
    x, y, z = 0.5 * (x + p), 0.5 * (y + q), 0.5 * (z + r)
    ux, uy, uz = 0.5 * (ux + vx), 0.5 * (uy + vy), 0.5 * (uz + vz)
    place_epm(lanes, i, k, size, lanes[carried_moment(n_epm) + k, i], x, y, z, ux, uy, uz)


@kernel
def take_up(lanes: Floats, i: int, moments: Floats, epms: Floats, routes: Floats) -> None:
    """Put EPMs (N, 6), their moments (N,) in A m^2 and how they move (N, 48) into lane ``i``."""
    n_epm = len(epms)
    for k in range(n_epm):
        e = route(n_epm, k)
        lanes[carried_moment(n_epm) + k, i] = moments[k]
        for j in range(ROUTE_SIZE):
            lanes[e + j, i] = routes[k, j]
        for j in range(EPM_SIZE):
            lanes[e + _CENTRE + j, i] = epms[k, j]


@law
def put_down(lanes: Floats, i: int, epms: Floats, routes: Floats) -> None:
    """Write where the EPMs of lane ``i`` are (N, 6) and how they move (N, 48)."""
    n_epm = len(epms)
    for k in range(n_epm):
        for j in range(EPM_SIZE):
            epms[k, j] = lanes[route(n_epm, k) + j, i]
        for j in range(ROUTE_SIZE):
            routes[k, j] = lanes[route(n_epm, k) + j, i]
