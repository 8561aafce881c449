"""From a motion wanted to EPM poses: those under which the robots are where they should be when the hold ends.

The hold is foreseen by its linear motion M q'' + D q' = F + K q about where the robots are, of the wrench F and the
stiffness K that nominal magnets exert on them there: some microseconds, where integrating the plant takes a hundred.
Of the many poses that serve, those are preferred under which errors grow least until the hold ends, which keep the
headings stiffly, and whose radii are moderate. Least squares from the present poses (Levenberg-Marquardt); where they
miss what is wanted, or errors would grow fast, from others too. EPMs are taken to be where they are commanded as the
hold begins, and measured poses to be exact.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.angles import sincos, wrap
from magenv.cholesky import factorise, solve
from magenv.kernels import kernel
from magenv.local import local_basis, shift
from magenv.magnets import robots_wrench
from magenv.params import Plant, System
from magenv.poses import EPM_SIZE, HOME_RADIUS_M, POSE_SIZE
from magenv.reach import project_within
from magenv.sensitivity import COORDINATES, Model, go, load_state, place, read_state
from magenv.stiffness import planar_kernel

Floats = NDArray[np.float64]

_POSITION_M, _HEADING_RAD = 1e-4, 3e-3
"""Misses that count one."""
_GROWTH = 0.5
"""Growth of errors that counts one: so many times e in a hold."""
_FIELD_T, _FIELD_SPREAD_T = 0.010, 0.020
"""Field along a heading, and by how much another one counts one."""
_RADIUS_SPREAD_M = 0.16
"""By how much another radius than that at home counts one."""
_ROWS = COORDINATES + 3
"""Residuals apart from those of the radii."""
_SUBSTEP_S = 0.01
"""Of the foreseen motion; decay by drag is exact in each."""
ITERATIONS, FIRST_ITERATIONS = 8, 24
"""From the present poses, and from others."""
_TRIALS = 6
_STEP_ANGLE, _STEP_RADIUS = 0.5, 0.1
"""Largest change of an angle (rad) and of a radius (m) in an iteration."""
_DAMPING = 0.1
_PER_RADIUS = 25.0
"""A metre of a radius is damped as so many squared radians."""
_CORRECTIONS, _CORRECTING, _EXACT = 3, 3, 0.04
"""For what the linear motion leaves out: how often, of how many iterations, and down to which squared miss."""
_POLISH = 0.2
"""Weight of growth in these: which hold it is to be is settled then."""
_FIXED_POINT = 6
"""Iterations for the rates, damped by a half."""
_DIFFERENCE = 1e-6
"""Over which slopes are taken."""
_SLOW = 0.02
"""An iteration that takes off less than this share of the cost is the last."""
MET = 4.0
"""Squared miss up to which nothing else is sought."""
_CALM = 8.0
"""Growth, as it counts, up to which a few others are not tried."""
_CALMER = 3
"""How many others are tried to find less growth."""
_STARTS = 8
"""Other poses to start from: so many in the robots' frame, and as many beside the present ones."""
_DRAWN = 400
_CHOSEN = {2: (314, 55, 306, 175, 138, 316, 299, 377), 3: (242, 23, 66, 269, 208, 116, 150, 213)}
"""Of so many random poses those that, each with the ones before, lead to the least cost on average: over random states
of robots 21 to 60 mm apart, as many others lead to costs six times as high."""


