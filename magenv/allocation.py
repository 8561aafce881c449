"""The inverse problem: EPM poses that give a desired wrench on both robots (paper, section II-C).

Minimise ||S (U_d - U(x))||^2 over the pose vector x, with radii in [r_min, r_max] and every two EPM centres at least
the gap apart; S divides forces and torques by their scales. Solved by a primal-dual interior-point method from several
starts; the best is kept.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import Bounds, NonlinearConstraint, minimize

from magenv.kernels import kernel
from magenv.params import System, require
from magenv.poses import POSE_SIZE, from_cartesian, pose_bounds, pose_to_epm, project_epms, to_cartesian
from magenv.wrench import WRENCH_SIZE, jacobian_kernel, wrench_kernel

Floats = NDArray[np.float64]
Method = Literal["interior-point", "trust-constr"]

FORCE_SCALE_N = 0.5
TORQUE_SCALE_NM = 0.05
"""The paper's targets: what a residual is measured against."""
STATUSES = ("converged", "stationary", "iteration_limit")
"""``converged``: the target is met within the tolerance; ``stationary``: a local minimum that misses it."""

_MARGIN = 1e-3
"""Starts are moved inside the constraints by this share of their size."""
_BARRIER_FALL, _BARRIER_END = 0.1, 1e-8
"""Factor by which the barrier falls, and its share of the error at which a start is at rest."""
_NORM_FLOOR = 1e-6
"""Scaled targets smaller than this count as this large: half a micronewton."""


@dataclass(frozen=True)
class Solution:
    """Best poses found for a desired wrench."""

    pose: Floats
    """Pose vector (5 N), feasible."""
    wrench: Floats
    """U (10) at the pose, N m and N."""
    residual: float
    """Norm of the scaled wrench error."""
    relative_residual: float
    """Residual over the norm of the scaled target (at least 1e-6)."""
    status: str
    """One of ``STATUSES``."""
    iterations: int
    """Iterations of all starts together."""
    starts: int
    """Starts that were run."""


