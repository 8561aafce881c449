"""Ways of unit vectors: from rest to rest along a great circle, speed rising, constant and falling evenly.

A way is fifteen neighbouring fields of a lane (see ``magenv.lanes``), which begin at ``w``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.angles import arctan2, sincos
from magenv.arithmetic import cross2, dot2, dot3
from magenv.kernels import kernel, law

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]

_ALONG, _ACROSS, _SINE, _COSINE, _BEND_SINE, _BEND_COSINE = 0, 3, 6, 7, 8, 9
_UP, _FLAT, _DOWN, _NEW, _WHOLE = range(10, 15)
"""Within a way: the unit vector that turns, the one at right angles to it towards the goal; of
the angle by which both turn in a substep, and of that by which it changes; substeps left of rising, constant and
falling speed; one where a goal waits to be set off for; one where the way ends at its goal."""
_OPPOSITE = 1e-6
"""Sine below which two directions count as opposite: any way round is the shortest."""
_UPRIGHT = 0.9999
"""Height above which a unit vector has no horizontal one beside it to speak of."""
_LESS = 1e-9
"""Part of a substep that is none: more than rounding can be."""


@law
def read(lanes: Floats, i: int, at: int) -> Vector:
    """Return the vector that begins at the field ``at`` of lane ``i``."""
    return lanes[at, i], lanes[at + 1, i], lanes[at + 2, i]


@law
def write(lanes: Floats, i: int, at: int, x: float, y: float, z: float) -> None:
    """Write the vector that begins at the field ``at`` of lane ``i``."""
    lanes[at, i], lanes[at + 1, i], lanes[at + 2, i] = x, y, z


@law
def norm(x: float, y: float, z: float) -> float:
    """Return the length of a vector."""
    return math.sqrt(dot3(x, y, z, x, y, z))


@law
def unit(x: float, y: float, z: float) -> Vector:
    """Return the vector at length one; the zero vector for itself."""
    size = norm(x, y, z)
    scale = 1.0 / size if size > 0.0 else 0.0
    return scale * x, scale * y, scale * z


@law
def _cross(u: Vector, v: Vector) -> Vector:
    return cross2(u[1], u[2], v[1], v[2]), cross2(u[2], u[0], v[2], v[0]), cross2(u[0], u[1], v[0], v[1])


@law
def way_round(u: Vector, v: Vector) -> tuple[float, Vector]:
    """Return the angle (rad) from unit vector u to v, and the unit vector at right angles to u towards v.

    Where v is opposite or u itself, any: one that is horizontal, or in the plane of u and the x axis where u is
    upright.
    """
    axis = _cross(u, v)
    sine, cosine = norm(*axis), dot3(*u, *v)
    if (sine < _OPPOSITE) & (cosine < 0.0) | (sine == 0.0):
        axis = (0.0, 1.0, 0.0) if abs(u[2]) > _UPRIGHT else (0.0, 0.0, 1.0)
    return arctan2(sine, cosine), unit(*_cross(axis, u))


@kernel
def ramp(way: float, rise: float) -> tuple[int, int]:
    """Return the substeps of rising and of constant speed of a move.

    ``way`` is how many substeps at full speed would take, ``rise`` the share of full speed by which it changes in a
    substep. Speed rises in ``up`` steps, stays for ``flat`` and falls in ``up`` - 1: up (up + flat) first steps.
    """
    if way * rise <= 1.0:  # full speed is not reached
        return max(1, math.ceil(math.sqrt(way / rise) - _LESS)), 0
    up = max(1, math.ceil(1.0 / rise - _LESS))
    return up, max(0, math.ceil(way - up - _LESS))


@kernel
def share_gone(j: int, up: int, flat: int) -> float:
    """Return the share of a move that is done after ``j`` substeps, by its ``ramp``."""
    rising = min(j, up)
    even = min(max(j - up, 0), flat)
    falling = min(max(j - up - flat, 0), up - 1)
    done = rising * (rising + 1) // 2 + up * even + falling * up - falling * (falling + 1) // 2
    return done / (up * (up + flat))


@kernel
def longest_way(rise: float, substeps: int) -> float:
    """Return the longest way, in substeps at full speed, whose ``ramp`` takes no more than so many."""
    full = max(1, math.ceil(1.0 / rise - _LESS))
    if substeps >= 2 * full - 1:
        return 1.0 * (substeps - full + 1)
    up = (substeps + 1) // 2
    return rise * up * up


@law
def set_way(lanes: Floats, i: int, w: int, u: Vector, across: Vector, angle: float, up: int, flat: int) -> None:
    """Write the way whose fields begin at ``w``: from unit vector u by ``angle`` (rad)."""
    write(lanes, i, w + _ALONG, *u)
    write(lanes, i, w + _ACROSS, *across)
    lanes[w + _BEND_SINE, i], lanes[w + _BEND_COSINE, i] = sincos(angle / (up * (up + flat)))
    lanes[w + _SINE, i], lanes[w + _COSINE, i] = 0.0, 1.0
    lanes[w + _UP, i], lanes[w + _FLAT, i], lanes[w + _DOWN, i] = up, flat, up - 1
    lanes[w + _NEW, i], lanes[w + _WHOLE, i] = 0.0, 1.0


@law
def goes_on(lanes: Floats, i: int, w: int) -> None:
    """Make the way whose fields begin at ``w`` part of a longer one: at its end its goal is set off for anew."""
    lanes[w + _NEW, i], lanes[w + _WHOLE, i] = 1.0, 0.0


@law
def stopping(lanes: Floats, i: int, w: int) -> float:
    """Return the substeps that the way whose fields begin at ``w`` goes on for if it brakes from now on."""
    stopping: float = max(lanes[w + _DOWN, i] - lanes[w + _UP, i], 0.0)
    return stopping


@law
def brake(lanes: Floats, i: int, w: int) -> None:
    """Let the way whose fields begin at ``w`` come to rest; then its goal, perhaps a new one, is set off for."""
    lanes[w + _DOWN, i] = stopping(lanes, i, w)
    lanes[w + _UP, i], lanes[w + _FLAT, i] = 0.0, 0.0
    goes_on(lanes, i, w)


@law
def go_way(lanes: Floats, i: int, w: int) -> tuple[Vector, float, bool, bool]:
    """Go a substep on the way whose fields begin at ``w``.

    Returns the unit vector, by how many steps the speed has changed, whether it moves, and whether it is at its goal.
    """
    up, flat, down = lanes[w + _UP, i], lanes[w + _FLAT, i], lanes[w + _DOWN, i]
    moves, there = up + flat + down > 0.0, (up + flat + down == 1.0) & (lanes[w + _WHOLE, i] > 0.0)
    change = 1.0 if up > 0.0 else (0.0 if flat > 0.0 else -1.0)
    bend_s = change * lanes[w + _BEND_SINE, i]
    bend_c = lanes[w + _BEND_COSINE, i] if change != 0.0 else 1.0
    sine, cosine = lanes[w + _SINE, i], lanes[w + _COSINE, i]
    sine, cosine = dot2(sine, cosine, bend_c, bend_s), dot2(cosine, -sine, bend_c, bend_s)
    sine, cosine = (sine if moves else 0.0), (cosine if moves else 1.0)
    lanes[w + _SINE, i], lanes[w + _COSINE, i] = sine, cosine
    lanes[w + _UP, i] = max(up - 1.0, 0.0)
    lanes[w + _FLAT, i] = flat - 1.0 if (up == 0.0) & (flat > 0.0) else flat
    lanes[w + _DOWN, i] = down - 1.0 if (up + flat == 0.0) & (down > 0.0) else down
    ux, uy, uz = read(lanes, i, w + _ALONG)
    tx, ty, tz = read(lanes, i, w + _ACROSS)
    x, y, z = dot2(cosine, sine, ux, tx), dot2(cosine, sine, uy, ty), dot2(cosine, sine, uz, tz)
    write(lanes, i, w + _ALONG, x, y, z)
    write(lanes, i, w + _ACROSS, dot2(cosine, -sine, tx, ux), dot2(cosine, -sine, ty, uy), dot2(cosine, -sine, tz, uz))
    return (x, y, z), change, moves, there


@law
def at_rest(lanes: Floats, i: int, w: int) -> bool:
    """Return whether the way whose fields begin at ``w`` is at its end."""
    rests: bool = lanes[w + _UP, i] + lanes[w + _FLAT, i] + lanes[w + _DOWN, i] == 0.0
    return rests


@law
def is_waiting(lanes: Floats, i: int, w: int) -> bool:
    """Return whether the way whose fields begin at ``w`` is at its end and a goal is to be set off for."""
    waiting: bool = (lanes[w + _NEW, i] > 0.0) & at_rest(lanes, i, w)
    return waiting


@law
def stop(lanes: Floats, i: int, w: int) -> None:
    """End the way whose fields begin at ``w`` at once; then its goal is set off for."""
    brake(lanes, i, w)
    lanes[w + _DOWN, i] = 0.0