class Steering(NamedTuple):
    """What steering believes of the plant, and where it starts from."""

    model: Model
    """Nominal magnets; kernels work in copies of it."""
    drag: Floats
    """(6,) N s/m and N m s/rad, of x, y, heading of both robots."""
    decay: Floats
    """(6,) share of the rates left after a substep."""
    root: Floats
    """(6,) square roots of the inverse drags."""
    lag: Floats
    """(6,) inertia over drag, s."""
    left: Floats
    """(6,) of a deviation's mean over a hold, the share at its end."""
    substep: float
    """s."""
    substeps: int
    starts: Floats
    """(m, N, 6) EPMs in the robots' frame."""
    nudges: Floats
    """(m, N, 5) steps in local coordinates from the present poses."""

    @classmethod
    def of(cls, system: System, plant: Plant, period_s: float) -> Steering:
        """Return the steering on a nominal plant, with holds of ``period_s``."""
        substeps = max(1, math.ceil(period_s / _SUBSTEP_S - 1e-9))
        substep, n, body = period_s / substeps, system.n_epm, plant.body
        drag = np.tile([body.drag_linear_nspm, body.drag_linear_nspm, body.drag_rotational_nmsprad], 2)
        inertia = np.tile([body.mass_kg, body.mass_kg, body.inertia_kgm2], 2)
        periods = period_s * drag / inertia  # a hold, in times in which drag stops a robot
        rng = np.random.default_rng(0)
        starts = rng.normal(size=(_DRAWN, n, 2, 3))[np.array(_CHOSEN[n])]
        starts /= np.linalg.norm(starts, axis=-1, keepdims=True)
        starts[:, :, 0] *= HOME_RADIUS_M
        spread = np.geomspace(0.05, 0.5, _STARTS)[:, None, None] * np.array([1.0, 1.0, 0.15, 1.0, 1.0])
        return cls(
            Model.of(system, plant, substep),
            drag,
            np.exp(-drag * substep / inertia),
            1.0 / np.sqrt(drag),
            inertia / drag,
            periods * np.exp(-periods) / -np.expm1(-periods),
            substep,
            substeps,
            starts.reshape(-1, n, EPM_SIZE),
            spread * rng.normal(size=(_STARTS, n, POSE_SIZE)),
        )


class Workspace(NamedTuple):
    """Room to compute in, for one thread."""

    model: Model
    force: Floats
    """(6,) wrench on the robots, N and N m."""
    moved: Floats
    """(6,) where they are after the hold, from where they were; so are the rates."""
    rates: Floats
    landed: Floats
    """(12,) state after the hold, by the motion itself."""
    scaled: Floats
    """(6, 6) stiffness over drag, made symmetric."""
    growth: Floats
    """(6, 6) its exponential over the hold."""
    product: Floats
    trial: Floats
    """(N, 6) EPMs."""
    bases: Floats
    """(N, 6, 5)"""
    residuals: Floats
    """(r,)"""
    others: Floats
    jacobian: Floats
    """(r, 5 N)"""
    normal: Floats
    """(5 N, 5 N)"""
    factor: Floats
    slope: Floats
    """(5 N,)"""
    step: Floats


@kernel
def workspace(s: Steering) -> Workspace:
    """Return room of one's own."""
    n, m = s.starts.shape[1], s.model
    u, rows, c = POSE_SIZE * n, _ROWS + n, COORDINATES
    model = Model(
        m.lane.copy(),
        m.epm_moment.copy(),
        m.nominal,
        m.substep,
        np.zeros((2, 3)),
        np.zeros((2, 3)),
        np.zeros((c, c)),
        np.zeros((c, EPM_SIZE * n)),
    )
    return Workspace(
        model,
        np.empty(c),
        np.empty(c),
        np.empty(c),
        np.empty(2 * c),
        np.empty((c, c)),
        np.empty((c, c)),
        np.empty((c, c)),
        np.empty((n, EPM_SIZE)),
        np.zeros((n, EPM_SIZE, POSE_SIZE)),
        np.empty(rows),
        np.empty(rows),
        np.empty((rows, u)),
        np.empty((u, u)),
        np.empty((u, u)),
        np.empty(u),
        np.empty(u),
    )


@kernel
def _multiply(a: Floats, b: Floats, out: Floats) -> None:
    for i in range(COORDINATES):
        a0, a1, a2, a3, a4, a5 = a[i, 0], a[i, 1], a[i, 2], a[i, 3], a[i, 4], a[i, 5]
        for j in range(COORDINATES):  # written out, so that it is vectorised
            first, second = a0 * b[0, j] + a1 * b[1, j] + a2 * b[2, j], a3 * b[3, j] + a4 * b[4, j] + a5 * b[5, j]
            out[i, j] = first + second


