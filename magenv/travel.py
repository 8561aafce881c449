"""EPMs that move at finite speed: how they go on from where they are to where they are commanded.

An EPM's centre goes round the workspace centre on the great circle to its goal while its radius changes in step, so
that it comes no nearer than the nearer end; its moment turns the shortest way. Both go on at every substep, and what
the EPMs do to the robots in a substep is what they do halfway. Where two centres would come closer than the least gap,
they go slower, are moved apart as commands are, and step aside, always to the same side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.angles import arctan2
from magenv.arithmetic import dot2, dot3, fma
from magenv.dynamics import place_epm
from magenv.kernels import kernel, law
from magenv.lanes import carried_moment, route
from magenv.params import Plant, System
from magenv.poses import EPM_SIZE, GAP_TOLERANCE_M, project_epms

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]

_CENTRE, _MOMENT, _GOAL, _GOAL_MOMENT, _NEXT = 0, 3, 6, 9, 12
"""Within an EPM's fields: its centre (m) and unit moment, those commanded, its centre at the substep's end."""
_OPPOSITE = 1e-6
"""Sine below which two directions count as opposite: any way round is the shortest."""
_ASIDE = 0.25
"""Share of what a centre may go in a substep by which it steps aside."""


class Motion(NamedTuple):
    """What limits the EPMs' motion in a substep."""

    reach: float
    """m a centre moves at most."""
    turn_sine: float
    """Of the angle by which a moment turns at most."""
    turn_cosine: float
    r_min: float
    """m."""
    r_max: float
    """m."""
    gap: float
    """m."""

    @classmethod
    def of(cls, system: System, plant: Plant, substep_s: float) -> Motion:
        """Return the limits of a substep; of no use, but of the same types, where the EPMs jump."""
        turn = min(plant.epm_turn_radps * substep_s, math.pi)
        reach = plant.epm_speed_mps * substep_s
        return cls(reach, math.sin(turn), math.cos(turn), system.r_min_m, system.r_max_m, system.gap_min_m)


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
def _way_round(u: Vector, v: Vector) -> tuple[float, float, Vector]:
    """Return sine and cosine of the angle from unit vector u to v, and the unit vector at right angles to u towards v.

    Where v is opposite, any: one that is horizontal, or in the plane of u and the x axis where u is upright.
    """
    ux, uy, uz = u
    cosine = dot3(ux, uy, uz, *v)
    tx, ty, tz = v[0] - cosine * ux, v[1] - cosine * uy, v[2] - cosine * uz
    sine = _norm(tx, ty, tz)
    none = (sine < _OPPOSITE) & (cosine < 0.0)
    upright = abs(uz) > 0.9999
    sx, sy = (1.0 if upright else -uy), (0.0 if upright else ux)
    tx, ty, tz = _unit((sx if none else tx), (sy if none else ty), (0.0 if none else tz))
    along = dot3(ux, uy, uz, tx, ty, tz)  # of a small difference much is rounding
    return sine, cosine, _unit(tx - along * ux, ty - along * uy, tz - along * uz)


@law
def _go(lanes: Floats, i: int, e: int, reach: float) -> None:
    """Write where the centre of the EPM whose fields begin at ``e`` would go, alone, in a substep."""
    x, y, z = _read(lanes, i, e + _CENTRE)
    gx, gy, gz = _read(lanes, i, e + _GOAL)
    radius, goal = _norm(x, y, z), _norm(gx, gy, gz)
    ux, uy, uz = x / radius, y / radius, z / radius
    sine, cosine, (tx, ty, tz) = _way_round((ux, uy, uz), (gx / goal, gy / goal, gz / goal))
    angle, out = arctan2(sine, cosine), goal - radius
    # Lengths of ways, as they are at the radius halfway: to the goal, then (where it is not reached) in this substep.
    arc = fma(0.5, out, radius) * angle
    there = dot2(arc, out, arc, out) <= reach * reach
    half = 0.5 * reach / math.sqrt(dot2(radius * angle, out, radius * angle, out))
    arc = fma(half, out, radius) * angle
    share = reach / math.sqrt(dot2(arc, out, arc, out))
    arc, out = share * radius * angle, share * out
    scale = (radius + out) / math.sqrt(radius * radius + arc * arc)  # along the tangent, then on to the radius
    nx, ny, nz = scale * (x + arc * tx), scale * (y + arc * ty), scale * (z + arc * tz)
    _write(lanes, i, e + _NEXT, (gx if there else nx), (gy if there else ny), (gz if there else nz))


