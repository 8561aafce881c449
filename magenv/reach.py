"""How far the arms reach that carry the EPMs: a shell round each arm's shoulder, and which ways lie within it.

Arm k carries EPM k; its centre stands for the arm's wrist, about which it may be turned anyhow. The arms stand evenly
round the workspace, the first to the left of robots that head along x, where the first EPM is at home. As seen from the
workspace centre a shell is all that is nearer than some distance, another one in every direction (``Shell.of`` sees to
it). So an EPM that draws in stays within reach, and may go round as far in as all of its way allows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.angles import arctan2, sincos
from magenv.arithmetic import dot2, dot3
from magenv.kernels import kernel, law, typed
from magenv.params import Plant, System, require
from magenv.poses import GAP_TOLERANCE_M, keeps_gap, project_epms
from magenv.ways import Vector, norm

Floats = NDArray[np.float64]

REACH_TOLERANCE_M = 2.0 * GAP_TOLERANCE_M
"""Within this ways lie in the shell: commands do within the least gap's tolerance."""
COMMAND_MARGIN_M = 1e-5
"""By what a controller's commands keep clear of the shell: more than they are rounded by before they act."""
_SPARE_M = 1e-3
"""By which the sphere of least radius lies within each shell."""
_STRETCHES = 32
"""Of a way, in each of which its distance from the shoulder is bounded by what bends it at most."""


class Shell(NamedTuple):
    """Where the centre of an EPM can be, as seen from the shoulder of its arm."""

    inner: float
    """m."""
    outer: float
    """m; infinite, the arms reach everywhere."""
    aside: float
    """m from the workspace centre to a shoulder, level."""
    height: float
    """m of a shoulder above the robots' plane."""

    @classmethod
    def of(cls, system: System, plant: Plant) -> Shell:
        """Return the shell of each arm.

        Raises
        ------
        ValueError
            If the arms reach only part of the way round the workspace, or stand so near that parts of it are behind
            what is too near for them.
        """
        inner, outer = plant.arm_reach_min_m, plant.arm_reach_m
        away = math.hypot(plant.arm_distance_m, plant.arm_height_m)
        low, high = max(math.hypot(system.r_max_m, inner), system.r_min_m + inner + _SPARE_M), outer - system.r_min_m
        high -= _SPARE_M
        require(high >= low, "arm_reach_m", f"at least {outer + low - high:.4g}, for arms to reach all round", outer)
        must_be = f"such that shoulders {plant.arm_height_m:g} m high are {low:.4g} to {high:.4g} m from the centre"
        must_be += f" (now {away:.4g} m)"
        require(outer == math.inf or low <= away <= high, "arm_distance_m", must_be, plant.arm_distance_m)
        return cls(inner, outer, plant.arm_distance_m, plant.arm_height_m)


EVERYWHERE = Shell.of(System(), Plant())
"""No limit."""


@law
def narrowed(shell: Shell, by: float) -> Shell:
    """Return a shell that is narrower by ``by`` (m) on either side."""
    return Shell(shell.inner + by, shell.outer - by, shell.aside, shell.height)


@law
def shoulder(shell: Shell, k: int, n_epm: int) -> Vector:
    """Return the shoulder of arm ``k`` of ``n_epm``, m."""
    s, c = sincos(2.0 * math.pi * k / n_epm)
    return -shell.aside * s, shell.aside * c, shell.height


_LOOK, _CARRY = typed(False), typed(True)
"""Values of ``carry``: for literals numba would compile all anew."""


@kernel
def _beyond(epm: Floats, shell: Shell, base: Vector, carry: bool) -> float:
    """Return by how much a centre (3,) is out of the shell round ``base`` (m); where ``carry`` says, move it inside."""
    x, y, z = epm[0] - base[0], epm[1] - base[1], epm[2] - base[2]
    distance = norm(x, y, z)
    within = min(max(distance, shell.inner), shell.outer)
    if carry and distance != within:
        if distance == 0.0:  # no direction to move along: any will do
            z, distance = 1.0, 1.0
        scale = within / distance
        epm[0], epm[1], epm[2] = base[0] + scale * x, base[1] + scale * y, base[2] + scale * z
    return abs(distance - within)


@kernel
def beyond_reach(epms: Floats, shell: Shell, carry: bool) -> float:
    """Return by how much the centres of EPMs (N, 6) are out of reach at most (m); ``carry``: move them within it."""
    worst = 0.0
    for k in range(len(epms)):
        worst = max(worst, _beyond(epms[k], shell, shoulder(shell, k, len(epms)), carry))
    return worst