@kernel
def _cholesky_solve(a: Floats, b: Floats) -> bool:
    """Solve a x = b in place for symmetric positive definite ``a``; return False where it is not."""
    n = len(b)
    for j in range(n):
        for k in range(j):
            a[j, j] -= a[j, k] * a[j, k]
        if not a[j, j] > 0.0:
            return False
        a[j, j] = math.sqrt(a[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            a[i, j] /= a[j, j]
    for i in range(n):
        for k in range(i):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= a[k, i] * b[k]
        b[i] /= a[i, i]
    return True


@kernel
def _constraints(pose: Floats, r_min: float, r_max: float, gap: float, values: Floats) -> float:
    """Write the constraints (m,), positive inside, in m; return the least."""
    n = len(pose) // POSE_SIZE
    first, second = np.empty(6), np.empty(6)
    at = 0
    for i in range(n):
        values[at], values[at + 1] = pose[POSE_SIZE * i + 2] - r_min, r_max - pose[POSE_SIZE * i + 2]
        at += 2
    for i in range(n):
        pose_to_epm(pose[POSE_SIZE * i : POSE_SIZE * i + POSE_SIZE], first)
        for j in range(i + 1, n):
            pose_to_epm(pose[POSE_SIZE * j : POSE_SIZE * j + POSE_SIZE], second)
            squared = 0.0
            for k in range(3):
                squared += (first[k] - second[k]) ** 2
            values[at] = (squared - gap * gap) / (2.0 * gap)
            at += 1
    least = math.inf
    for value in values:
        least = min(least, value)
    return least


@kernel
def _constraint_gradients(pose: Floats, gap: float, gradients: Floats) -> None:
    """Write the derivatives of ``_constraints`` by the pose into ``gradients`` (m, 5 N)."""
    n = len(pose) // POSE_SIZE
    gradients[:] = 0.0
    at = 0
    for i in range(n):
        gradients[at, POSE_SIZE * i + 2] = 1.0
        gradients[at + 1, POSE_SIZE * i + 2] = -1.0
        at += 2
    for i in range(n):
        for j in range(i + 1, n):
            # |p_i - p_j|^2 = r_i^2 + r_j^2 - 2 r_i r_j c with c the cosine of the angle between them
            a, b = POSE_SIZE * i, POSE_SIZE * j
            ri, rj = pose[a + 2], pose[b + 2]
            ci, si, cj, sj = math.cos(pose[a + 1]), math.sin(pose[a + 1]), math.cos(pose[b + 1]), math.sin(pose[b + 1])
            cd, sd = math.cos(pose[a] - pose[b]), math.sin(pose[a] - pose[b])
            cosine = ci * cj * cd + si * sj
            scale = -ri * rj / gap
            gradients[at, a] = scale * (-ci * cj * sd)
            gradients[at, b] = scale * (ci * cj * sd)
            gradients[at, a + 1] = scale * (-si * cj * cd + ci * sj)
            gradients[at, b + 1] = scale * (-ci * sj * cd + si * cj)
            gradients[at, a + 2] = (ri - rj * cosine) / gap
            gradients[at, b + 2] = (rj - ri * cosine) / gap
            at += 1


@kernel
def _error(wrench: Floats, target: Floats, scale: Floats, error: Floats) -> float:
    """Write the scaled error (10,) and return half its square."""
    half_square = 0.0
    for i in range(WRENCH_SIZE):
        error[i] = (wrench[i] - target[i]) * scale[i]
        half_square += 0.5 * error[i] * error[i]
    return half_square


@kernel
def _barrier(values: Floats) -> float:
    total = 0.0
    for value in values:
        total -= math.log(value)
    return total


@kernel
def descend(
    target: Floats,
    positions: Floats,
    moments: Floats,
    epm_moment: float,
    limits: Floats,
    scale: Floats,
    tolerance: float,
    max_iterations: int,
    pose: Floats,
    wrench: Floats,
) -> tuple[float, int, int]:
    """Improve ``pose`` (5 N), strictly feasible, in place; return half the squared scaled error, status, iterations.

    A primal-dual interior-point method: Gauss-Newton steps with Levenberg-Marquardt damping on the log-barrier
    function, the barrier shrinking with the duality gap and with the error itself, so that reachable targets are met
    with quadratic convergence. ``limits`` holds r_min, r_max and the gap.
    """
    r_min, r_max, gap = limits[0], limits[1], limits[2]
    n, m = len(pose), 2 * (len(pose) // POSE_SIZE) + (len(pose) // POSE_SIZE) * (len(pose) // POSE_SIZE - 1) // 2
    jacobian, error, gauss, gradient = np.empty((WRENCH_SIZE, n)), np.empty(WRENCH_SIZE), np.empty((n, n)), np.empty(n)
    values, gradients, trial_values = np.empty(m), np.empty((m, n)), np.empty(m)
    matrix, step, trial, trial_wrench = np.empty((n, n)), np.empty(n), np.empty(n), np.empty(WRENCH_SIZE)
    wrench_kernel(positions, moments, pose, epm_moment, wrench)
    cost = _error(wrench, target, scale, error)
    _constraints(pose, r_min, r_max, gap, values)
    barrier = 0.1 * cost / m
    dual = barrier / values
    damping, centred = 1e-2, False
    for iteration in range(max_iterations):
        if 2.0 * cost <= tolerance * tolerance:
            return cost, 0, iteration
        jacobian_kernel(positions, moments, pose, epm_moment, jacobian)
        _constraint_gradients(pose, gap, gradients)
        for i in range(n):
            gradient[i] = 0.0
            for k in range(WRENCH_SIZE):
                jacobian[k, i] *= scale[k]
                gradient[i] += jacobian[k, i] * error[k]
            for j in range(i + 1):
                total = 0.0
                for k in range(WRENCH_SIZE):
                    total += jacobian[k, i] * jacobian[k, j]
                for k in range(m):
                    total += dual[k] / values[k] * gradients[k, i] * gradients[k, j]
                gauss[i, j] = total
        # Far from the central path the barrier must not fall: a centre that touches the curved gap constraint can
        # hardly move along it. It falls once its own problem is about solved, and with the error itself.
        if centred:
            if barrier <= _BARRIER_END * cost:
                return cost, 1, iteration
            barrier *= _BARRIER_FALL
        barrier = min(barrier, 0.1 * cost, 0.1 * cost * cost + _BARRIER_END * cost)
        merit = cost + barrier * _barrier(values)
        accepted = False
        for _ in range(12):
            for i in range(n):
                step[i] = -gradient[i]
                for k in range(m):
                    step[i] += barrier / values[k] * gradients[k, i]
                for j in range(i + 1):
                    matrix[i, j] = gauss[i, j]
                matrix[i, i] += damping * (gauss[i, i] + 1e-9 * (1.0 + cost))
            slope = 0.0
            if _cholesky_solve(matrix, step):
                for i in range(n):
                    slope -= gradient[i] * step[i]
                    for k in range(m):
                        slope += barrier / values[k] * gradients[k, i] * step[i]
                length = 1.0
                for i in range(n // POSE_SIZE):  # fraction to the boundary, exact for the radii; angles at most 1 rad
                    at = POSE_SIZE * i + 2
                    for k in range(POSE_SIZE):
                        if k != 2 and abs(step[POSE_SIZE * i + k]) > 1.0:
                            length = min(length, 1.0 / abs(step[POSE_SIZE * i + k]))
                    if step[at] < 0.0:
                        length = min(length, 0.995 * values[2 * i] / -step[at])
                    elif step[at] > 0.0:
                        length = min(length, 0.995 * values[2 * i + 1] / step[at])
                for _ in range(6):
                    for i in range(n):
                        trial[i] = pose[i] + length * step[i]
                    if _constraints(trial, r_min, r_max, gap, trial_values) > 0.0:
                        inside = True
                        for k in range(m):
                            inside = inside and trial_values[k] >= 0.005 * values[k]
                        if inside:
                            wrench_kernel(positions, moments, trial, epm_moment, trial_wrench)
                            trial_cost = _error(trial_wrench, target, scale, error)
                            if trial_cost + barrier * _barrier(trial_values) <= merit - 1e-4 * length * slope:
                                accepted = True
                                break
                            if length < 0.3:
                                break
                    length *= 0.5
            if accepted:
                break
            damping = max(4.0 * damping, 1e-6)
        if not accepted:  # rounding: nothing lower is to be found with this barrier
            if centred:
                return cost, 1, iteration
            centred = True
            _error(wrench, target, scale, error)
            continue
        centred = slope <= m * barrier
        for k in range(m):
            change = 0.0
            for i in range(n):
                change += gradients[k, i] * step[i]
            new = barrier / values[k] - dual[k] / values[k] * change
            dual[k] = max(new, 0.005 * dual[k])
            # keep the duals within a wide band of their central value, or a bad step haunts the next ones
            central = barrier / trial_values[k]
            dual[k] = min(max(dual[k], 1e-3 * central), 1e3 * central + 1e-300)
        damping = max(0.2 * damping, 1e-12) if length > 0.9 else damping
        for i in range(n):
            pose[i] = trial[i]
        wrench[:] = trial_wrench
        values[:] = trial_values
        cost = trial_cost
    return cost, 2, max_iterations


@kernel
def make_interior(pose: Floats, r_min: float, r_max: float, gap: float) -> None:
    """Move ``pose`` (5 N) strictly inside the constraints, in place."""
    n = len(pose) // POSE_SIZE
    epms = np.empty((n, 6))
    for i in range(n):
        pose_to_epm(pose[POSE_SIZE * i : POSE_SIZE * i + POSE_SIZE], epms[i])
    inner_min, inner_max = r_min + _MARGIN * (r_max - r_min), r_max - _MARGIN * (r_max - r_min)
    project_epms(epms, inner_min, inner_max, gap * (1.0 + _MARGIN))
    for i in range(n):
        at = POSE_SIZE * i
        x, y, z = epms[i, 0], epms[i, 1], epms[i, 2]
        pose[at], pose[at + 1] = math.atan2(y, x), math.atan2(z, math.hypot(x, y))
        pose[at + 2] = math.sqrt(x * x + y * y + z * z)
        # the projection holds to 1e-9 m only: stay strictly inside
        pose[at + 2] = min(max(pose[at + 2], inner_min), inner_max)


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
    """Descend from every row of ``poses`` (M, 5 N); return the best half square, its status, iterations, starts run."""
    best_cost, best_status, iterations, starts = math.inf, 2, 0, 0
    wrench = np.empty(WRENCH_SIZE)
    for pose in poses:
        make_interior(pose, limits[0], limits[1], limits[2])
        cost, status, count = descend(
            target, positions, moments, epm_moment, limits, scale, tolerance, max_iterations, pose, wrench
        )
        iterations += count
        starts += 1
        if cost < best_cost:
            best_cost, best_status = cost, status
            best_pose[:] = pose
            best_wrench[:] = wrench
        if stop_early and status == 0:
            break
    return best_cost, best_status, iterations, starts


def component_scales(force_scale_n: float = FORCE_SCALE_N, torque_scale_nm: float = TORQUE_SCALE_NM) -> Floats:
    """Return what each component of U is divided by (10), N m and N."""
    robot = [torque_scale_nm, torque_scale_nm, force_scale_n, force_scale_n, force_scale_n]
    return np.array(robot + robot)


def random_starts(system: System, starts: int, rng: np.random.Generator) -> Floats:
    """Draw pose vectors (starts, 5 N) uniformly within their bounds."""
    low, high = pose_bounds(system)
    return rng.uniform(low, high, size=(starts, len(low)))


def allocate(
    target: ArrayLike,
    positions: ArrayLike,
    moments: ArrayLike,
    system: System,
    *,
    starts: int = 10,
    seed: int | np.random.Generator = 0,
    initial: ArrayLike | None = None,
    stop_early: bool = False,
    tolerance: float = 1e-8,
    max_iterations: int = 200,
    force_scale_n: float = FORCE_SCALE_N,
    torque_scale_nm: float = TORQUE_SCALE_NM,
    method: Method = "interior-point",
) -> Solution:
    """Find EPM poses whose wrench on the robots comes nearest to the target.

    Parameters
    ----------
    target : array_like, shape (10,)
        Desired U_d in the magnet frames (see ``magenv.wrench``), N m and N; the robots' mutual wrench is part of U.
    positions, moments : array_like, shape (2, 3)
        Robots' positions in m and moments in A m^2, global frame.
    system : System
        Magnets and limits.
    starts : int
        Random starts (paper: 10), drawn uniformly from the bounds with ``seed``, an integer or a generator.
    initial : array_like, shape (5 N,), optional
        Warm start, tried before the random ones.
    stop_early : bool
        Whether a start that meets the target within the tolerance spares the rest.
    tolerance : float
        Relative residual at which the target counts as met.
    max_iterations : int
        Limit per start.
    force_scale_n, torque_scale_nm : float
        What forces and torques are divided by.
    method : {"interior-point", "trust-constr"}
        Ours, or SciPy's interior point on the same problem and starts, as a slow reference.

    Returns
    -------
    Solution
        The best of all starts.

    Raises
    ------
    ValueError
        If a shape does not fit or a value is not finite.
    """
    u_d, p, m = (np.ascontiguousarray(value, dtype=np.float64) for value in (target, positions, moments))
    for name, value, shape in (("target", u_d, (WRENCH_SIZE,)), ("positions", p, (2, 3)), ("moments", m, (2, 3))):
        require(value.shape == shape, name, f"an array of shape {shape}", value.shape)
        require(bool(np.isfinite(value).all()), name, "finite", value.tolist())
    require(bool(np.any(p[0] != p[1])), "positions", "of two robots apart from each other", p.tolist())
    require(bool(np.linalg.norm(m, axis=1).all()), "moments", "other than zero", m.tolist())
    for name, number in (("force_scale_n", force_scale_n), ("torque_scale_nm", torque_scale_nm)):
        require(math.isfinite(number) and number > 0, name, "a positive, finite number", number)
    size = POSE_SIZE * system.n_epm
    first = np.empty((0, size))
    if initial is not None:
        first = np.array(initial, dtype=np.float64)[None]
        require(first.shape == (1, size), "initial", f"an array of shape ({size},)", first.shape[1:])
        require(bool(np.isfinite(first).all()), "initial", "finite", first[0].tolist())
    enough = isinstance(starts, int) and starts >= 0 and starts + len(first) >= 1
    require(enough, "starts", "a whole number of at least 1 (0 with an initial pose)", starts)
    require(method in ("interior-point", "trust-constr"), "method", "interior-point or trust-constr", method)
    poses = np.concatenate([first, random_starts(system, starts, np.random.default_rng(seed))])
    scale = 1.0 / component_scales(force_scale_n, torque_scale_nm)
    norm = max(float(np.linalg.norm(scale * u_d)), _NORM_FLOOR)
    limits = np.array([system.r_min_m, system.r_max_m, system.gap_min_m])
    solve = best_of if method == "interior-point" else _trust_constr
    best_pose, best_wrench = np.empty(size), np.empty(WRENCH_SIZE)
    cost, status, iterations, run = solve(
        u_d,
        p,
        m,
        system.epm_moment_am2,
        limits,
        scale / norm,
        tolerance,
        max_iterations,
        stop_early,
        poses,
        best_pose,
        best_wrench,
    )
    relative = math.sqrt(2 * cost)
    canonical = from_cartesian(*to_cartesian(best_pose))
    return Solution(canonical, best_wrench, relative * norm, relative, STATUSES[status], int(iterations), int(run))


def _trust_constr(
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
    """Do what ``best_of`` does with SciPy's trust-region interior-point method."""
    r_min, r_max, gap = limits
    n = poses.shape[1] // POSE_SIZE
    m = 2 * n + n * (n - 1) // 2
    wrench, error = np.empty(WRENCH_SIZE), np.empty(WRENCH_SIZE)
    jacobian = np.empty((WRENCH_SIZE, poses.shape[1]))
    values, gradients = np.empty(m), np.empty((m, poses.shape[1]))

    def cost(x: Floats) -> float:
        wrench_kernel(positions, moments, x, epm_moment, wrench)
        return _error(wrench, target, scale, error)

    def gradient(x: Floats) -> Floats:
        cost(x)
        jacobian_kernel(positions, moments, x, epm_moment, jacobian)
        return (scale[:, None] * jacobian).T @ error

    def gaps(x: Floats) -> Floats:
        _constraints(x, r_min, r_max, gap, values)
        return values[2 * n :].copy()

    def gap_gradients(x: Floats) -> Floats:
        _constraint_gradients(x, gap, gradients)
        return gradients[2 * n :].copy()

    low, high = np.full(poses.shape[1], -np.inf), np.full(poses.shape[1], np.inf)
    low[2::POSE_SIZE], high[2::POSE_SIZE] = r_min, r_max
    constraints = [NonlinearConstraint(gaps, 0.0, np.inf, jac=gap_gradients)] if n > 1 else []
    best, status, iterations, run = math.inf, 2, 0, 0
    for start in poses:
        make_interior(start, r_min, r_max, gap)
        if run == 0:
            best_pose[:] = start
        with warnings.catch_warnings():
            # SciPy warns where its quasi-Newton update sees no change; that ends the search, and is no fault
            warnings.filterwarnings("ignore", message="delta_grad == 0.0", category=UserWarning)
            result = minimize(
                cost,
                start,
                jac=gradient,
                method="trust-constr",
                bounds=Bounds(low, high, keep_feasible=True),
                constraints=constraints,
                options={"maxiter": max_iterations, "gtol": 1e-10, "xtol": 1e-12, "barrier_tol": 1e-12},
            )
        iterations += int(result.nit)
        run += 1
        if result.fun < best and (n == 1 or gaps(result.x).min() >= -1e-9):
            best = float(result.fun)
            status = 0 if 2 * best <= tolerance**2 else (1 if result.status in (1, 2) else 2)
            best_pose[:] = result.x
        if stop_early and status == 0:
            break
    best = cost(best_pose)
    best_wrench[:] = wrench
    return best, status, iterations, run