@kernel
def log_growth(a: Floats, period: float, exponential: Floats, scratch: Floats) -> float:
    """Return the logarithm of the norm of exp(a period), for a symmetric ``a`` (6, 6) in 1/s; both others are written.

    By its Taylor series over a small part of the period, and squaring.
    """
    norm = 0.0
    for i in range(COORDINATES):
        row = 0.0
        for j in range(COORDINATES):
            row += abs(a[i, j])
        norm = max(norm, row)
    halvings, part = 0, period
    while norm * part > 0.5 and halvings < 60:
        part *= 0.5
        halvings += 1
    exponential[:] = 0.0
    for order in range(6, 0, -1):
        for i in range(COORDINATES):
            exponential[i, i] += 1.0
        _multiply(a, exponential, scratch)
        for i in range(COORDINATES):
            for j in range(COORDINATES):
                exponential[i, j] = part / order * scratch[i, j]
    for i in range(COORDINATES):
        exponential[i, i] += 1.0
    for _ in range(halvings):
        _multiply(exponential, exponential, scratch)
        exponential[:] = scratch
    square = 0.0
    for i in range(COORDINATES):
        for j in range(COORDINATES):
            square += exponential[i, j] ** 2
    return 0.5 * math.log(square)


@kernel
def foresee(s: Steering, w: Workspace, rates: Floats) -> None:
    """Write into ``w`` how far the robots come in the hold, from ``rates`` (6,), by its force and stiffness."""
    k, x, v, half = w.model.stiffness, w.moved, w.rates, 0.5 * s.substep
    for i in range(COORDINATES):
        x[i], v[i] = 0.0, rates[i]
    for _ in range(s.substeps):
        for i in range(COORDINATES):
            x[i] += half * v[i]
        for i in range(COORDINATES):
            first = k[i, 0] * x[0] + k[i, 1] * x[1] + k[i, 2] * x[2]
            second = k[i, 3] * x[3] + k[i, 4] * x[4] + k[i, 5] * x[5]
            v[i] = s.decay[i] * v[i] + (1.0 - s.decay[i]) / s.drag[i] * (w.force[i] + first + second)
        for i in range(COORDINATES):
            x[i] += half * v[i]


@kernel
def locate(w: Workspace, state: Floats) -> None:
    """Put the robots of ``state`` (12,) into the model."""
    model = w.model
    n = len(model.epm_moment)
    for robot in range(2):
        sine, cosine = sincos(state[3 * robot + 2])
        moment = model.nominal[n + robot]
        model.positions[robot, 0], model.positions[robot, 1] = state[3 * robot], state[3 * robot + 1]
        model.moments[robot, 0], model.moments[robot, 1] = moment * cosine, moment * sine


@kernel
def estimate_rates(s: Steering, w: Workspace, mean: Floats, state: Floats, epms: Floats) -> None:
    """Write into the last half of ``state`` (12,) the rates now, of the ``mean`` ones (6,) of the hold that has ended.

    EPMs (N, 6) as they are now move the robots by D v = F - M v', where v' = K v / D: rates that follow the force. What
    differs from these decays by drag; of the mean over the hold, so much is left at its end. All zero: at rest.
    """
    moving = 0.0
    for i in range(COORDINATES):
        moving += abs(mean[i])
        state[COORDINATES + i] = 0.0
    if moving == 0.0:
        return
    _exert(s, w, state, epms)
    k, v = w.model.stiffness, state[COORDINATES:]
    for _ in range(_FIXED_POINT):
        for i in range(COORDINATES):
            w.rates[i] = w.force[i] / s.drag[i]
            for j in range(COORDINATES):
                w.rates[i] -= s.lag[i] * k[i, j] / s.drag[i] * v[j]
        for i in range(COORDINATES):
            v[i] = 0.5 * (v[i] + w.rates[i])
    for i in range(COORDINATES):
        v[i] += s.left[i] * (mean[i] - v[i])