@kernel
def project_reach(epms: Floats, r_min: float, r_max: float, gap: float, shell: Shell) -> bool:
    """Make ``epms`` (N, 6) feasible in place, moments kept; return whether gap or reach moved a centre by over 1e-9 m.

    Radii and gap, see ``project_epms``, and the way to the nearest point of the shell, in turns until all hold.
    """
    moved = project_epms(epms, r_min, r_max, gap)
    if shell.outer < math.inf:
        for _ in range(10_000):
            if beyond_reach(epms, shell, _LOOK) <= GAP_TOLERANCE_M:
                break
            moved = True
            beyond_reach(epms, shell, _CARRY)
            project_epms(epms, r_min, r_max, gap)
    return moved


@law
def shell_of(limits: Floats) -> Shell:
    """Return the shell in ``limits`` (7,): least and greatest radius, least gap, then those of the shell."""
    return Shell(limits[3], limits[4], limits[5], limits[6])


@kernel
def project_within(epms: Floats, limits: Floats) -> bool:
    """Make ``epms`` (N, 6) feasible in place, see ``project_reach``."""
    return project_reach(epms, limits[0], limits[1], limits[2], shell_of(limits))


@kernel
def make_allowed(epms: Floats, row: int, limits: Floats) -> bool:
    """Project a row of EPMs (n, N, 6), radii within the limits, if centres are too close or out of reach.

    Returns whether they were.
    """
    near = limits[4] == math.inf or beyond_reach(epms[row], shell_of(limits), _LOOK) == 0.0
    return False if near and keeps_gap(epms, row, limits[2]) else project_within(epms[row], limits)


@kernel
def room(shell: Shell, base: Vector, u: Vector, across: Vector, angle: float) -> float:
    """Return the greatest radius (m) at which the whole way round from u by ``angle`` (rad) is within reach."""
    along, side = dot3(*u, *base), dot3(*across, *base)
    most = math.sqrt(dot2(along, side, along, side))  # of the shoulder's distance in the direction of the EPM
    away2, peak = dot3(*base, *base), arctan2(side, along)
    s, c = sincos(angle)
    end = dot2(along, side, c, s)
    nearest = most if 0.0 <= peak <= angle else max(along, end)
    farthest = -most if peak + math.pi <= angle else min(along, end)
    out = farthest + math.sqrt(max(shell.outer * shell.outer - away2 + farthest * farthest, 0.0))
    hole = nearest * nearest - away2 + shell.inner * shell.inner
    return min(out, nearest - math.sqrt(hole)) if nearest > 0.0 and hole > 0.0 else out


@kernel
def stays(
    shell: Shell, base: Vector, u: Vector, across: Vector, angle: float, near: float, far: float, slack: float
) -> bool:
    """Return whether a way surely lies within the shell or ``slack`` (m) beyond it, or no farther out than it begins.

    It goes round from unit vector u by ``angle`` (rad), its radius from ``near`` to ``far`` (m) in step. The square of
    its distance from the shoulder bends by so much at most that between two points it is no farther off the chord than
    a parabola.
    """
    wide = narrowed(shell, -slack)
    if max(near, far) <= room(wide, base, u, across, angle):
        return True
    along, side, away2, out = dot3(*u, *base), dot3(*across, *base), dot3(*base, *base), far - near
    turn = angle * math.sqrt(dot2(along, side, along, side))
    bend = (2.0 * out * out + 4.0 * abs(out) * turn + 2.0 * max(near, far) * angle * turn) / _STRETCHES**2
    last = near * near + away2 - 2.0 * near * along
    most, least = max(wide.outer * wide.outer, last), min(max(wide.inner, 0.0) ** 2, last)
    for j in range(1, _STRETCHES + 1):
        s, c = sincos(angle * j / _STRETCHES)
        radius = near + out * j / _STRETCHES
        new = radius * radius + away2 - 2.0 * radius * dot2(along, side, c, s)
        high, low = max(last, new), min(last, new)
        if high - low < 0.5 * bend:  # the parabola's vertex is in between
            excess = 0.5 * bend * (0.5 - (high - low) / bend) ** 2
            high, low = high + excess, low - excess
        if high > most or low < least:
            return False
        last = new
    return True
