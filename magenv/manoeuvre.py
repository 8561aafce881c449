"""The motion of EPMs from one command to the next as a controller foresees it, and what of it is within their reach."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.angles import sincos
from magenv.arithmetic import dot3
from magenv.forecast import Course
from magenv.kernels import kernel
from magenv.params import Plant, System
from magenv.poses import EPM_SIZE, GAP_TOLERANCE_M, keeps_gap
from magenv.reach import COMMAND_MARGIN_M, narrowed, project_reach, room, shoulder, stays
from magenv.travel import Motion
from magenv.ways import longest_way, ramp, share_gone, way_round

Floats = NDArray[np.float64]

_LESS = 1.0 - 1e-4
"""A little less than what is allowed: more than rounding to an action can be, for which a way takes longer."""
_HALVINGS = 30
"""Of the interval in which the greatest share lies by which centres keep the gap."""
_HALVES = 8
"""Ways half as far round each that are tried where one would leave the shell."""


class Arms(NamedTuple):
    """What limits commands and the EPMs' motion to them."""

    limits: Motion
    """Of a substep."""
    substeps: int
    """Of a command's time, in which the EPMs are to arrive."""
    travels: bool
    """Whether they travel, or jump."""

    @classmethod
    def of(cls, system: System, plant: Plant, substep_s: float, substeps: int) -> Arms:
        """Return the limits of a system on a plant, for commands of so many substeps."""
        return cls(Motion.of(system, plant, substep_s, substeps), substeps, not plant.epms_jump)


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
    motion: Course,
    k: int,
) -> None:
    """Write the motion of EPM ``k``'s centre (``first`` 0) or moment (3) from start to goal (3,), and its derivatives.

    ``bases`` (2, N, 6, 5) are those of the EPMs at both; without, there are no derivatives. Those of a great circle by
    its ends: an end that moves along it takes what is gone of it along in proportion, one that moves across by the
    sine of what is gone.
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
        share = share_gone(j, up, flat)
        s, c = sincos(share * angle)
        radius = near + share * out
        for i in range(3):
            place = radius * (c * u[i] + s * t[i])
            if j > 0:
                motion.path[j - 1, k, first + i] += 0.5 * place
            if j < rows:
                motion.path[j, k, first + i] = 0.5 * place
        for new in range(len(bases)):
            gone = share if new == 1 else 1.0 - share
            across = math.sin(gone * angle) / sine if sine > 1e-6 else gone
            size = far if new == 1 else near
            end = ends[1 - new]
            for column in range(first, 3 if first == 0 else 5):
                along, aside = 0.0, 0.0
                for i in range(3):
                    along += end[i] * bases[new, k, first + i, column] / size
                    aside += b[i] * bases[new, k, first + i, column] / size
                for i in range(3):
                    by = radius * (gone * along * (c * t[i] - s * u[i]) + across * aside * b[i])
                    if first == 0 and column == 2:
                        by = gone * (c * u[i] + s * t[i])
                    if j > 0:
                        motion.by[j - 1, new, k, first + i, column] += 0.5 * by
                    if j < rows:
                        motion.by[j, new, k, first + i, column] = 0.5 * by


@kernel
def move(arms: Arms, before: Floats, command: Floats, bases: Floats, motion: Course) -> None:
    """Write the motion from one command to the next, (N, 6) each.

    ``bases`` (2, N, 6, 5) are theirs. Without any, (0, N, 6, 5), no derivatives are written.
    """
    if not arms.travels:
        motion.path[0] = command
        if len(bases) > 0:
            motion.by[0, 1] = bases[1]
        return
    limits = arms.limits
    for k in range(len(command)):
        for first in range(0, EPM_SIZE, 3):  # no literals: each would be compiled anew
            rise, reach = (limits.rise, limits.reach) if first == 0 else (limits.turn_rise, limits.turn)
            start, goal = before[k, first : first + 3], command[k, first : first + 3]
            _go_part(start, goal, bases, first, rise, reach, motion, k)


@kernel
def _length(start: Floats, goal: Floats, first: int) -> float:
    """Return the way from start to goal (3,) of a centre (``first`` 0), m, or of a moment (3), rad."""
    near, u = _unit(start)
    far, v = _unit(goal)
    angle, _ = way_round(u, v)
    arc, out = (max(near, far) * angle, far - near) if first == 0 else (angle, 0.0)
    return math.sqrt(arc * arc + out * out)


@kernel
def _within(start: Floats, goal: Floats, first: int, most: float) -> float:
    """Return the share of the way from start to goal (3,) of a centre (``first`` 0) or moment (3) that is ``most``."""
    way = _length(start, goal, first)
    return 1.0 if way <= most else _LESS * most / way


@kernel
def _go_share(start: Floats, goal: Floats, share: float, out: Floats) -> None:
    """Write where a share of the way from start to goal (3,) ends."""
    near, u = _unit(start)
    far, v = _unit(goal)
    angle, t = way_round(u, v)
    s, c = sincos(share * angle)
    for i in range(3):
        out[i] = goal[i] if share == 1.0 else (near + share * (far - near)) * (c * u[i] + s * t[i])


@kernel
def _bend(limits: Motion, k: int, before: Floats, goal: Floats, most: float) -> None:
    """Bring the goal of EPM ``k``'s centre, (n, 6) as the places before, to where it can go at once and within reach.

    That is as far round as ``most`` (m) of way allow, or a half of it, a quarter, and so on; and as far out as the way
    stays within the shell. Where there is no such way it remains where it is.
    """
    shell = narrowed(limits.shell, COMMAND_MARGIN_M)
    base = shoulder(shell, k, len(goal))
    near, u = _unit(before[k, :3])
    far, v = _unit(goal[k, :3])
    angle, t = way_round(u, v)
    share, low, found = _within(before[k, :3], goal[k, :3], 0, most), near, False
    for _ in range(_HALVES):
        turn = share * angle
        s, c = sincos(turn)
        w = (c * u[0] + s * t[0], c * u[1] + s * t[1], c * u[2] + s * t[2])
        high = min(near + share * (far - near), room(shell, base, w, t, 0.0))
        low = max(limits.r_min, near - _LESS * math.sqrt(max(most * most - (near * turn) ** 2, 0.0)))
        if low > high:
            found = False
        elif stays(shell, base, u, t, turn, near, high, 0.0):
            low, found = high, True
        elif stays(shell, base, u, t, turn, near, low, 0.0):
            found = True
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                if stays(shell, base, u, t, turn, near, middle, 0.0):
                    low = middle
                else:
                    high = middle
        if found:
            break
        share *= 0.5
    if found and share == 1.0 and low == far:
        return
    for i in range(3):
        goal[k, i] = before[k, i] if not found else low * w[i]


@kernel
def _keeps_apart(arms: Arms, before: Floats, command: Floats, least: float) -> bool:
    """Return whether no two centres come closer than ``least`` (m), all the way from the poses before, (N, 6) each."""
    n, limits, longest = len(command), arms.limits, 0.0
    lengths, place = np.empty(n), np.zeros((1, n, EPM_SIZE))
    for k in range(n):
        lengths[k] = _length(before[k, :3], command[k, :3], 0)
        longest = max(longest, lengths[k])
        place[0, k] = command[k]
    if not keeps_gap(place, 0, least):
        return False
    if keeps_gap(place, 0, least + 2.0 * longest):  # too far from each other to come close
        return True
    for j in range(arms.substeps):
        for k in range(n):
            up, flat = ramp(lengths[k] / limits.reach, limits.rise)
            _go_share(before[k, :3], command[k, :3], share_gone(j, up, flat), place[0, k, :3])
        if not keeps_gap(place, 0, least):
            return False
    return True


@kernel
def allow(arms: Arms, before: Floats, command: Floats) -> None:
    """Make a command (N, 6) one that keeps radii, gap and reach, and where the EPMs travel, is reached in its time.

    Centres that would come too close, on the way or at its end, go less far, all by the same share: before, they were
    not.
    """
    limits = arms.limits
    project_reach(command, limits.r_min, limits.r_max, limits.gap, narrowed(limits.shell, COMMAND_MARGIN_M))
    if not arms.travels:
        return
    goal, shares = command.copy(), np.empty(len(command))
    reach, turn = longest_way(limits.rise, arms.substeps), longest_way(limits.turn_rise, arms.substeps)
    for k in range(len(command)):
        if limits.shell.outer < math.inf:
            _bend(limits, k, before, goal, limits.reach * reach)
        shares[k] = _within(before[k, :3], goal[k, :3], 0, limits.reach * reach)
        _go_share(before[k, :3], goal[k, :3], shares[k], command[k, :3])
        _go_share(
            before[k, 3:], goal[k, 3:], _within(before[k, 3:], goal[k, 3:], 3, limits.turn * turn), command[k, 3:]
        )
    least = limits.gap - GAP_TOLERANCE_M
    if _keeps_apart(arms, before, command, least):
        return
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        for k in range(len(command)):
            _go_share(before[k, :3], goal[k, :3], middle * shares[k], command[k, :3])
        low, high = (middle, high) if _keeps_apart(arms, before, command, least) else (low, middle)
    for k in range(len(command)):
        _go_share(before[k, :3], goal[k, :3], low * shares[k], command[k, :3])
