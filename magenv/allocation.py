"""The inverse problem: EPM poses that give a desired wrench on both robots (paper, section II-C).

Minimise ||S (U_d - U(x))||^2 over the pose vector x, with radii in [r_min, r_max] and every two EPM centres at least
the gap apart; S divides forces and torques by their scales. Solved by a primal-dual interior-point method from several
starts; the best is kept (``magenv.solver``).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.allocation_input import check_limits, checked_problem, draw_starts
from magenv.allocation_scipy import ScipyMethod, scipy_best_of
from magenv.kernels import kernel
from magenv.params import System, common_shape, is_whole, require
from magenv.solver import best_of, relative_scale
from magenv.workers import Workers
from magenv.wrench import WRENCH_SIZE

Floats = NDArray[np.float64]
Method = Literal["interior-point"] | ScipyMethod

FORCE_SCALE_N = 0.5
TORQUE_SCALE_NM = 0.05
"""The paper's targets: what a residual is measured against."""
STATUSES = ("converged", "stationary", "iteration_limit")
"""``converged``: the target is met within the tolerance; ``stationary``: a local minimum that misses it."""


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
    """Starts that were run, images of the best not counted (see ``magenv.solver.best_of``)."""


@dataclass(frozen=True)
class Solutions:
    """Best poses found for many desired wrenches: the fields of ``Solution``, stacked over leading axes."""

    pose: Floats
    """Pose vectors (..., 5 N), feasible."""
    wrench: Floats
    """U (..., 10) at the poses, N m and N."""
    residual: Floats
    """Norms of the scaled wrench errors (...)."""
    relative_residual: Floats
    """Residuals over the norms of the scaled targets (...)."""
    status: NDArray[np.str_]
    """Of ``STATUSES`` (...)."""
    iterations: NDArray[np.int64]
    """Iterations of all starts of a target together (...)."""
    starts: NDArray[np.int64]
    """Starts that were run (...)."""


def component_scales(force_scale_n: float = FORCE_SCALE_N, torque_scale_nm: float = TORQUE_SCALE_NM) -> Floats:
    """Return what each component of U is divided by (10), N m and N."""
    robot = [torque_scale_nm, torque_scale_nm, force_scale_n, force_scale_n, force_scale_n]
    return np.array(robot + robot)


def _weights(force_scale_n: float, torque_scale_nm: float, components: Sequence[int] | None) -> Floats:
    """Return one over the scale of each component that counts, zero for the others (10)."""
    for name, number in (("force_scale_n", force_scale_n), ("torque_scale_nm", torque_scale_nm)):
        fits = isinstance(number, (int, float, np.number)) and 1e-9 <= number <= 1e9
        require(fits, name, "a number from 1e-9 to 1e9", number)
    weights: Floats = 1.0 / component_scales(float(force_scale_n), float(torque_scale_nm))
    if components is None:
        return weights
    return np.where(np.isin(np.arange(WRENCH_SIZE), checked_components(components)), weights, 0.0)


def checked_components(components: Sequence[int]) -> list[int]:
    """Return indices into U as a list, or raise ``ValueError``."""
    chosen = list(components) if isinstance(components, Iterable) else []
    fits = len(chosen) > 0 and all(is_whole(i) and 0 <= i < WRENCH_SIZE for i in chosen)
    require(fits, "components", f"indices from 0 to {WRENCH_SIZE - 1}, one at least", components)
    return chosen


def _limits(system: System) -> Floats:
    return np.array([system.r_min_m, system.r_max_m, system.gap_min_m])


