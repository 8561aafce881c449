"""One step of the interior-point method of ``magenv.solver``: model, direction, trial, correction, multipliers."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.cholesky import factorise, gram, solve
from magenv.descent import Model, Problem, State
from magenv.kernels import law
from magenv.poses import POSE_SIZE
from magenv.spheres import (
    add_curvature,
    chain,
    gap_gradients,
    gap_values,
    move,
    points_to_epms,
    subtract_gap_curvature,
    tangents_at,
)
from magenv.wrench import WRENCH_SIZE, add_epms, wrench_curvature, wrench_gradients

Floats = NDArray[np.float64]

_BOUNDARY = 0.005
"""Share of the way to the boundary that a step always leaves; a full step aims at twice as much."""
_LARGEST_TURN = 2.0
"""Step of a direction that turns it by a right angle."""
_CORRECTION = 0.6
"""Largest corrected part of a step, squared, in the damping's norm."""
_FLAT = 1e-9
"""Least damping diagonal."""
_DUAL_BAND = 1e3
"""Multipliers stay within this factor of mu / s, or a bad step haunts the next ones."""


@law
def evaluate(problem: Problem, state: State, work: Floats) -> float:
    """Fill in everything but the gaps' slacks from the points; return f, half the squared scaled error."""
    points, epms, wrench, error, slacks = state.points, state.epms, state.wrench, state.error, state.slacks
    target, mutual, scale = problem.target, problem.mutual, problem.scale
    n = len(points)
    points_to_epms(points, epms)
    gap_values(epms, problem.gap, state.gaps)
    for k in range(n):
        slacks[k], slacks[n + k] = points[k, 3] - problem.r_min, problem.r_max - points[k, 3]
    for i in range(WRENCH_SIZE):
        wrench[i] = mutual[i]
    add_epms(problem.positions, problem.moments, problem.frames, epms, problem.epm_moment, work, wrench)
    cost = 0.0
    for i in range(WRENCH_SIZE):
        error[i] = scale[i] * (wrench[i] - target[i])
        cost += 0.5 * error[i] * error[i]
    return cost


@law
def build(problem: Problem, now: State, cost: float, second: bool, model: Model) -> None:
    """Fill in gradient, Hessian, Gauss-Newton diagonal and the gaps' slopes; ``second``: with second derivatives."""
    hessian, jacobian, error = model.hessian, model.jacobian, now.error
    wrench_gradients(
        problem.positions,
        problem.moments,
        problem.frames,
        now.epms,
        problem.epm_moment,
        model.work,
        model.gradients,
    )
    tangents_at(now.points, model.tangents)
    chain(model.gradients, model.tangents, problem.scale, jacobian)
    gap_gradients(now.epms, model.tangents, problem.gap, model.slopes)
    gram(jacobian, hessian)
    for i in range(len(hessian)):
        model.diagonal[i] = hessian[i, i] + _FLAT * (1.0 + cost)
        total = 0.0
        for k in range(WRENCH_SIZE):
            total += jacobian[k, i] * error[k]
        model.gradient[i] = total
    if second:
        weights = model.weights
        for i in range(WRENCH_SIZE):
            weights[i] = problem.scale[i] * error[i]
        wrench_curvature(
            problem.positions,
            problem.moments,
            problem.frames,
            now.epms,
            problem.epm_moment,
            weights,
            model.work,
            model.curvature,
        )
        add_curvature(now.points, model.tangents, model.gradients, weights, model.curvature, model.slope, hessian)
        duals = model.duals[2 * len(now.points) :]
        subtract_gap_curvature(now.points, now.epms, model.tangents, problem.gap, duals, model.slope, hessian)


@law
def add_barrier(now: State, barrier: float, model: Model) -> None:
    """Add the constraints' terms to Hessian and right-hand side."""
    hessian, right, diagonal, gradient = model.hessian, model.right, model.diagonal, model.gradient
    slacks, gaps, duals, slopes = now.slacks, now.gaps, model.duals, model.slopes
    n, size = len(now.points), len(right)
    for i in range(size):
        right[i] = -gradient[i]
    for k in range(2 * n):
        at = POSE_SIZE * (k % n) + 2
        stiffness = duals[k] / slacks[k]
        hessian[at, at] += stiffness
        diagonal[at] += stiffness
        right[at] += (barrier if k < n else -barrier) / slacks[k]
    for k in range(len(gaps)):
        slack = slacks[2 * n + k]
        stiffness = duals[2 * n + k] / slack
        pull = barrier / slack - stiffness * (gaps[k] - slack)
        for i in range(size):
            right[i] += pull * slopes[k, i]
            for j in range(size):
                hessian[i, j] += stiffness * slopes[k, i] * slopes[k, j]