@law
def _distance2(lanes: Floats, i: int, a: int, b: int) -> float:
    """Return the squared distance of two points of lane ``i`` whose fields begin at ``a`` and ``b``."""
    (ax, ay, az), (bx, by, bz) = _read(lanes, i, a), _read(lanes, i, b)
    return dot3(bx - ax, by - ay, bz - az, bx - ax, by - ay, bz - az)


@law
def _turn(lanes: Floats, i: int, e: int, sine: float, cosine: float) -> Vector:
    """Return the moment of the EPM whose fields begin at ``e`` after a substep."""
    ux, uy, uz = _read(lanes, i, e + _MOMENT)
    vx, vy, vz = _read(lanes, i, e + _GOAL_MOMENT)
    _, between, (tx, ty, tz) = _way_round((ux, uy, uz), (vx, vy, vz))
    there = between >= cosine
    ux, uy, uz = _unit(cosine * ux + sine * tx, cosine * uy + sine * ty, cosine * uz + sine * tz)
    return (vx if there else ux), (vy if there else uy), (vz if there else uz)


@law
def go_on(lanes: Floats, i: int, n_epm: int, motion: Motion) -> bool:
    """Find where the centres in lane ``i`` would go in a substep; return whether two of them would come too close."""
    near, least = False, motion.gap - 2.0 * GAP_TOLERANCE_M  # goals are allowed within the tolerance
    for k in range(n_epm):
        _go(lanes, i, route(n_epm, k), motion.reach)
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
    farther than it may go, all wait for a substep.
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


@law
def carry(lanes: Floats, i: int, n_epm: int, motion: Motion) -> None:
    """Carry the EPMs of lane ``i`` to where they go; put what acts on the robots where they are halfway."""
    for k in range(n_epm):
        e = route(n_epm, k)
        x, y, z = _read(lanes, i, e + _CENTRE)
        p, q, r = _read(lanes, i, e + _NEXT)
        ux, uy, uz = _read(lanes, i, e + _MOMENT)
        vx, vy, vz = _turn(lanes, i, e, motion.turn_sine, motion.turn_cosine)
        _write(lanes, i, e + _CENTRE, p, q, r)
        _write(lanes, i, e + _MOMENT, vx, vy, vz)
        x, y, z = 0.5 * (x + p), 0.5 * (y + q), 0.5 * (z + r)
        ux, uy, uz = 0.5 * (ux + vx), 0.5 * (uy + vy), 0.5 * (uz + vz)
        place_epm(lanes, i, k, lanes[carried_moment(n_epm), i], x, y, z, ux, uy, uz)


@law
def set_off(lanes: Floats, i: int, row: int, moment: float, epms: Floats, targets: Floats) -> None:
    """Put the EPMs (n, N, 6) of a row, their moment (A m^2) and where they are commanded into lane ``i``."""
    n_epm = epms.shape[1]
    lanes[carried_moment(n_epm), i] = moment
    for k in range(n_epm):
        for j in range(EPM_SIZE):
            lanes[route(n_epm, k) + j, i] = epms[row, k, j]
            lanes[route(n_epm, k) + EPM_SIZE + j, i] = targets[row, k, j]


@law
def arrive(lanes: Floats, i: int, row: int, epms: Floats) -> None:
    """Write where the EPMs of lane ``i`` are into a row of ``epms`` (n, N, 6)."""
    n_epm = epms.shape[1]
    for k in range(n_epm):
        for j in range(EPM_SIZE):
            epms[row, k, j] = lanes[route(n_epm, k) + j, i]
