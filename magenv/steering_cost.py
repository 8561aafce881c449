"""What steering believes of the plant, and what EPM poses cost by the linear motion of a hold; see ``steering``."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.angles import sincos
from magenv.calm_holds import CalmHolds
from magenv.forecast import STATE, Course, Goal
from magenv.kernels import kernel
from magenv.linear_hold import ALONE, BESIDE, FORCE, GROWN, HOLD_SIZE, MOVED, STIFFNESS, LinearHold, foresee, growth
from magenv.local import local_basis, shift
from magenv.magnets import robots_wrench
from magenv.params import Plant, System, require
from magenv.poses import EPM_SIZE, HOME_RADIUS_M, POSE_SIZE
from magenv.sensitivity import COORDINATES, Model, place
from magenv.stiffness import add_epm, planar_kernel, write_mutual

Floats = NDArray[np.float64]

_POSITION_M, _HEADING_RAD = 1e-4, 3e-3
"""Misses that count one."""
GROWTH = 0.5
"""Growth of errors that counts one: so many times e in a hold."""
LINEAR = 3.0
"""Growth, so many times e, up to which descents find their way."""
_FIELD_T, _FIELD_SPREAD_T = 0.010, 0.020
"""Field along a heading, and by how much another one counts one."""
_RADIUS_SPREAD_M = 0.16
"""By how much another radius than that at home counts one."""
_ROWS = COORDINATES + 3
"""Residuals apart from those of the radii."""
_DIFFERENCE = 1e-6
"""Over which slopes are taken."""


class Steering(NamedTuple):
    """What steering believes of the plant, and where else it starts from."""

    hold: LinearHold
    model: Model
    """Nominal magnets, stepped as the plant is; kernels work in copies of it."""
    substeps: int
    """Of the model in a hold."""
    calm: CalmHolds

    @classmethod
    def of(cls, system: System, plant: Plant, period_s: float, calm: CalmHolds | None = None) -> Steering:
        """Return the steering on a nominal plant, with holds of ``period_s`` (s); ``calm`` is by default the table.

        Raises
        ------
        ValueError
            If there are more EPMs than have room beside each other in ``linear_hold``.
        """
        most = len(BESIDE) // POSE_SIZE
        require(system.n_epm <= most, "n_epm", f"at most {most} to steer by", system.n_epm)
        substeps = plant.substeps(period_s)
        model = Model.of(system, plant, period_s / substeps)
        calm = CalmHolds.load(system.n_epm) if calm is None else calm
        return cls(LinearHold.of(plant.body, period_s), model, substeps, calm)


class Workspace(NamedTuple):
    """Room to compute in, for one thread."""

    model: Model
    positions: Floats
    """(2, 3) of the robots, in m and A m^2; so are the moments."""
    moments: Floats
    ahead: Floats
    """(6,) how far the robots should come in the hold, m and rad."""
    goal: Goal
    """Where they should be at the end of what is looked at."""
    course: Course
    """EPMs that stand still."""
    stiffness: Floats
    """(6, 6) of the wrench on the robots, N and N m per m and rad."""
    first: Floats
    """(N, 6, 6) of what acts before an EPM in the order in which all are summed up: robots, and EPMs before it."""
    parts: Floats
    """(N, 6, 6) of each EPM alone."""
    hold: Floats
    """(h,) lane of a hold by its linear motion."""
    holds: Floats
    """(16 h,) lanes of holds under EPMs moved a little."""
    landed: Floats
    """(12,) state by the motion itself."""
    trial: Floats
    """(N, 6) EPMs."""
    trials: Floats
    """(5 N, N, 6)"""
    bases: Floats
    """(N, 6, 5)"""
    residuals: Floats
    """(r,) by the linear motion."""
    others: Floats
    jacobian: Floats
    """(r, 5 N)"""
    misses: Floats
    """(12,) by the motion itself, of rates zero."""
    slopes: Floats
    """(12, 5 N)"""
    sensitivity: Floats
    """(12, 5 N) of the state."""
    normal: Floats
    """(5 N, 5 N)"""
    factor: Floats
    downhill: Floats
    """(5 N,)"""
    step: Floats


@kernel
def workspace(s: Steering) -> Workspace:
    """Return room of one's own."""
    n, m = s.calm.epms.shape[1], s.model
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
    weights = np.zeros(STATE)
    for i in range(c):
        weights[i] = 1.0 / (_HEADING_RAD if i % 3 == 2 else _POSITION_M)
    course = Course(
        np.zeros(s.substeps, np.int64), np.zeros((1, n, EPM_SIZE)), np.zeros((1, 2, n, EPM_SIZE, POSE_SIZE)), False
    )
    return Workspace(
        model,
        np.zeros((2, 3)),
        np.zeros((2, 3)),
        np.empty(c),
        Goal(np.full(1, s.substeps), np.zeros((1, 1, STATE)), weights, np.zeros((1, n, EPM_SIZE)), 0.0, 0.0),
        course,
        np.empty((c, c)),
        np.empty((n, c, c)),
        np.empty((n, c, c)),
        np.zeros(HOLD_SIZE * len(ALONE)),
        np.zeros(HOLD_SIZE * len(BESIDE)),
        np.empty(STATE),
        np.empty((n, EPM_SIZE)),
        np.empty((u, n, EPM_SIZE)),
        np.zeros((n, EPM_SIZE, POSE_SIZE)),
        np.empty(rows),
        np.empty(rows),
        np.empty((rows, u)),
        np.empty(STATE),
        np.empty((STATE, u)),
        np.empty((STATE, u)),
        np.empty((u, u)),
        np.empty((u, u)),
        np.empty(u),
        np.empty(u),
    )


