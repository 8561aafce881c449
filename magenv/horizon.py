"""Planning: the EPM poses whose predicted motion of the robots comes nearest to a reference, over several commands.

The cost is that of weighted errors of pose and rates at marked substeps of each command's time, of the commands' ways
from a home, of EPMs near each other, and of what is not known of the state at the beginning, grown by the first
command. It is minimised by the Gauss-Newton form of differential dynamic programming: derivatives of each command's
time, a Riccati recursion backwards, and forwards the motion itself under the feedback that the recursion gives, without
which errors grow through unstable holds beyond all linearity. Radii are kept within their bounds as an active set, the
least gap by projection.

References
----------
Li and Todorov, "Iterative linear quadratic regulator design for nonlinear biological movement systems", ICINCO 2004;
Tassa, Mansard and Todorov, "Control-limited differential dynamic programming", ICRA 2014.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.arithmetic import dot3
from magenv.cholesky import add_product, add_transposed_product, factorise, solve
from magenv.forecast import STATE, Course, Goal, roll
from magenv.kernels import kernel
from magenv.local import local_basis, seen_from, shift
from magenv.manoeuvre import Arms, allow, move
from magenv.poses import EPM_SIZE, POSE_SIZE
from magenv.postures import away, crowd
from magenv.risk import lean_on, risk
from magenv.sensitivity import Model

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_STEP_ANGLE, _STEP_RADIUS = 0.5, 0.05
"""Largest change of an angle (rad) and of a radius (m) in an iteration."""
_TRIALS = 10
_SLOW = 1e-2
"""An iteration that takes off less than this share of the cost is the last."""
_DAMPING, _LEAST_DAMPING = 1e-3, 1e-9


class Scratch(NamedTuple):
    """What a plan is computed in; y = (command before, state), z = (y, command)."""

    states: Floats
    """(H + 1, 12) at the beginning of each command's time."""
    bases: Floats
    """(H + 1, N, 6, 5) of the command before and of each."""
    residuals: Floats
    """(H, r): errors, those of the state's doubt, the command's way from home, and EPMs near each other."""
    jacobians: Floats
    """(H, r, z)"""
    by: Floats
    """(H, 12, z) derivatives of the state at the end."""
    gains: Floats
    """(H, u, y + 1): the feedback, then the step itself."""
    trial: Floats
    """(H, N, 6)"""
    trial_states: Floats
    """(H + 1, 12)"""
    lean: Floats
    """(12,) what is leant on, see ``risk``."""
    scrap: Floats
    """(r, u) for derivatives that nobody reads."""

    @classmethod
    def of(cls, stages: int, n_epm: int, marks: int) -> Scratch:
        """Return room for a plan of ``stages`` commands."""
        u, rows = POSE_SIZE * n_epm, STATE * (marks + 1) + EPM_SIZE * n_epm + n_epm * (n_epm - 1) // 2
        y = STATE + u
        return cls(
            np.zeros((stages + 1, STATE)),
            np.zeros((stages + 1, n_epm, EPM_SIZE, POSE_SIZE)),
            np.zeros((stages, rows)),
            np.zeros((stages, rows, y + u)),
            np.zeros((stages, STATE, y + u)),
            np.zeros((stages, u, y + 1)),
            np.zeros((stages, n_epm, EPM_SIZE)),
            np.zeros((stages + 1, STATE)),
            np.zeros(STATE),
            np.zeros((rows, u)),
        )


@kernel
def _linearise(
    model: Model,
    pushing: Floats,
    goal: Goal,
    arms: Arms,
    motion: Course,
    before: Floats,
    doubt: Floats,
    commands: Floats,
    s: Scratch,
) -> tuple[float, float]:
    """Write states, residuals and derivatives of all commands' times; return the cost, and the scale of ``s.lean``."""
    cost, scale, u = 0.0, 0.0, POSE_SIZE * len(before)
    first = 0 if motion.carried else u  # column of the first derivatives of the motion
    for k in range(len(before)):
        local_basis(before[k], s.bases[0, k])
    for stage in range(len(commands)):
        old = before if stage == 0 else commands[stage - 1]
        for k in range(len(before)):
            local_basis(commands[stage, k], s.bases[stage + 1, k])
        move(arms, old, commands[stage], s.bases[stage : stage + 2], motion)
        s.states[stage + 1] = s.states[stage]
        sensitivity = np.zeros((STATE, STATE + 2 * u - first))
        for i in range(STATE):
            sensitivity[i, u - first + i] = 1.0
        residuals, jacobian = s.residuals[stage], s.jacobians[stage]
        cost += roll(model, s.states[stage + 1], pushing, motion, goal, stage, sensitivity, residuals, jacobian)
        s.by[stage, :, first:] = sensitivity
        at = STATE * len(goal.marks)
        if stage == 0:
            scale = lean_on(s.by[0, :, u : u + STATE], goal.weights, doubt, s.lean)
            residuals[at : at + STATE], jacobian[at : at + STATE] = 0.0, 0.0
            if scale > 0.0:
                seen = np.zeros((STATE, u))
                cost += risk(model, pushing, motion, goal, stage, s.states[0], s.lean, scale, seen, residuals, jacobian)
        at += STATE
        cost += away(commands[stage], goal.home[stage], s.bases[stage + 1], goal.pull, residuals, jacobian, at)
        at += EPM_SIZE * len(before)
        cost += crowd(commands[stage], arms.limits.gap, s.bases[stage + 1], goal.room, residuals, jacobian, at)
    return cost, scale


