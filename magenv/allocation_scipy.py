"""SciPy on the allocation problem: a slow reference for the compiled solver, from the same starts."""

from __future__ import annotations

import math
import warnings
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magenv.margins import gap_margins
from magenv.poses import POSE_SIZE, from_cartesian, to_cartesian
from magenv.solver import CONVERGED, ITERATION_LIMIT, STATIONARY, make_interior
from magenv.wrench import robot_wrench, wrench_jacobian

Floats = NDArray[np.float64]

ScipyMethod = Literal["trust-constr", "SLSQP"]

_ENDS: dict[ScipyMethod, dict[str, float]] = {
    "trust-constr": {"gtol": 1e-10, "xtol": 1e-12, "barrier_tol": 1e-12},
    "SLSQP": {"ftol": 1e-16},
}
"""When a method counts as arrived: late enough that targets can be met within 1e-8."""
_FEASIBLE_M = 1e-9
"""Shortfall of a gap up to which a result counts."""


def scipy_best_of(
    method: ScipyMethod,
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
    """Do what ``magenv.solver.best_of`` does by a method of SciPy, without the images; all gradients are exact."""
    from scipy.optimize import Bounds, NonlinearConstraint, minimize  # a quarter of a second that no other needs

    r_min, r_max, gap = (float(limit) for limit in limits)
    size = poses.shape[1]

    def error(x: Floats) -> Floats:
        return scale * (robot_wrench(positions, moments, x, epm_moment) - target)

    def cost(x: Floats) -> float:
        return 0.5 * float(error(x) @ error(x))

    def gradient(x: Floats) -> Floats:
        jacobian: Floats = scale[:, None] * wrench_jacobian(positions, moments, x, epm_moment)
        return np.asarray(jacobian.T @ error(x))

    def gaps(x: Floats) -> Floats:
        return gap_margins(x, gap)[0]

    low, high = np.full(size, -np.inf), np.full(size, np.inf)
    low[2::POSE_SIZE], high[2::POSE_SIZE] = r_min, r_max
    constraints = (
        [NonlinearConstraint(gaps, 0.0, np.inf, jac=lambda x: gap_margins(x, gap)[1])] if size > POSE_SIZE else []
    )
    options: Any = {"maxiter": max_iterations, **_ENDS[method]}
    best, status, iterations, run = math.inf, ITERATION_LIMIT, 0, 0
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
                method=method,
                bounds=Bounds(low, high, keep_feasible=True),
                constraints=constraints,
                options=options,
            )
        iterations += int(result.nit)
        run += 1
        if result.fun < best and gaps(result.x).min(initial=math.inf) >= -_FEASIBLE_M / gap:
            best = float(result.fun)
            at_rest = STATIONARY if result.success else ITERATION_LIMIT
            status = CONVERGED if 2 * best <= tolerance**2 else at_rest
            best_pose[:] = result.x
        if stop_early and status == CONVERGED:
            break
    best_pose[:] = from_cartesian(*to_cartesian(best_pose))
    best_wrench[:] = robot_wrench(positions, moments, best_pose, epm_moment)
    return cost(best_pose), status, iterations, run