@kernel
def locate(w: Workspace, state: Floats, ahead: Floats) -> None:
    """Put the robots of ``state`` (12,) into the room, and that they should come as far as ``ahead`` (6,)."""
    n = len(w.model.epm_moment)
    w.ahead[:] = ahead
    for robot in range(2):
        sine, cosine = sincos(state[3 * robot + 2])
        moment = w.model.nominal[n + robot]
        w.positions[robot, 0], w.positions[robot, 1] = state[3 * robot], state[3 * robot + 1]
        w.moments[robot, 0], w.moments[robot, 1] = moment * cosine, moment * sine


@kernel
def look(s: Steering, w: Workspace, state: Floats, grown: float) -> int:
    """Let the goal be where robots should be once errors that grow by ``grown`` in a hold have grown by ``LINEAR``.

    At the latest at the hold's end. Returns after how many substeps of the linear motion that is.
    """
    share = LINEAR / grown if grown > LINEAR else 1.0
    substeps = max(1, round(share * s.hold.substeps))
    share = substeps / s.hold.substeps
    w.goal.marks[0] = max(1, round(share * s.substeps))
    for i in range(COORDINATES):
        w.goal.references[0, 0, i] = state[i] + share * w.ahead[i]
    return substeps


@kernel
def _put(w: Workspace, state: Floats, epms: Floats, lanes: Floats, v: int) -> None:
    """Write the wrench of EPMs (N, 6) on the robots, and its stiffness, which is known, into lane ``v``."""
    model, width = w.model, len(lanes) // HOLD_SIZE
    place(model, epms)
    force = robots_wrench(model.lane, 0, len(epms), None, state[0], state[1], state[2], state[3], state[4], state[5])
    for i in range(COORDINATES):
        lanes[width * (FORCE + i) + v] = force[i]
        for j in range(COORDINATES):
            lanes[width * (STIFFNESS + COORDINATES * i + j) + v] = w.stiffness[i, j]