@law
def direction(now: State, barrier: float, damping: float, model: Model) -> tuple[float, float]:
    """Solve for the step; return the fall of f and barrier along it and its greatest length, 0 without a factor."""
    n, step, slacks, gaps, slopes = len(now.points), model.step, now.slacks, now.gaps, model.slopes
    hessian, factor, right, diagonal = model.hessian, model.factor, model.right, model.diagonal
    gradient, changes, size = model.gradient, model.changes, len(model.step)
    for i in range(size):
        step[i] = right[i]
        for j in range(i + 1):
            factor[i, j] = hessian[i, j]
        factor[i, i] += damping * diagonal[i]
    if not factorise(factor):
        return 0.0, 0.0
    solve(factor, step)
    fall, length = 0.0, 1.0
    for i in range(size):
        fall -= gradient[i] * step[i]
    for k in range(len(slacks)):
        if k < 2 * n:
            at = POSE_SIZE * (k % n) + 2
            change = step[at] if k < n else -step[at]
        else:
            change = gaps[k - 2 * n] - slacks[k]
            for i in range(size):
                change += slopes[k - 2 * n, i] * step[i]
        changes[k] = change
        fall += barrier * change / slacks[k]
        if -change * length > (1.0 - 2.0 * _BOUNDARY) * slacks[k]:
            length = (1.0 - 2.0 * _BOUNDARY) * slacks[k] / -change
    for k in range(n):
        for at in (POSE_SIZE * k, POSE_SIZE * k + 3):
            turn = math.sqrt(step[at] * step[at] + step[at + 1] * step[at + 1])
            if turn * length > _LARGEST_TURN:
                length = _LARGEST_TURN / turn
    return fall, length


@law
def try_step(
    problem: Problem, now: State, step: Floats, barrier: float, penalty: float, model: Model, out: State
) -> tuple[float, float]:
    """Write the state after a step (5 N); return its merit and f, infinite where a radius leaves its bounds."""
    points, slacks, gaps, slopes, new, new_slacks = (
        out.points,
        now.slacks,
        now.gaps,
        model.slopes,
        out.gaps,
        out.slacks,
    )
    n = len(points)
    move(now.points, model.tangents, step, points)
    for k in range(n):
        low, high = points[k, 3] - problem.r_min, problem.r_max - points[k, 3]
        if not (low > _BOUNDARY * slacks[k] and high > _BOUNDARY * slacks[n + k]):
            return math.inf, math.inf
    cost = evaluate(problem, out, model.work)
    merit = cost
    for k in range(len(gaps)):
        least = _BOUNDARY * slacks[2 * n + k]
        if new[k] > least:
            new_slacks[2 * n + k] = new[k]
        else:
            linear = gaps[k]
            for i in range(len(step)):
                linear += slopes[k, i] * step[i]
            new_slacks[2 * n + k] = max(linear, least)
            merit += penalty * (new_slacks[2 * n + k] - new[k])
    return merit + barrier * barrier_value(new_slacks), cost


@law
def barrier_value(slacks: Floats) -> float:
    """Return the sum of -log(slack), by as few logarithms as the range of numbers allows."""
    total, product = 0.0, 1.0
    for slack in slacks:
        product *= slack
        if product < 1e-150:
            total -= math.log(product)
            product = 1.0
    return total - math.log(product)


@law
def correct(now: State, tried: State, step: Floats, model: Model, out: Floats) -> bool:
    """Write the step (5 N) corrected for the curvature that the tried one met; return whether it is a small change."""
    n, size, jacobian, slopes, diagonal = len(now.points), len(step), model.jacobian, model.slopes, model.diagonal
    met, error = tried.error, now.error
    out[:] = 0.0
    for k in range(WRENCH_SIZE):
        bend = met[k] - error[k]
        for i in range(size):
            bend -= jacobian[k, i] * step[i]
        for i in range(size):
            out[i] -= jacobian[k, i] * bend
    for k in range(len(now.gaps)):
        bend = tried.gaps[k] - now.gaps[k]
        for i in range(size):
            bend -= slopes[k, i] * step[i]
        bend *= model.duals[2 * n + k] / now.slacks[2 * n + k]
        for i in range(size):
            out[i] -= slopes[k, i] * bend
    solve(model.factor, out)
    whole, change = 0.0, 0.0
    for i in range(size):
        whole += diagonal[i] * step[i] * step[i]
        change += diagonal[i] * out[i] * out[i]
        out[i] += step[i]
    return change < _CORRECTION * whole


@law
def update_duals(now: State, after: State, barrier: float, model: Model) -> None:
    """Move the multipliers by their own full step, kept positive and within a band of mu / s."""
    for k in range(len(model.duals)):
        dual, slack, centre = model.duals[k], now.slacks[k], barrier / after.slacks[k]
        dual = max((barrier - dual * model.changes[k]) / slack, _BOUNDARY * dual)
        model.duals[k] = min(max(dual, centre / _DUAL_BAND), centre * _DUAL_BAND)