@kernel
def _allocate_rows(
    first: int,
    last: int,
    targets: Floats,
    positions: Floats,
    moments: Floats,
    epm_moment: float,
    limits: Floats,
    weights: Floats,
    tolerance: float,
    max_iterations: int,
    stop_early: bool,
    initial: Floats,
    random: Floats,
    poses: Floats,
    wrenches: Floats,
    relative: Floats,
    norms: Floats,
    counts: NDArray[np.int64],
) -> None:
    """Solve rows ``first`` to ``last`` from ``initial`` (n, 5 N or 0) and ``random`` (M, 5 N) each.

    Writes poses (n, 5 N), wrenches (n, 10), relative residuals (n,), norms of the targets
    (n,) and counts (n, 3): status, iterations, starts.
    """
    warm = 1 if initial.shape[1] > 0 else 0
    # Arrays of the thread alone: views of shared ones share a reference count, which cores would fight over.
    target, position, moment, bounds = np.empty(WRENCH_SIZE), np.empty((2, 3)), np.empty((2, 3)), limits.copy()
    pose, wrench = np.empty(poses.shape[1]), np.empty(WRENCH_SIZE)
    starts, scale = np.empty((warm + len(random), poses.shape[1])), np.empty(WRENCH_SIZE)
    for i in range(first, last):
        if warm:
            starts[0] = initial[i]
        starts[warm:] = random
        target[:], position[:], moment[:] = targets[i], positions[i], moments[i]
        norms[i] = relative_scale(target, weights, scale)
        cost, counts[i, 0], counts[i, 1], counts[i, 2] = best_of(
            target,
            position,
            moment,
            epm_moment,
            bounds,
            scale,
            tolerance,
            max_iterations,
            stop_early,
            starts,
            pose,
            wrench,
        )
        poses[i], wrenches[i] = pose, wrench
        relative[i] = math.sqrt(2.0 * cost)


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
    components: Sequence[int] | None = None,
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
    components : sequence of int, optional
        Indices of the components of U that count, the others being borne by something else; without, all.
    method : {"interior-point", "trust-constr", "SLSQP"}
        Ours, or SciPy's interior point or sequential least squares on the same problem and starts, as slow references.

    Returns
    -------
    Solution
        The best of all starts.

    Raises
    ------
    ValueError
        If a shape does not fit or a value is not finite.
    """
    known = method in ("interior-point", "trust-constr", "SLSQP")
    require(known, "method", "interior-point, trust-constr or SLSQP", method)
    u_d, p, m, first = checked_problem(target, positions, moments, initial, system, leading=False)
    check_limits(tolerance, max_iterations)
    weights = _weights(force_scale_n, torque_scale_nm, components)
    poses = draw_starts(system, starts, seed, first is not None)
    poses = poses.copy() if first is None else np.concatenate([first[None], poses])
    best_pose, best_wrench, scale = np.empty(poses.shape[1]), np.empty(WRENCH_SIZE), np.empty(WRENCH_SIZE)
    norm = relative_scale(u_d, weights, scale)
    solve = best_of if method == "interior-point" else partial(scipy_best_of, method)
    cost, status, iterations, run = solve(
        u_d,
        p,
        m,
        system.epm_moment_am2,
        _limits(system),
        scale,
        tolerance,
        max_iterations,
        stop_early,
        poses,
        best_pose,
        best_wrench,
    )
    relative = math.sqrt(2.0 * cost)
    return Solution(best_pose, best_wrench, relative * norm, relative, STATUSES[status], int(iterations), int(run))


def allocate_batch(
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
    components: Sequence[int] | None = None,
    threads: int = 1,
) -> Solutions:
    """Solve many allocations in one call, each with the bits that ``allocate`` gives it alone with the same seed.

    Parameters
    ----------
    target : array_like, shape (..., 10)
        Desired U_d, N m and N.
    positions, moments : array_like, shape (..., 2, 3)
        Robots' positions in m and moments in A m^2. The leading axes of all inputs broadcast.
    system, starts, seed, stop_early, tolerance, max_iterations, force_scale_n, torque_scale_nm, components
        As in ``allocate``; all targets share the random starts.
    initial : array_like, shape (..., 5 N), optional
        Warm starts, tried before the random ones.
    threads : int
        Threads that share the targets; the bits do not depend on their number.

    Returns
    -------
    Solutions
        The best of all starts, per target.

    Raises
    ------
    ValueError
        If a shape does not fit or a value is not finite.
    """
    u_d, p, m, first = checked_problem(target, positions, moments, initial, system, leading=True)
    check_limits(tolerance, max_iterations)
    weights = _weights(force_scale_n, torque_scale_nm, components)
    drawn = draw_starts(system, starts, seed, first is not None)
    warm = np.empty(0) if first is None else first
    shape = common_shape(target=u_d.shape[:-1], positions=p.shape[:-2], moments=m.shape[:-2], initial=warm.shape[:-1])
    own = ((WRENCH_SIZE,), (2, 3), (2, 3), warm.shape[-1:])
    u_d, p, m, warm = (
        np.array(np.broadcast_to(value, shape + end), order="C").reshape(math.prod(shape), *end)
        for value, end in zip((u_d, p, m, warm), own, strict=True)
    )
    n, size = len(u_d), drawn.shape[1]
    poses, wrenches, relative = np.empty((n, size)), np.empty((n, WRENCH_SIZE)), np.empty(n)
    norms, counts = np.empty(n), np.empty((n, 3), np.int64)
    Workers(threads).run(
        _allocate_rows,
        n,
        u_d,
        p,
        m,
        system.epm_moment_am2,
        _limits(system),
        weights,
        tolerance,
        max_iterations,
        stop_early,
        warm,
        drawn,
        poses,
        wrenches,
        relative,
        norms,
        counts,
    )
    status, iterations, run = (counts[:, i].reshape(shape) for i in range(3))
    return Solutions(
        poses.reshape(*shape, size),
        wrenches.reshape(*shape, WRENCH_SIZE),
        (relative * norms).reshape(shape),
        relative.reshape(shape),
        np.array(STATUSES)[status],
        iterations,
        run,
    )