@kernel
def _held(command: Floats, slope: Floats, r_min: float, r_max: float, held: Integers) -> None:
    """Mark the radii that stand at a bound and would leave it downhill."""
    for k in range(len(command)):
        x, y, z = command[k, 0], command[k, 1], command[k, 2]
        radius, falls = math.sqrt(dot3(x, y, z, x, y, z)), slope[POSE_SIZE * k + 2]
        inner, outer = radius <= r_min + 1e-9, radius >= r_max - 1e-9
        held[POSE_SIZE * k + 2] = 1 if (inner and falls > 0.0) or (outer and falls < 0.0) else 0


@kernel
def _backward(commands: Floats, arms: Arms, damping: float, s: Scratch) -> bool:
    """Write the gains of all commands, last first; return whether there are any."""
    u = s.gains.shape[1]
    y = STATE + u
    value, slope = np.zeros((y, y)), np.zeros((y, 1))  # the cost to go: half its second derivative, half its first
    onward, held = np.zeros((y, y + u)), np.zeros(u, np.int64)
    factor, column = np.empty((u, u)), np.empty(u)
    quu, quy, gu = np.empty((u, u)), np.empty((u, y)), np.empty((u, 1))
    feedback, step = np.empty((u, y)), np.empty((u, 1))
    for i in range(u):
        onward[i, y + i] = 1.0  # what is commanded now is the command before of the next
    for stage in range(len(commands) - 1, -1, -1):
        j, r = s.jacobians[stage], s.residuals[stage].reshape(-1, 1)
        onward[u:] = s.by[stage]
        q, g, ahead = np.zeros((y + u, y + u)), np.zeros((y + u, 1)), np.zeros((y, y + u))
        add_transposed_product(j, j, q)
        add_product(value, onward, ahead)
        add_transposed_product(onward, ahead, q)
        add_transposed_product(j, r, g)
        add_transposed_product(onward, slope, g)
        _held(commands[stage], g[y:, 0], arms.limits.r_min, arms.limits.r_max, held)
        quu[:], quy[:], gu[:] = q[y:, y:], q[y:, :y], g[y:]
        for i in range(u):
            for k in range(i + 1):
                factor[i, k] = 0.0 if held[i] or held[k] else quu[i, k]
            factor[i, i] = 1.0 if held[i] else factor[i, i] + damping * (factor[i, i] + 1e-3)
        if not factorise(factor):
            return False
        for c in range(y + 1):
            for i in range(u):
                column[i] = 0.0 if held[i] else -(gu[i, 0] if c == y else quy[i, c])
            solve(factor, column)
            s.gains[stage, :, c] = column
        feedback[:], step[:, 0] = s.gains[stage, :, :y], s.gains[stage, :, y]
        value[:], slope[:] = q[:y, :y], g[:y]  # and quadratic in the feedback and the step, which are damped
        add_transposed_product(quy, feedback, value)
        add_transposed_product(quy, step, slope)
        add_product(quu, feedback, quy)
        add_product(quu, step, gu)
        add_transposed_product(feedback, quy, value)
        add_transposed_product(feedback, gu, slope)
        for i in range(y):
            for k in range(i):
                value[i, k] = value[k, i] = 0.5 * (value[i, k] + value[k, i])
    return True


