"""EPMs that move at finite speed: how they go on from where they are to where they are commanded.

An EPM's centre goes round the workspace centre on the great circle to its goal while its radius changes in step, so
that it comes no nearer than the nearer end; its moment turns the shortest way. Each command is a move of its own, gone
evenly: angle and radius grow by the same at every substep, and the centre has its full speed where its radius is
largest. What the EPMs do to the robots in a substep is what they do halfway. Where two centres would come closer than
the least gap, they go slower, are moved apart as commands are, and step aside, always to the same side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.angles import arctan2, sincos
from magenv.arithmetic import cross2, dot2, dot3
from magenv.dynamics import place_epm
from magenv.kernels import kernel, law
from magenv.lanes import carried_moment, route
from magenv.params import Plant, System
from magenv.poses import EPM_SIZE, GAP_TOLERANCE_M, project_epms

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]

_CENTRE, _MOMENT, _GOAL, _GOAL_MOMENT, _NEXT, _RADIUS, _GROWTH, _WAY, _TURN = 0, 3, 6, 9, 12, 15, 16, 17, 26
"""Within an EPM's fields: its centre (m) and unit moment, those commanded, its centre at the substep's end; its radius
and what that grows by in a substep (m); the way of its direction from the workspace centre, and that of its moment."""
_ALONG, _ACROSS, _SINE, _COSINE, _LEFT = 0, 3, 6, 7, 8
"""Within a way, which is nine fields: the unit vector that turns, the one at right angles to it towards the goal; of
the angle by which both turn in a substep; the substeps left, a fraction at the end."""
_ALMOST = 1.0 + 1e-9
"""Substeps that count as one: more than rounding can be."""
_OPPOSITE = 1e-6
"""Sine below which two directions count as opposite: any way round is the shortest."""
_UPRIGHT = 0.9999
"""Height above which a unit vector has no horizontal one beside it to speak of."""
_ASIDE = 0.25
"""Share of what a centre may go in a substep by which it steps aside."""


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

    @classmethod
    def of(cls, system: System, plant: Plant, substep_s: float) -> Motion:
        """Return the limits of a substep; of no use, but of the same types, where the EPMs jump."""
        reach, turn = plant.epm_speed_mps * substep_s, plant.epm_turn_radps * substep_s
        return cls(reach, turn, system.r_min_m, system.r_max_m, system.gap_min_m)


@law
def _read(lanes: Floats, i: int, at: int) -> Vector:
    return lanes[at, i], lanes[at + 1, i], lanes[at + 2, i]


@law
def _write(lanes: Floats, i: int, at: int, x: float, y: float, z: float) -> None:
    lanes[at, i], lanes[at + 1, i], lanes[at + 2, i] = x, y, z


@law
def _norm(x: float, y: float, z: float) -> float:
    return math.sqrt(dot3(x, y, z, x, y, z))


@law
def _unit(x: float, y: float, z: float) -> Vector:
    norm = _norm(x, y, z)
    scale = 1.0 / norm if norm > 0.0 else 0.0
    return scale * x, scale * y, scale * z


@law
def _cross(u: Vector, v: Vector) -> Vector:
    return cross2(u[1], u[2], v[1], v[2]), cross2(u[2], u[0], v[2], v[0]), cross2(u[0], u[1], v[0], v[1])


@law
def _way_round(u: Vector, v: Vector) -> tuple[float, Vector]:
    """Return the angle (rad) from unit vector u to v, and the unit vector at right angles to u towards v.

    Where v is opposite, any: one that is horizontal, or in the plane of u and the x axis where u is upright.
    """
    axis = _cross(u, v)
    sine, cosine = _norm(*axis), dot3(*u, *v)
    if (sine < _OPPOSITE) & (cosine < 0.0):
        axis = (0.0, 1.0, 0.0) if abs(u[2]) > _UPRIGHT else (0.0, 0.0, 1.0)
    return arctan2(sine, cosine), _unit(*_cross(axis, u))


@law
def _set_way(lanes: Floats, i: int, w: int, u: Vector, across: Vector, angle: float, left: float) -> None:
    """Write the way whose fields begin at ``w``: from unit vector u by ``angle`` (rad) in ``left`` substeps."""
    _write(lanes, i, w + _ALONG, *u)
    _write(lanes, i, w + _ACROSS, *across)
    lanes[w + _SINE, i], lanes[w + _COSINE, i] = sincos(angle / max(left, 1.0))
    lanes[w + _LEFT, i] = left


@law
def _go_way(lanes: Floats, i: int, w: int) -> tuple[Vector, bool]:
    """Go a substep on the way whose fields begin at ``w``; return the unit vector, and whether it is at its end."""
    sine, cosine = lanes[w + _SINE, i], lanes[w + _COSINE, i]
    ux, uy, uz = _read(lanes, i, w + _ALONG)
    tx, ty, tz = _read(lanes, i, w + _ACROSS)
    x, y, z = dot2(cosine, sine, ux, tx), dot2(cosine, sine, uy, ty), dot2(cosine, sine, uz, tz)
    _write(lanes, i, w + _ALONG, x, y, z)
    _write(lanes, i, w + _ACROSS, dot2(cosine, -sine, tx, ux), dot2(cosine, -sine, ty, uy), dot2(cosine, -sine, tz, uz))
    there: bool = lanes[w + _LEFT, i] <= _ALMOST
    lanes[w + _LEFT, i] -= 1.0
    return (x, y, z), there


@kernel
def _draw_way(lanes: Floats, i: int, e: int, at: int, reach: float) -> None:
    """Draw the way of the centre at ``at`` of the EPM whose fields begin at ``e`` to its goal.

    No chord of a substep is longer than ``reach`` (m): none is longer than the arc at the largest radius.
    """
    x, y, z = _read(lanes, i, at)
    gx, gy, gz = _read(lanes, i, e + _GOAL)
    radius, goal = _norm(x, y, z), _norm(gx, gy, gz)
    u = (x / radius, y / radius, z / radius)
    angle, across = _way_round(u, (gx / goal, gy / goal, gz / goal))
    arc, out = max(radius, goal) * angle, goal - radius
    left = math.sqrt(dot2(arc, out, arc, out)) / reach
    _set_way(lanes, i, e + _WAY, u, across, angle, left)
    lanes[e + _RADIUS, i], lanes[e + _GROWTH, i] = radius, out / max(left, 1.0)


@law
def _go(lanes: Floats, i: int, e: int) -> None:
    """Write where the centre of the EPM whose fields begin at ``e`` goes, alone, in a substep."""
    (x, y, z), there = _go_way(lanes, i, e + _WAY)
    radius = lanes[e + _RADIUS, i] + lanes[e + _GROWTH, i]
    lanes[e + _RADIUS, i] = radius
    gx, gy, gz = _read(lanes, i, e + _GOAL)
    x, y, z = (gx if there else radius * x), (gy if there else radius * y), (gz if there else radius * z)
    _write(lanes, i, e + _NEXT, x, y, z)


@kernel
def _draw_turn(lanes: Floats, i: int, e: int, turn: float) -> None:
    """Draw the way of the moment of the EPM whose fields begin at ``e`` to that commanded, ``turn`` (rad) a substep."""
    u = _read(lanes, i, e + _MOMENT)
    angle, across = _way_round(u, _read(lanes, i, e + _GOAL_MOMENT))
    _set_way(lanes, i, e + _TURN, u, across, angle, angle / turn)


@law
def _turn(lanes: Floats, i: int, e: int) -> Vector:
    """Turn the moment of the EPM whose fields begin at ``e`` for a substep and return it."""
    (x, y, z), there = _go_way(lanes, i, e + _TURN)
    gx, gy, gz = _read(lanes, i, e + _GOAL_MOMENT)
    x, y, z = (gx if there else x), (gy if there else y), (gz if there else z)
    _write(lanes, i, e + _MOMENT, x, y, z)
    return x, y, z


@law
def _distance2(lanes: Floats, i: int, a: int, b: int) -> float:
    """Return the squared distance of two points of lane ``i`` whose fields begin at ``a`` and ``b``."""
    (ax, ay, az), (bx, by, bz) = _read(lanes, i, a), _read(lanes, i, b)
    return dot3(bx - ax, by - ay, bz - az, bx - ax, by - ay, bz - az)


@law
def go_on(lanes: Floats, i: int, n_epm: int, motion: Motion) -> bool:
    """Find where the centres in lane ``i`` would go in a substep; return whether two of them would come too close."""
    near, least = False, motion.gap - 2.0 * GAP_TOLERANCE_M  # goals are allowed within the tolerance
    for k in range(n_epm):
        _go(lanes, i, route(n_epm, k))
    for k in range(1, n_epm):
        for j in range(k):
            near |= _distance2(lanes, i, route(n_epm, j) + _NEXT, route(n_epm, k) + _NEXT) < least * least
    return near


@kernel
def _step_aside(a: Floats, b: Floats, gap: float, way: float) -> None:
    """Move two centres that are too close by ``way`` (m) to opposite sides, round each other: else they might stand."""
    nx, ny, nz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    if _norm(nx, ny, nz) < gap:
        rx, ry, rz = b[0] + a[0], b[1] + a[1], b[2] + a[2]
        x, y, z = _unit(ny * rz - nz * ry, nz * rx - nx * rz, nx * ry - ny * rx)
        for axis, part in ((0, x), (1, y), (2, z)):
            a[axis] -= way * part
            b[axis] += way * part


@kernel
def give_way(lanes: Floats, i: int, n_epm: int, motion: Motion) -> None:
    """Let centres of lane ``i`` that would come too close pass each other.

    They go half as far as they may and step aside, then are projected as commands are; where that would take one
    farther than it may go, all wait for a substep. Their ways are drawn anew. Two always pass; of three or more, in one
    command of some hundreds, some stand before each other until the next command.
    """
    centres, waits = np.zeros((n_epm, EPM_SIZE)), False
    for k in range(n_epm):
        e = route(n_epm, k)
        for axis in range(3):
            centres[k, axis] = 0.5 * (lanes[e + _CENTRE + axis, i] + lanes[e + _NEXT + axis, i])
    for k in range(1, n_epm):
        for j in range(k):
            _step_aside(centres[j], centres[k], motion.gap, _ASIDE * motion.reach)
    project_epms(centres, motion.r_min, motion.r_max, motion.gap)
    for k in range(n_epm):
        x, y, z = _read(lanes, i, route(n_epm, k) + _CENTRE)
        waits |= not _norm(centres[k, 0] - x, centres[k, 1] - y, centres[k, 2] - z) <= motion.reach
    for k in range(n_epm):
        e = route(n_epm, k)
        for axis in range(3):
            lanes[e + _NEXT + axis, i] = lanes[e + _CENTRE + axis, i] if waits else centres[k, axis]
        _draw_way(lanes, i, e, e + _NEXT, motion.reach)


@law
def carry(lanes: Floats, i: int, n_epm: int) -> None:
    """Carry the EPMs of lane ``i`` to where they go; put what acts on the robots where they are halfway."""
    for k in range(n_epm):
        e = route(n_epm, k)
        x, y, z = _read(lanes, i, e + _CENTRE)
        p, q, r = _read(lanes, i, e + _NEXT)
        _write(lanes, i, e + _CENTRE, p, q, r)
        ux, uy, uz = _read(lanes, i, e + _MOMENT)
        vx, vy, vz = _turn(lanes, i, e)
        x, y, z = 0.5 * (x + p), 0.5 * (y + q), 0.5 * (z + r)
        ux, uy, uz = 0.5 * (ux + vx), 0.5 * (uy + vy), 0.5 * (uz + vz)
        place_epm(lanes, i, k, lanes[carried_moment(n_epm), i], x, y, z, ux, uy, uz)


@kernel
def set_off(lanes: Floats, i: int, row: int, moment: float, epms: Floats, targets: Floats, motion: Motion) -> None:
    """Put the EPMs (n, N, 6) of a row, their moment (A m^2) and their ways to the ``targets`` into lane ``i``."""
    n_epm = epms.shape[1]
    lanes[carried_moment(n_epm), i] = moment
    for k in range(n_epm):
        e = route(n_epm, k)
        for j in range(EPM_SIZE):
            lanes[e + _CENTRE + j, i] = epms[row, k, j]
            lanes[e + _GOAL + j, i] = targets[row, k, j]
        _draw_way(lanes, i, e, e + _CENTRE, motion.reach)
        _draw_turn(lanes, i, e, motion.turn)


@law
def arrive(lanes: Floats, i: int, row: int, epms: Floats) -> None:
    """Write where the EPMs of lane ``i`` are into a row of ``epms`` (n, N, 6)."""
    n_epm = epms.shape[1]
    for k in range(n_epm):
        for j in range(EPM_SIZE):
            epms[row, k, j] = lanes[route(n_epm, k) + j, i]
