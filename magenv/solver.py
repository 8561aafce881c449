"""The interior-point descent behind ``magenv.allocation``.

Minimise f(x) = 1/2 |S (U(x) - U_d)|^2 subject to the radii's bounds and c(x) = (|p_i - p_j|^2 - gap^2) / (2 gap) >= 0
for every two EPMs. The bounds get a logarithmic barrier each, the gaps one by a slack s > 0 with c(x) - s = 0, of
weight mu that falls to zero; z are the multipliers. A step x solves the primal-dual system

    (H + sum_k z_k / s_k a_k a_k^T + damping D) x = -grad f + sum_k (mu / s_k - z_k / s_k (c_k - s_k)) a_k

with a = grad c, D the Gauss-Newton diagonal, and H = J^T J first, J^T J + sum_i e_i Hess e_i - sum_k z_k Hess c_k once
the error falls slowly: Gauss-Newton is fast where the target can be met, and crawls or stalls where it cannot. H may
then be indefinite: damping grows until the matrix has a Cholesky factor, which is the inertia that makes x a descent
direction. Steps stay within a share of the way to the boundary and must lower the merit
f - mu sum log s + nu sum |c - s|. One that does not is corrected once for the curvature that it showed, by the same
factor, before it is shortened or damped. Wherever c(x) allows, s = c(x): then the merit is the plain barrier function.

References
----------
Waechter and Biegler, Math. Program. 106 (2006), sections 2 and 3: primal-dual barrier, inertia, second-order
correction. Nocedal and Wright, "Numerical Optimization" (2006), 10.3 and 19.3. Transtrum and Sethna (2012),
arXiv:1201.5885: the correction as geodesic acceleration of Levenberg-Marquardt steps. Fan and Yuan, Computing 74
(2005): damping in proportion to the squared error near a root.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.descent import Model, Problem, State, copy_state, new_model, new_state
from magenv.interior import (
    add_barrier,
    barrier_value,
    build,
    correct,
    direction,
    evaluate,
    try_step,
    update_duals,
)
from magenv.kernels import kernel, typed
from magenv.poses import POSE_SIZE, clip_radius, epm_to_pose, pose_to_epm, project_epms
from magenv.spheres import pose_to_points
from magenv.wrench import N_ROBOTS, WRENCH_SIZE, robot_frames

Floats = NDArray[np.float64]

CONVERGED, STATIONARY, ITERATION_LIMIT = 0, 1, 2

NORM_FLOOR = 1e-6
"""Scaled targets smaller than this count as this large: half a micronewton."""
_MARGIN = 1e-3
"""Starts are moved inside the constraints by this share of their size."""
_LARGEST_PUSH = 1.01
_INSIDE = 1e-12
"""Share by which the solver's own limits are narrower: what it returns is inside the true ones after rounding too."""
_FIRST_DAMPING, _NEAR, _LEAST_DAMPING = 1e-2, 1e-2, 1e-12
"""Where f is below the second, the first is as much smaller: warm starts then converge nearly as Newton's method."""
_DAMPING_FALL, _DAMPING_RISE, _DAMPING_TRIALS = 0.2, 4.0, 14
_BARRIER_SHARE, _BARRIER_FALL, _BARRIER_END = 0.1, 0.2, 1e-8
"""The barrier's largest share of f, the factor by which it falls, its share of f at which a start is at rest."""
_SLOW, _PATIENCE, _IMAGE_PATIENCE = 0.7, typed(6), typed(2)
"""Second derivatives are used once f has fallen to no less than this share in this many steps, one after another: late
from a start, as Gauss-Newton steps keep nearer to it, soon from an image, as the target is probably out of reach."""
_ATTEMPTS = 4
"""With one damping: the step, the corrected step, a half and a quarter of it."""
_DECREASE = 1e-4
"""Armijo's share of the promised fall that a step must reach."""
_ROUNDING = 1e-15
"""Of a merit: what a step may seem to rise by."""
_IMAGE_ROUNDS, _BETTER = 3, 0.999
"""How often the best is replaced by an image of it, and to which share f must fall for it."""


