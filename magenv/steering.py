"""From a motion wanted to EPM poses: those under which the robots are where they should be when the hold ends.

The hold is foreseen by its linear motion (``linear_hold``) of the wrench and the stiffness that nominal magnets exert.
Of the many poses that serve, those are preferred under which errors grow least until the hold ends, which keep the
headings stiffly, and whose radii are moderate. Least squares from the present poses (Levenberg-Marquardt); where they
miss what is wanted, or errors would grow fast, from calm holds of robots placed alike too (``calm_holds``). What is
found is refined by the motion itself. EPMs are taken to be where they are commanded as the hold begins, and measured
poses to be exact.

Where errors grow so fast that poses a little beside end up far off, no descent finds its way: there only the hold's
beginning is looked at first, then more and more of it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.calm_holds import nearest, put_hold
from magenv.cholesky import factorise, solve
from magenv.forecast import STATE, Course, roll
from magenv.kernels import kernel
from magenv.local import local_basis, shift
from magenv.poses import POSE_SIZE
from magenv.reach import project_within
from magenv.sensitivity import COORDINATES
from magenv.steering_cost import (
    GROWTH,
    LINEAR,
    Steering,
    Workspace,
    differentiate_cost,
    locate,
    look,
    normal_equations,
    weigh,
)

Floats = NDArray[np.float64]

_ITERATIONS, _FIRST_ITERATIONS, _REFINEMENTS = 8, 24, 12
"""From the present poses, from others, and by the motion itself."""
_TRIALS = 6
_STEP_ANGLE, _STEP_RADIUS = 0.5, 0.1
"""Largest change of an angle (rad) and of a radius (m) in an iteration."""
_DAMPING, _REFINING = 0.1, 1e-3
"""Of the first iteration, by the linear motion and by the motion itself."""
_PER_RADIUS = 25.0
"""A metre of a radius is damped as so many squared radians."""
_SLOW = 0.02
"""An iteration that takes off less than this share of the cost is the last."""
_EXACT = 0.04
"""Squared miss down to which poses are refined."""
MET = 4.0
"""Squared miss up to which nothing else is sought."""
_CALM = 4.0
"""Growth, so many times e, up to which no calmer holds are tried."""
_CANDIDATES, _CALMER = 12, 3
"""Calm holds tried where what is wanted is missed, and where errors grow fast."""
_LESS = 0.7
"""Share of the growth beyond which is looked next."""


@kernel
def _step(w: Workspace, epms: Floats, damping: float, limits: Floats) -> bool:
    """Write the EPMs (N, 6) after a damped step into ``w.trial``, within the limits; return whether there is one."""
    u = len(w.downhill)
    w.factor[:], w.step[:] = w.normal, w.downhill
    for p in range(u):
        w.factor[p, p] += damping * (_PER_RADIUS if p % POSE_SIZE == 2 else 1.0)
    for k in range(len(epms)):
        x, y, z, at = epms[k, 0], epms[k, 1], epms[k, 2], POSE_SIZE * k + 2
        radius, out = math.sqrt(x * x + y * y + z * z), w.downhill[at] > 0.0
        if (radius >= limits[1] - 1e-9) if out else (radius <= limits[0] + 1e-9):  # it stays at its bound
            for q in range(at):
                w.factor[at, q] = 0.0
            for q in range(at + 1, u):
                w.factor[q, at] = 0.0
            w.factor[at, at], w.step[at] = 1.0, 0.0
    if not factorise(w.factor):
        return False
    solve(w.factor, w.step)
    largest = 1.0
    for p in range(u):
        largest = max(largest, abs(w.step[p]) / (_STEP_RADIUS if p % POSE_SIZE == 2 else _STEP_ANGLE))
    for p in range(u):
        w.step[p] /= largest
    w.trial[:] = epms
    for k in range(len(epms)):
        at = POSE_SIZE * k
        shift(w.trial[k], w.bases[k], w.step[at : at + POSE_SIZE], limits[0], limits[1])
    project_within(w.trial, limits)
    return True


@kernel
def _descend(
    s: Steering, w: Workspace, state: Floats, limits: Floats, iterations: int, epms: Floats
) -> tuple[float, float, float]:
    """Improve the EPMs (N, 6) in place by the linear motion; return cost, squared miss, growth (so many times e).

    The miss is that at the end of what is looked at, which is less of a hold where errors grow fast at first.
    """
    damping, substeps = _DAMPING, look(s, w, state, 0.0)
    cost = weigh(s, w, state, substeps, epms, w.residuals)
    grown = GROWTH * w.residuals[COORDINATES]
    if grown > LINEAR:
        substeps = look(s, w, state, grown)
        cost = weigh(s, w, state, substeps, epms, w.residuals)
    for _ in range(iterations):
        differentiate_cost(s, w, state, substeps, epms)
        new = math.inf
        for _ in range(_TRIALS):
            if _step(w, epms, damping, limits):
                new = weigh(s, w, state, substeps, w.trial, w.others)
                if new < cost:
                    break
            damping = 8.0 * damping + 1e-3
        if not new < cost:
            break
        epms[:], w.residuals[:] = w.trial, w.others
        damping *= 0.1
        slow, cost = new > (1.0 - _SLOW) * cost, new
        if slow:
            break
    miss = 0.0
    for i in range(COORDINATES):
        miss += w.residuals[i] ** 2
    return cost if cost < math.inf else math.inf, miss, GROWTH * w.residuals[COORDINATES]


@kernel
def descend_calmly(
    s: Steering, w: Workspace, state: Floats, limits: Floats, iterations: int, epms: Floats
) -> tuple[float, float]:
    """Improve EPMs (N, 6) in place, that are to hold robots of ``state`` (12,) calmly; return cost, squared miss."""
    locate(w, state, np.zeros(COORDINATES))
    cost, miss, _ = _descend(s, w, state, limits, iterations, epms)
    return cost, miss


@kernel
def _land(w: Workspace, state: Floats, epms: Floats, sensitivity: Floats) -> float:
    """Write the misses (12,) of the motion itself under EPMs (N, 6), and where it leads; return their square.

    And their slopes by local coordinates, if ``sensitivity`` (12, 5 N or 0) has columns, which is overwritten.
    """
    w.course.path[0] = epms
    if sensitivity.shape[1] > 0:
        sensitivity[:] = 0.0
        for k in range(len(epms)):
            local_basis(epms[k], w.bases[k])
        w.course.by[0, 1] = w.bases
    w.landed[:] = state
    course = Course(w.course.which[: w.goal.marks[0]], w.course.path, w.course.by, False)
    return roll(w.model, w.landed, np.zeros(COORDINATES), course, w.goal, 0, sensitivity, w.misses, w.slopes)


@kernel
def _refine(w: Workspace, state: Floats, limits: Floats, epms: Floats) -> float:
    """Bring the robots nearer to the goal by the motion itself, in place, EPMs (N, 6) changed as little as possible.

    Returns the squared miss that is left.
    """
    none, damping = np.empty((STATE, 0)), _REFINING
    miss = _land(w, state, epms, none)
    for _ in range(_REFINEMENTS):
        if not miss > _EXACT:
            break
        _land(w, state, epms, w.sensitivity)
        normal_equations(w, w.misses, w.slopes)
        new = math.inf
        for _ in range(_TRIALS):
            if _step(w, epms, damping, limits):
                new = _land(w, state, w.trial, none)
                if new < miss:
                    break
            damping *= 16.0
        if not new < miss:
            break
        epms[:], miss = w.trial, new
        damping *= 0.1
    return miss


@kernel
def _follow(s: Steering, w: Workspace, state: Floats, limits: Floats, grown: float, epms: Floats) -> float:
    """Refine the EPMs (N, 6) in place, for the hold's beginning first where errors grow fast, then for more of it.

    Returns the squared miss at the end of the hold.
    """
    while LINEAR < grown < math.inf:
        look(s, w, state, grown)
        _refine(w, state, limits, epms)
        grown *= _LESS
    look(s, w, state, 0.0)
    return _refine(w, state, limits, epms)


@kernel
def _from_calm_holds(
    s: Steering,
    w: Workspace,
    state: Floats,
    heading: float,
    limits: Floats,
    found: tuple[float, float, float],
    present: Floats,
    best: Floats,
) -> None:
    """Look for poses better than ``best`` (N, 6), of cost, miss and growth ``found``; they are written there, refined.

    From calm holds; where these lead to nothing either, from the ``present`` ones as they are.
    """
    cost, miss, grown = found
    which, others = np.empty(_CANDIDATES, np.int64), np.empty((_CANDIDATES + 1, *best.shape))
    costs, growths = np.full(_CANDIDATES + 1, math.inf), np.empty(_CANDIDATES + 1)
    others[_CANDIDATES] = present
    costs[_CANDIDATES], _, growths[_CANDIDATES] = _descend(s, w, state, limits, 0, others[_CANDIDATES])
    nearest(s.calm, state, heading, which)
    for i in range(_CANDIDATES):
        if miss <= MET and i >= _CALMER:
            break
        put_hold(s.calm, which[i], state, heading, others[i])
        project_within(others[i], limits)
        costs[i], other_miss, growths[i] = _descend(s, w, state, limits, _FIRST_ITERATIONS, others[i])
        if costs[i] < cost:
            cost, miss, grown, best[:] = costs[i], other_miss, growths[i], others[i]
    miss = _follow(s, w, state, limits, grown, best)
    for i in np.argsort(costs):
        if miss <= MET or not costs[i] < math.inf:
            break
        other_miss = _follow(s, w, state, limits, growths[i], others[i])
        if other_miss < miss or not miss < math.inf:
            miss, best[:] = other_miss, others[i]


@kernel
def steer(
    s: Steering, w: Workspace, state: Floats, ahead: Floats, heading: float, limits: Floats, epms: Floats
) -> float:
    """Change EPMs (N, 6) so that robots come as far as wanted in the coming hold; return the squared miss.

    ``w.landed`` (12,) then holds the state that this leads to.

    Parameters
    ----------
    s, w
        What is believed, and room for one thread.
    state : ndarray, shape (12,)
        Robots' x, y (m), heading (rad), then their rates.
    ahead : ndarray, shape (6,)
        How far they should come, m and rad.
    heading : float
        Of the frame that the robots carry, rad.
    limits : ndarray, shape (7,)
        See ``reach.make_allowed``.
    epms : ndarray, shape (N, 6)
        Where the EPMs are, then where they should be.

    Returns
    -------
    float
        By the nominal plant itself, in units of 0.1 mm and 3 mrad, squared; NaN or infinite where nothing could be
        foreseen: poses are as they were.
    """
    locate(w, state, ahead)
    best = epms.copy()
    found = _descend(s, w, state, limits, _ITERATIONS, best)
    calm = found[1] <= MET and found[2] <= _CALM
    if not calm or not _follow(s, w, state, limits, found[2], best) <= MET:
        _from_calm_holds(s, w, state, heading, limits, found, epms, best)
    miss = _land(w, state, best, np.empty((STATE, 0)))
    if miss < math.inf:
        epms[:] = best
    return miss