@kernel
def _exert(s: Steering, w: Workspace, state: Floats, epms: Floats) -> None:
    """Write force and stiffness under EPMs (N, 6) into ``w``."""
    model, n = w.model, len(epms)
    place(model, epms)
    force = robots_wrench(model.lane, 0, n, None, state[0], state[1], state[2], state[3], state[4], state[5])
    for i in range(COORDINATES):
        w.force[i] = force[i]
    planar_kernel(model.positions, model.moments, epms, model.epm_moment, False, model.stiffness, model.gradients)


@kernel
def _weigh(s: Steering, w: Workspace, state: Floats, ahead: Floats, care: float, epms: Floats, out: Floats) -> float:
    """Write the residuals (r,) of EPMs (N, 6); return their squared sum."""
    model, n = w.model, len(epms)
    _exert(s, w, state, epms)
    foresee(s, w, state[COORDINATES:])
    for i in range(COORDINATES):
        out[i] = (w.moved[i] - ahead[i]) / (_HEADING_RAD if i % 3 == 2 else _POSITION_M)
        for j in range(COORDINATES):
            w.scaled[i, j] = s.root[i] * model.stiffness[i, j] * s.root[j]
    grown = log_growth(w.scaled, s.substep * s.substeps, w.growth, w.product)
    out[COORDINATES] = care * (0.0 if grown < 0.0 else grown) / _GROWTH
    for robot in range(2):
        turn = 3 * robot + 2
        field = -model.stiffness[turn, turn] / model.nominal[n + robot]
        out[COORDINATES + 1 + robot] = (field - _FIELD_T) / _FIELD_SPREAD_T
    for k in range(n):
        x, y, z = epms[k, 0], epms[k, 1], epms[k, 2]
        out[_ROWS + k] = (math.sqrt(x * x + y * y + z * z) - HOME_RADIUS_M) / _RADIUS_SPREAD_M
    cost = 0.0
    for value in out:
        cost += value * value
    return cost


@kernel
def _differentiate(s: Steering, w: Workspace, state: Floats, ahead: Floats, care: float, epms: Floats) -> None:
    """Write the slopes of the residuals by the EPMs' local coordinates, and the normal equations."""
    step = np.zeros(POSE_SIZE)
    j, r = w.jacobian, w.residuals
    for k in range(len(epms)):
        local_basis(epms[k], w.bases[k])
        for c in range(POSE_SIZE):
            w.trial[:] = epms
            step[:] = 0.0
            step[c] = _DIFFERENCE
            shift(w.trial[k], w.bases[k], step, 0.0, math.inf)
            _weigh(s, w, state, ahead, care, w.trial, w.others)
            for i in range(len(r)):
                j[i, POSE_SIZE * k + c] = (w.others[i] - r[i]) / _DIFFERENCE
    for p in range(len(w.slope)):
        total = 0.0
        for i in range(len(r)):
            total -= j[i, p] * r[i]
        w.slope[p] = total
        for q in range(p + 1):
            total = 0.0
            for i in range(len(r)):
                total += j[i, p] * j[i, q]
            w.normal[p, q] = total


@kernel
def _step(w: Workspace, epms: Floats, damping: float, limits: Floats) -> bool:
    """Write the EPMs (N, 6) after a damped step into ``w.trial``, within the limits; return whether there is one."""
    u = len(w.slope)
    w.factor[:], w.step[:] = w.normal, w.slope
    for p in range(u):
        w.factor[p, p] += damping * (_PER_RADIUS if p % POSE_SIZE == 2 else 1.0)
    for k in range(len(epms)):
        x, y, z, at = epms[k, 0], epms[k, 1], epms[k, 2], POSE_SIZE * k + 2
        radius, out = math.sqrt(x * x + y * y + z * z), w.slope[at] > 0.0
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
    s: Steering, w: Workspace, state: Floats, ahead: Floats, care: float, limits: Floats, iterations: int, epms: Floats
) -> tuple[float, float, float]:
    """Improve the EPMs (N, 6) in place; return their cost, and of it the squared miss and the growth as it counts."""
    damping, cost = _DAMPING, _weigh(s, w, state, ahead, care, epms, w.residuals)
    for _ in range(iterations):
        _differentiate(s, w, state, ahead, care, epms)
        new = math.inf
        for _ in range(_TRIALS):
            if _step(w, epms, damping, limits):
                new = _weigh(s, w, state, ahead, care, w.trial, w.others)
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
    return cost, miss, w.residuals[COORDINATES]