@kernel
def descend(
    problem: Problem, tolerance: float, max_iterations: int, patience: int, now: State, model: Model, tried: State
) -> tuple[float, int, int]:
    """Improve ``now``, whose points are strictly feasible, in place; return f, status, iterations.

    ``model`` and ``tried`` are scratch.
    """
    n, m = len(now.points), len(now.slacks)
    part, better = np.empty(POSE_SIZE * n), np.empty(POSE_SIZE * n)
    cost = evaluate(problem, now, model.work)
    now.slacks[2 * n :] = now.gaps
    barrier = _BARRIER_SHARE * cost / m
    model.duals[:] = barrier / now.slacks
    damping, centred, before, slow = _FIRST_DAMPING * min(1.0, cost / _NEAR), False, math.inf, 0
    for iteration in range(max_iterations):
        feasible = True
        for value in now.gaps:
            feasible = feasible and value > 0.0
        if feasible and 2.0 * cost <= tolerance * tolerance:
            return cost, CONVERGED, iteration
        # The barrier falls once its own problem is about solved: far from the central path, at the curved gap, one
        # can hardly move. And it falls with the error, so that targets are met with fast convergence.
        if feasible and centred:
            if barrier <= _BARRIER_END * cost:
                return cost, STATIONARY, iteration
            barrier *= _BARRIER_FALL
        barrier = min(barrier, max(_BARRIER_SHARE * min(1.0, math.sqrt(cost)), _BARRIER_END) * cost)
        slow = slow + 1 if cost > _SLOW * before else 0
        before = cost
        build(problem, now, cost, slow >= patience, model)
        add_barrier(now, barrier, model)
        largest, short = 0.0, 0.0
        for k in range(len(now.gaps)):
            largest = max(largest, model.duals[2 * n + k])
            short += abs(now.gaps[k] - now.slacks[2 * n + k])
        plain = cost + barrier * barrier_value(now.slacks)
        accepted, length, reached, tried_cost = False, 1.0, math.inf, cost
        for _ in range(_DAMPING_TRIALS):
            fall, length = direction(now, barrier, damping, model)
            penalty = 2.0 * largest
            if short > 0.0:  # great enough that whatever lowers the infeasibility lowers the merit
                penalty = max(penalty, -2.0 * fall / short)
            merit = plain + penalty * short
            fall += penalty * short
            if length > 0.0 and fall > 0.0:
                for attempt in range(_ATTEMPTS):
                    if attempt == 1:
                        if not (reached < math.inf and correct(now, tried, part, model, better)):
                            continue
                        part[:] = better
                    else:
                        if attempt > 1:
                            length *= 0.5
                        for i in range(len(part)):
                            part[i] = length * model.step[i]
                    reached, tried_cost = try_step(problem, now, part, barrier, penalty, model, tried)
                    accepted = reached <= merit - _DECREASE * length * fall + _ROUNDING * abs(merit)
                    if accepted:
                        break
            if accepted:
                break
            damping = max(_DAMPING_RISE * damping, 1e-6)
        if not accepted:  # rounding: nothing lower is to be found with this barrier
            if centred:
                return cost, STATIONARY, iteration
            centred, damping = True, _FIRST_DAMPING
            continue
        decrement = 0.0
        for i in range(len(part)):
            decrement += model.right[i] * model.step[i]
        centred = decrement <= m * barrier
        update_duals(now, tried, barrier, model)
        if length > 0.9:
            damping = max(_DAMPING_FALL * damping, _LEAST_DAMPING)
        copy_state(tried, now)
        cost = tried_cost
    return cost, ITERATION_LIMIT, max_iterations


@kernel
def make_interior(pose: Floats, r_min: float, r_max: float, gap: float) -> None:
    """Move ``pose`` (5 N) strictly inside the constraints, in place.

    Where a push outwards by a per cent will do, as for poses at rest at the gap, it is done: there the projection needs
    thousands of turns.
    """
    n = len(pose) // POSE_SIZE
    epms = np.empty((n, 6))
    inner_min, inner_max = r_min + _MARGIN * (r_max - r_min), r_max - _MARGIN * (r_max - r_min)
    for i in range(n):
        pose_to_epm(pose[POSE_SIZE * i : POSE_SIZE * i + POSE_SIZE], epms[i])
        clip_radius(epms[i], inner_min, inner_max)
    push, farthest = 1.0, 0.0
    for i in range(n):
        farthest = max(farthest, epms[i, 0] ** 2 + epms[i, 1] ** 2 + epms[i, 2] ** 2)
        for j in range(i + 1, n):
            squared = 0.0
            for k in range(3):
                squared += (epms[i, k] - epms[j, k]) ** 2
            push = max(push, gap * (1.0 + _MARGIN) / math.sqrt(squared))
    if push <= _LARGEST_PUSH and push * math.sqrt(farthest) <= inner_max:
        for i in range(n):
            for k in range(3):
                epms[i, k] *= push
    else:
        project_epms(epms, inner_min, inner_max, gap * (1.0 + _MARGIN))
    for i in range(n):
        epm_to_pose(epms[i], pose[POSE_SIZE * i : POSE_SIZE * i + POSE_SIZE])
        # the projection holds to 1e-9 m only: stay strictly inside
        pose[POSE_SIZE * i + 2] = min(max(pose[POSE_SIZE * i + 2], inner_min), inner_max)


@kernel
def _enter(pose: Floats, problem: Problem, points: Floats) -> None:
    """Write the points (N, 7) of a pose vector (5 N), which is moved inside the constraints."""
    make_interior(pose, problem.r_min, problem.r_max, problem.gap)
    pose_to_points(pose, points)


