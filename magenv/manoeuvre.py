"""The motion of EPMs from one command to the next as a controller foresees it, and what of it is within their reach."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.angles import sincos
from magenv.arithmetic import dot3
from magenv.forecast import Motion
from magenv.kernels import kernel
from magenv.params import Plant, System
from magenv.poses import project_epms
from magenv.travel import Motion as Limits
from magenv.travel import ramp, way_round

Floats = NDArray[np.float64]

_LESS = 1.0 - 1e-9
"""A little less than what is allowed: more than rounding can be."""


class Arms(NamedTuple):
    """What limits commands and the EPMs' motion to them."""

    limits: Limits
    """Of a substep."""
    substeps: int
    """Of a command's time, in which the EPMs are to arrive."""
    travels: bool
    """Whether they travel, or jump."""

    @classmethod
    def of(cls, system: System, plant: Plant, substep_s: float, substeps: int) -> Arms:
        """Return the limits of a system on a plant, for commands of so many substeps."""
        return cls(Limits.of(system, plant, substep_s, substeps), substeps, not plant.epms_jump)


@kernel
def _share(j: int, up: int, flat: int) -> float:
    """Return the share of a move that is done after ``j`` substeps, see ``travel.ramp``."""
    rising = min(j, up)
    even = min(max(j - up, 0), flat)
    falling = min(max(j - up - flat, 0), up - 1)
    done = rising * (rising + 1) // 2 + up * even + falling * up - falling * (falling + 1) // 2
    return done / (up * (up + flat))


@kernel
def _longest(rise: float, substeps: int) -> float:
    """Return the longest way, in substeps at full speed, that is gone in so many."""
    full = max(1, math.ceil(1.0 / rise))
    if substeps >= 2 * full - 1:
        return 1.0 * (substeps - full + 1)
    up = (substeps + 1) // 2
    return rise * up * up


@kernel
def _unit(v: Floats) -> tuple[float, tuple[float, float, float]]:
    size = math.sqrt(dot3(v[0], v[1], v[2], v[0], v[1], v[2]))
    return size, (v[0] / size, v[1] / size, v[2] / size)


@kernel
def _go_part(
    start: Floats,
    goal: Floats,
    bases: Floats,
    first: int,
    rise: float,
    reach: float,
    motion: Motion,
    k: int,
    differentiated: bool,
) -> None:
    """Write the motion of EPM ``k``'s centre (``first`` 0) or moment (3) from start to goal (3,), and its derivatives.

    ``bases`` (2, 6, 5) are those of the EPM at both. The derivatives of a great circle by its ends: an end that moves
    along it takes what is gone of it along in proportion, one that moves across by the sine of what is gone.
    """
    near, u = _unit(start)
    far, v = _unit(goal)
    angle, t = way_round(u, v)
    out, arc = far - near, max(near, far) * angle
    way = math.sqrt(arc * arc + out * out) if first == 0 else angle
    up, flat = ramp(way / reach, rise)
    b = (u[1] * t[2] - u[2] * t[1], u[2] * t[0] - u[0] * t[2], u[0] * t[1] - u[1] * t[0])
    sine, cosine = sincos(angle)
    ends = ((cosine * t[0] - sine * u[0], cosine * t[1] - sine * u[1], cosine * t[2] - sine * u[2]), t)
    rows = len(motion.path)
    for j in range(rows + 1):
        share = _share(j, up, flat)
        s, c = sincos(share * angle)
        radius = near + share * out
        for i in range(3):
            place = radius * (c * u[i] + s * t[i])
            if j > 0:
                motion.path[j - 1, k, first + i] += 0.5 * place
            if j < rows:
                motion.path[j, k, first + i] = 0.5 * place
        if not differentiated:
            continue
        for new in range(2):
            gone = share if new == 1 else 1.0 - share
            across = math.sin(gone * angle) / sine if sine > 1e-6 else gone
            size = far if new == 1 else near
            end = ends[1 - new]
            for column in range(first, 3 if first == 0 else 5):
                basis, along, aside = bases[new, first:, column], 0.0, 0.0
                for i in range(3):
                    along += end[i] * basis[i] / size
                    aside += b[i] * basis[i] / size
                for i in range(3):
                    by = radius * (gone * along * (c * t[i] - s * u[i]) + across * aside * b[i])
                    if first == 0 and column == 2:
                        by = gone * (c * u[i] + s * t[i])
                    if j > 0:
                        motion.by[j - 1, new, k, first + i, column] += 0.5 * by
                    if j < rows:
                        motion.by[j, new, k, first + i, column] = 0.5 * by


@kernel
def move(arms: Arms, before: Floats, command: Floats, bases: Floats, motion: Motion, differentiated: bool) -> None:
    """Write the motion from one command to the next, (N, 6) each; ``bases`` (2, N, 6, 5) are theirs."""
    if not arms.travels:
        motion.path[0] = command
        motion.by[0, 1] = bases[1]
        return
    limits = arms.limits
    for k in range(len(command)):
        both = bases[:, k].copy()
        _go_part(before[k, :3], command[k, :3], both, 0, limits.rise, limits.reach, motion, k, differentiated)
        _go_part(before[k, 3:], command[k, 3:], both, 3, limits.turn_rise, limits.turn, motion, k, differentiated)


@kernel
def _shorten(start: Floats, goal: Floats, radial: bool, most: float) -> None:
    """Draw a goal (3,) back along the great circle until its way is at most ``most`` (m, or rad)."""
    near, u = _unit(start)
    far, v = _unit(goal)
    angle, t = way_round(u, v)
    arc, out = (max(near, far) * angle, far - near) if radial else (angle, 0.0)
    way = math.sqrt(arc * arc + out * out)
    if way <= most:
        return
    share = _LESS * most / way
    s, c = sincos(share * angle)
    for i in range(3):
        goal[i] = (near + share * out if radial else 1.0) * (c * u[i] + s * t[i])


@kernel
def allow(arms: Arms, before: Floats, command: Floats) -> None:
    """Make a command (N, 6) one that keeps radii and gap, and where the EPMs travel, one they arrive at in its time."""
    limits = arms.limits
    project_epms(command, limits.r_min, limits.r_max, limits.gap)
    if arms.travels:
        for k in range(len(command)):
            _shorten(before[k, :3], command[k, :3], True, limits.reach * _longest(limits.rise, arms.substeps))
            _shorten(before[k, 3:], command[k, 3:], False, limits.turn * _longest(limits.turn_rise, arms.substeps))