@kernel
def _miss_more(
    s: Steering, w: Workspace, state: Floats, ahead: Floats, epms: Floats, aim: Floats
) -> tuple[float, float]:
    """Write an aim (6,) beside what is wanted by as much as the motion itself differs from its linear form.

    Returns this difference, squared, and the miss of the motion itself, squared.
    """
    model = w.model
    _exert(s, w, state, epms)
    foresee(s, w, state[COORDINATES:])
    load_state(model, state)
    for _ in range(s.substeps):
        go(model)
    read_state(model, w.landed)
    more, miss = 0.0, 0.0
    for i in range(COORDINATES):
        turns, unit = i % 3 == 2, _HEADING_RAD if i % 3 == 2 else _POSITION_M
        way = w.landed[i] - state[i]
        way = wrap(way) if turns else way
        beside = way - w.moved[i]
        aim[i] = ahead[i] - beside
        more += (beside / unit) ** 2
        miss += ((way - ahead[i]) / unit) ** 2
    return more, miss


@kernel
def _start(
    s: Steering, w: Workspace, turn: int, sine: float, cosine: float, limits: Floats, present: Floats, epms: Floats
) -> None:
    """Write the EPMs (N, 6) of another start: in turns beside the present ones, and some in the robots' frame."""
    which = turn // 2
    beside = turn % 2 == 1
    for k in range(len(epms)):
        if beside:
            epms[k] = present[k]
            local_basis(epms[k], w.bases[k])
            shift(epms[k], w.bases[k], s.nudges[which, k], limits[0], limits[1])
        else:
            for a in (0, 3):
                x, y = s.starts[which, k, a], s.starts[which, k, a + 1]
                epms[k, a], epms[k, a + 1] = cosine * x - sine * y, sine * x + cosine * y
                epms[k, a + 2] = s.starts[which, k, a + 2]
    project_within(epms, limits)


@kernel
def steer(
    s: Steering, w: Workspace, state: Floats, ahead: Floats, heading: float, limits: Floats, epms: Floats
) -> float:
    """Change EPMs (N, 6) so that robots come as far as wanted in the coming hold; return the squared miss.

    The robots are those put into the model by ``locate``.

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
    best, other = epms.copy(), np.empty_like(epms)
    cost, miss, growth = _descend(s, w, state, ahead, 1.0, limits, ITERATIONS, best)
    if not cost < math.inf:
        return cost
    sine, cosine = sincos(heading)
    for turn in range(2 * len(s.starts)):
        if miss <= MET and (growth <= _CALM or turn >= _CALMER):
            break
        _start(s, w, turn, sine, cosine, limits, epms, other)
        new_cost, new_miss, new_growth = _descend(s, w, state, ahead, 1.0, limits, FIRST_ITERATIONS, other)
        if new_cost < cost:
            best[:] = other
            cost, miss, growth = new_cost, new_miss, new_growth
    aim = np.empty(COORDINATES)
    for _ in range(_CORRECTIONS):
        if not _miss_more(s, w, state, ahead, best, aim)[0] + miss > _EXACT:
            break
        _, miss, _ = _descend(s, w, state, aim, _POLISH, limits, _CORRECTING, best)
    epms[:] = best
    return _miss_more(s, w, state, ahead, best, aim)[1]