@kernel
def _leave(state: State, pose: Floats) -> None:
    """Write the pose vector (5 N) of a state."""
    for k in range(len(state.epms)):
        epm_to_pose(state.epms[k], pose[POSE_SIZE * k : POSE_SIZE * k + POSE_SIZE])


@kernel
def _run(
    problem: Problem,
    tolerance: float,
    max_iterations: int,
    patience: int,
    pose: Floats,
    state: State,
    model: Model,
    tried: State,
) -> tuple[float, int, int]:
    """Descend from a pose vector (5 N) to a feasible state; return f, status, iterations."""
    _enter(pose, problem, state.points)
    cost, status, count = descend(problem, tolerance, max_iterations, patience, state, model, tried)
    for value in state.gaps:
        if not value > 0.0:  # stopped on its way
            _leave(state, pose)
            _enter(pose, problem, state.points)
            return evaluate(problem, state, model.work), ITERATION_LIMIT, count
    return cost, status, count


@kernel
def _image(which: int, epms: Floats, pose: Floats) -> None:
    """Write the pose vector (5 N) of an image of the EPMs (N, 6); they are numbered from 0 to 3 N + 1.

    Number 0 mirrors all in the horizontal plane, number 1 all at the workspace's centre. The others reverse one EPM's
    centre, its moment or both: at the workspace's centre a dipole's field is even in its place, its gradient odd, and
    both are odd in its moment.
    """
    image = np.empty(6)
    for k in range(len(epms)):
        at_centre = which == 1 or ((which - 2) // 3 == k and (which - 2) % 3 != 1)
        of_moment = which == 1 or ((which - 2) // 3 == k and (which - 2) % 3 != 0)
        for i in range(3):
            image[i] = -epms[k, i] if at_centre or (which == 0 and i == 2) else epms[k, i]
            image[3 + i] = -epms[k, 3 + i] if of_moment or (which == 0 and i == 2) else epms[k, 3 + i]
        epm_to_pose(image, pose[POSE_SIZE * k : POSE_SIZE * k + POSE_SIZE])


@kernel
def relative_scale(target: Floats, weights: Floats, scale: Floats) -> float:
    """Write into ``scale`` (10,) by what errors are multiplied to be relative to the target (10,); return its norm.

    ``weights`` (10,) are one over what each component is measured in, or zero where it does not count.
    """
    squared = 0.0
    for i in range(WRENCH_SIZE):
        squared += (weights[i] * target[i]) ** 2
    norm = max(math.sqrt(squared), NORM_FLOOR)
    for i in range(WRENCH_SIZE):
        scale[i] = weights[i] / norm
    return norm


@kernel
def best_of(
    target: Floats,
    positions: Floats,
    moments: Floats,
    epm_moment: float,
    limits: Floats,
    scale: Floats,
    tolerance: float,
    max_iterations: int,
    stop_early: bool,
    poses: Floats,
    best_pose: Floats,
    best_wrench: Floats,
) -> tuple[float, int, int, int]:
    """Descend from every row of ``poses`` (M, 5 N); return the best half square, its status, iterations, starts run.

    ``limits`` holds r_min, r_max and the gap. The starts are moved inside them first. Where none meets the target,
    the best is a local minimum, and often an image of it lies in the basin of a better one: these are tried too.
    """
    n = poses.shape[1] // POSE_SIZE
    frames, mutual = np.empty((N_ROBOTS, 3, 3)), np.empty(WRENCH_SIZE)
    robot_frames(positions, moments, frames, mutual)
    r_min, r_max, gap = limits[0] * (1.0 + _INSIDE), limits[1] * (1.0 - _INSIDE), limits[2] * (1.0 + _INSIDE)
    problem = Problem(target, positions, moments, frames, mutual, epm_moment, scale, r_min, r_max, gap)
    state, best, tried, model = new_state(n), new_state(n), new_state(n), new_model(n)
    best_cost, best_status, iterations, starts = math.inf, ITERATION_LIMIT, 0, 0
    for start in poses:
        best_pose[:] = start
        cost, status, count = _run(problem, tolerance, max_iterations, _PATIENCE, best_pose, state, model, tried)
        iterations += count
        starts += 1
        if cost < best_cost:
            best_cost, best_status = cost, status
            copy_state(state, best)
        if stop_early and status == CONVERGED:
            break
    epms = np.empty((n, 6))
    for _ in range(_IMAGE_ROUNDS):
        if best_status != STATIONARY:
            break
        before = best_cost
        epms[:] = best.epms
        for which in range(3 * n + 2):
            _image(which, epms, best_pose)
            cost, status, count = _run(
                problem, tolerance, max_iterations, _IMAGE_PATIENCE, best_pose, state, model, tried
            )
            iterations += count
            if cost < _BETTER * best_cost:
                best_cost, best_status = cost, status
                copy_state(state, best)
        if not best_cost < before:
            break
    _leave(best, best_pose)
    best_wrench[:] = best.wrench
    return best_cost, best_status, iterations, starts
