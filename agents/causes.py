"""What was lost first where control was lost: what the solver found, the room of the EPMs, or a hold that can be tamed.

Three things stand between a controller and a lost episode, and each shows in the record of every hold:

``solver``    The command does not do what the controller asked for (``magenv.outcome``), though the EPMs are free.
``bounds``    The EPMs stand at a limit (least or greatest radius, least gap, their arms' reach), and the command
              does not do what was asked for; of controllers without a solver nobody knows what they asked for: the
              limit alone counts.
``unstable``  Errors grow more than ``GROWTH``-fold until the next command, while the EPMs stand still at the end of
              the hold: a controller cannot measure what it would have to meet.

Each is there now and then in episodes that are held. It is *lost* from the hold on from which it is there, without a
break of over 2 s, until the robots leave: until the hold from whose beginning on they were no longer both near their
references (15 mm). What was lost first is what is so for the longest time. Where none of the three was there then, it
is the first to appear from then on, and ``other`` where none does (EPMs that were never where they should be, for one).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from agents.records import Record
from magenv.outcome import FELL_BACK, NO_SOLVER, NOT_CONVERGED
from magenv.params import System, TaskParams, plant_named
from magenv.poses import POSE_SIZE, to_cartesian
from magenv.reach import Shell, beyond_reach, narrowed
from magenv.stiffness import growth_rates, planar_stiffness
from magenv.wrench import planar_moments

CAUSES = ("solver", "bounds", "unstable", "other")
GROWTH = 10.0
"""Growth of an error from one command to the next beyond which a hold counts as unstable: of the 30 mm at which control
is lost, 3 mm remain then, about as much as localisation and a controller's own error leave open."""
BREAK_S = 2.0
"""So long may what is lost be absent: a hold that happens to be stable does not yet bring the robots back."""
AT_LIMIT_M = 1e-4
"""Nearer to a limit than this an EPM stands at it."""


@dataclass(frozen=True)
class FirstLost:
    """What was lost first, and when."""

    what: str
    """One of ``CAUSES``."""
    time_s: float | None
    """Beginning of the hold from which on it was lost; None for ``other``."""


def lost_first(record: Record) -> FirstLost | None:
    """Return what was lost first in an episode, from its record alone; None where control was kept."""
    if record.success:
        return None
    left = hold_of_leaving(record)
    onsets = [_onset(is_lost, record, left) for is_lost in (_command_lost, _unstable)]
    later = range(left + 1, len(record.substeps))
    first = min((hold for hold in onsets if hold is not None), default=None)
    if first is None:
        first = next((hold for hold in later if _command_lost(record, hold) or _unstable(record, hold)), None)
    if first is None:
        return FirstLost("other", None)
    time_s = float(record.time_s[first])
    if not _command_lost(record, first):
        return FirstLost("unstable", time_s)
    return FirstLost("bounds" if at_limit(record, first) else "solver", time_s)


def hold_of_leaving(record: Record) -> int:
    """Return the last hold at whose beginning both robots were near their references; the first if there is none."""
    holds = len(record.substeps)
    away = record.robots[:holds, :, :2] - record.reference[:holds, :, :2]
    near = np.hypot(away[..., 0], away[..., 1]).max(axis=1) <= TaskParams().tracking_distance_m
    return int(np.flatnonzero(near)[-1]) if near.any() else 0


def growth(record: Record, hold: int) -> float:
    """Return the growth of small errors from one command to the next, of nominal robots where they were at first."""
    system, body = System(n_epm=record.n_epm), plant_named(record.plant).body
    robots, positions = record.robots[hold], np.zeros((2, 3))
    positions[:, :2] = robots[:, :2]
    moments = planar_moments(robots[:, 2], system.ipm_moment_am2)
    stiffness = planar_stiffness(positions, moments, record.epm_pose[hold + 1], system.epm_moment_am2)
    exponent = float(growth_rates(stiffness, body)[0].real) / record.control_hz
    return math.exp(min(exponent, 700.0))  # the greatest numbers


def at_limit(record: Record, hold: int) -> bool:
    """Return whether an EPM stands at a limit of its radius or reach or two at their least gap, or was moved there."""
    system, pose = System(n_epm=record.n_epm), record.epm_pose[hold + 1]
    radii = pose[2::POSE_SIZE]
    centres, directions = to_cartesian(pose)
    reach = narrowed(Shell.of(system, plant_named(record.plant)), AT_LIMIT_M)
    inside = beyond_reach(np.concatenate([centres, directions], axis=-1), reach, False) == 0.0
    gaps = [math.dist(centres[i], centres[j]) for i in range(len(centres)) for j in range(i)]
    inside &= system.r_min_m + AT_LIMIT_M < radii.min() and radii.max() < system.r_max_m - AT_LIMIT_M
    return bool(record.projected[hold]) or not inside or min(gaps) < system.gap_min_m + AT_LIMIT_M


def _command_lost(record: Record, hold: int) -> bool:
    """Return whether the command does not do what was asked for, or without a solver may not."""
    solver = record.solver[hold]
    return at_limit(record, hold) if solver == NO_SOLVER else solver in (NOT_CONVERGED, FELL_BACK)


def _unstable(record: Record, hold: int) -> bool:
    return growth(record, hold) > GROWTH


def _onset(is_lost: Callable[[Record, int], bool], record: Record, last: int) -> int | None:
    """Return the hold from which on something is lost until the hold ``last``, None where it is not lost then."""
    seen, until_s = None, record.time_s[last]
    for hold in range(last, -1, -1):
        if until_s - record.time_s[hold + 1] > BREAK_S:
            break
        if is_lost(record, hold):
            seen, until_s = hold, record.time_s[hold]
    return seen