@kernel
def _forward(
    model: Model,
    pushing: Floats,
    goal: Goal,
    arms: Arms,
    motion: Course,
    before: Floats,
    commands: Floats,
    least: float,
    scale: float,
    s: Scratch,
) -> float:
    """Write commands changed by the gains, and the states they lead to; return their cost, infinite above ``least``."""
    n_epm, u = commands.shape[1], s.gains.shape[1]
    deviation, step = np.zeros(STATE + u), np.empty(u)
    residuals, none, cost = np.empty(s.residuals.shape[1]), np.empty((STATE, 0)), 0.0
    s.trial_states[0] = s.states[0]
    for stage in range(len(commands)):
        trial, old = s.trial[stage], before if stage == 0 else s.trial[stage - 1]
        deviation[u:] = s.trial_states[stage] - s.states[stage]
        if stage > 0:
            for k in range(n_epm):
                at = POSE_SIZE * k
                seen_from(old[k], commands[stage - 1, k], s.bases[stage, k], deviation[at : at + POSE_SIZE])
        for i in range(u):
            total = s.gains[stage, i, STATE + u]
            for c in range(STATE + u):
                total += s.gains[stage, i, c] * deviation[c]
            most = _STEP_RADIUS if i % POSE_SIZE == 2 else _STEP_ANGLE
            step[i] = min(max(total, -most), most)
        trial[:] = commands[stage]
        for k in range(n_epm):
            at = POSE_SIZE * k
            shift(trial[k], s.bases[stage + 1, k], step[at : at + POSE_SIZE], arms.limits.r_min, arms.limits.r_max)
        allow(arms, old, trial)
        move(arms, old, trial, s.bases[:0], motion)
        s.trial_states[stage + 1] = s.trial_states[stage]
        cost += roll(
            model, s.trial_states[stage + 1], pushing, motion, goal, stage, none, residuals, s.jacobians[stage]
        )
        if stage == 0 and scale > 0.0:
            cost += risk(
                model, pushing, motion, goal, stage, s.states[0], s.lean, scale, none, residuals, s.jacobians[0]
            )
        cost += away(trial, goal.home[stage], s.bases[stage + 1], goal.pull, residuals, s.scrap, 0)
        cost += crowd(trial, arms.limits.gap, s.bases[stage + 1], goal.room, residuals, s.scrap, 0)
        if not cost < least:
            return math.inf
    return cost


@kernel
def plan(
    model: Model,
    state: Floats,
    pushing: Floats,
    doubt: Floats,
    goal: Goal,
    arms: Arms,
    motion: Course,
    before: Floats,
    enough: float,
    iterations: int,
    scratch: Scratch,
    commands: Floats,
) -> tuple[float, int]:
    """Improve the commands (H, N, 6) in place; return their cost and the iterations taken.

    The first acts from ``state`` (12,), with ``pushing`` (6,) throughout, after the EPMs stood at ``before`` (N, 6).
    ``doubt`` (12, 12) is a root of the state's covariance, in the state's units; zero for none. Ends at a cost of
    ``enough``. Where nothing can be foreseen the cost is infinite, and the commands stay as they are.
    """
    s, damping, cost = scratch, _DAMPING, math.inf
    s.states[0] = state
    for iteration in range(iterations):
        cost, scale = _linearise(model, pushing, goal, arms, motion, before, doubt, commands, s)
        if not cost < math.inf:  # NaN as well: from there nothing can be foreseen
            return math.inf, iteration
        if cost <= enough:
            return cost, iteration
        new = math.inf
        for _ in range(_TRIALS):
            if _backward(commands, arms, damping, s):
                new = _forward(model, pushing, goal, arms, motion, before, commands, cost, scale, s)
                if new < cost:
                    break
            damping = max(damping, _LEAST_DAMPING) * 5.0
        if not new < cost:
            return cost, iteration
        commands[:] = s.trial
        damping *= 0.1
        if new > (1.0 - _SLOW) * cost:
            return new, iteration + 1
        cost = new
    return cost, iterations


@kernel
def land(
    model: Model,
    state: Floats,
    pushing: Floats,
    goal: Goal,
    arms: Arms,
    motion: Course,
    stage: int,
    before: Floats,
    command: Floats,
) -> float:
    """Turn ``state`` (12,) into the one after the time of a command (N, 6); return the cost of the errors in it.

    ``pushing`` (6,) acts throughout, N and N m; the EPMs stood at ``before`` (N, 6). ``stage`` tells which of the
    goal's references count.
    """
    none, residuals, nothing = np.empty((STATE, 0)), np.empty(STATE * len(goal.marks)), np.empty((0, 0))
    move(arms, before, command, np.empty((0, len(command), EPM_SIZE, POSE_SIZE)), motion)
    return roll(model, state, pushing, motion, goal, stage, none, residuals, nothing)