@kernel
def _judge(w: Workspace, state: Floats, epms: Floats, lanes: Floats, v: int, out: Floats) -> float:
    """Write the residuals (r,) of EPMs (N, 6) whose hold is foreseen in lane ``v``; return their squared sum."""
    model, n, width = w.model, len(epms), len(lanes) // HOLD_SIZE
    for i in range(COORDINATES):
        out[i] = w.goal.weights[i] * (state[i] + lanes[width * (MOVED + i) + v] - w.goal.references[0, 0, i])
    out[COORDINATES] = max(lanes[width * GROWN + v], 0.0) / GROWTH
    for robot in range(2):
        turn = 3 * robot + 2
        field = -lanes[width * (STIFFNESS + (COORDINATES + 1) * turn) + v] / model.nominal[n + robot]
        out[COORDINATES + 1 + robot] = (field - _FIELD_T) / _FIELD_SPREAD_T
    for k in range(n):
        x, y, z = epms[k, 0], epms[k, 1], epms[k, 2]
        out[_ROWS + k] = (math.sqrt(x * x + y * y + z * z) - HOME_RADIUS_M) / _RADIUS_SPREAD_M
    cost = 0.0
    for value in out:
        cost += value * value
    return cost


@kernel
def weigh(s: Steering, w: Workspace, state: Floats, substeps: int, epms: Floats, out: Floats) -> float:
    """Write the residuals (r,) of EPMs (N, 6) by the linear motion; return their squared sum."""
    planar_kernel(w.positions, w.moments, epms, w.model.epm_moment, False, w.stiffness, w.model.gradients)
    _put(w, state, epms, w.hold, 0)
    foresee(s.hold, substeps, state[COORDINATES:], w.hold, ALONE)
    growth(s.hold, w.hold, ALONE)
    return _judge(w, state, epms, w.hold, 0, out)


@kernel
def normal_equations(w: Workspace, residuals: Floats, slopes: Floats) -> None:
    """Write those of residuals (r,) and their slopes (r, 5 N)."""
    w.downhill[:] = 0.0
    w.normal[:] = 0.0
    for i in range(len(residuals)):
        for p in range(len(w.downhill)):
            w.downhill[p] -= slopes[i, p] * residuals[i]
            for q in range(p + 1):  # innermost: no sum, so that it is vectorised
                w.normal[p, q] += slopes[i, p] * slopes[i, q]


@kernel
def _stiffen(w: Workspace, epms: Floats, k: int) -> None:
    """Write the stiffness of EPMs (N, 6) of which ``k`` alone is not where those are whose ``parts`` are known."""
    for i in range(COORDINATES):
        for j in range(COORDINATES):
            w.stiffness[i, j] = w.first[k, i, j]
    add_epm(w.positions, w.moments, epms, w.model.epm_moment, k, False, w.stiffness, w.model.gradients)
    for other in range(k + 1, len(epms)):
        for i in range(COORDINATES):
            for j in range(COORDINATES):
                w.stiffness[i, j] += w.parts[other, i, j]


@kernel
def differentiate_cost(s: Steering, w: Workspace, state: Floats, substeps: int, epms: Floats) -> None:
    """Write the slopes of the residuals by the EPMs' local coordinates, and the normal equations."""
    step = np.zeros(POSE_SIZE)
    write_mutual(w.positions, w.moments, w.first[0])
    for k in range(len(epms)):
        w.parts[k] = 0.0
        add_epm(w.positions, w.moments, epms, w.model.epm_moment, k, False, w.parts[k], w.model.gradients)
        if k + 1 < len(epms):
            for i in range(COORDINATES):
                for j in range(COORDINATES):
                    w.first[k + 1, i, j] = w.first[k, i, j] + w.parts[k, i, j]
    for k in range(len(epms)):
        local_basis(epms[k], w.bases[k])
        for c in range(POSE_SIZE):
            at = POSE_SIZE * k + c
            for other in range(len(epms)):
                for a in range(EPM_SIZE):
                    w.trials[at, other, a] = epms[other, a]
            step[:] = 0.0
            step[c] = _DIFFERENCE
            shift(w.trials[at, k], w.bases[k], step, 0.0, math.inf)
            _stiffen(w, w.trials[at], k)
            _put(w, state, w.trials[at], w.holds, at)
    foresee(s.hold, substeps, state[COORDINATES:], w.holds, BESIDE)
    growth(s.hold, w.holds, BESIDE)
    for at in range(len(w.trials)):
        _judge(w, state, w.trials[at], w.holds, at, w.others)
        for i in range(len(w.residuals)):
            w.jacobian[i, at] = (w.others[i] - w.residuals[i]) / _DIFFERENCE
    normal_equations(w, w.residuals, w.jacobian)
