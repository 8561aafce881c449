"""The inverse problem: targets reached, limits kept, statuses and randomness as told."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from test_poses import assert_feasible

from magenv.allocation import FORCE_SCALE_N, TORQUE_SCALE_NM, Solution, allocate
from magenv.params import System
from magenv.poses import POSE_SIZE, pose_bounds, project, to_cartesian
from magenv.wrench import planar_moments, robot_wrench, wrench_jacobian

Floats = NDArray[np.float64]

SCALES = np.tile([TORQUE_SCALE_NM] * 2 + [FORCE_SCALE_N] * 3, 2)


class Problem(NamedTuple):
    target: Floats
    positions: Floats
    moments: Floats
    system: System


def robots(rng: np.random.Generator, system: System) -> tuple[Floats, Floats]:
    """Positions and moments of two robots in the workspace, over 30 mm apart."""
    positions = np.zeros((2, 3))
    while np.linalg.norm(positions[0] - positions[1]) < 0.03:
        positions[:, :2] = rng.uniform(-0.06, 0.06, (2, 2))
    return positions, planar_moments(rng.uniform(-np.pi, np.pi, 2), system.ipm_moment_am2)


def reachable(seed: int, n_epm: int) -> Problem:
    """A target built from a known allowed pose."""
    rng, system = np.random.default_rng(seed), System(n_epm=n_epm)
    positions, moments = robots(rng, system)
    pose, _ = project(rng.uniform(*pose_bounds(system)), system)
    return Problem(robot_wrench(positions, moments, pose, system.epm_moment_am2), positions, moments, system)


def unreachable(seed: int, n_epm: int) -> Problem:
    """A target of about the paper's 0.5 N and 0.05 N m on all components at once."""
    rng, system = np.random.default_rng(seed), System(n_epm=n_epm)
    positions, moments = robots(rng, system)
    return Problem(0.3 * SCALES * rng.normal(size=10), positions, moments, system)


def assert_same(a: Solution, b: Solution) -> None:
    for name, value in dataclasses.asdict(a).items():
        np.testing.assert_array_equal(value, getattr(b, name))


def assert_consistent(solution: Solution, problem: Problem) -> None:
    """The solution's figures are those of its pose, and the pose is allowed."""
    assert_feasible(solution.pose, problem.system)
    u = robot_wrench(problem.positions, problem.moments, solution.pose, problem.system.epm_moment_am2)
    np.testing.assert_allclose(solution.wrench, u, atol=1e-12 * np.abs(u).max())
    residual = np.linalg.norm((u - problem.target) / SCALES)
    size = np.linalg.norm(problem.target / SCALES)
    assert solution.residual == pytest.approx(residual, rel=1e-6, abs=1e-12)
    assert solution.relative_residual == pytest.approx(residual / size, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("seed", range(20))
def test_targets_of_known_poses_are_reached(seed: int, n_epm: int) -> None:
    problem = reachable(seed, n_epm)
    solution = allocate(*problem, seed=seed)
    assert_consistent(solution, problem)
    assert solution.relative_residual < 1e-8
    assert solution.status == "converged"
    assert solution.starts == 10
    assert 0 < solution.iterations <= 2000


@pytest.mark.parametrize("n_epm", [1, 4])
def test_any_number_of_epms(n_epm: int) -> None:
    problem = reachable(1, n_epm)
    assert_consistent(allocate(*problem, starts=3), problem)


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("seed", range(10))
def test_targets_out_of_reach_give_the_best_found(seed: int, n_epm: int) -> None:
    problem = unreachable(seed, n_epm)
    solution = allocate(*problem, seed=seed)
    assert_consistent(solution, problem)
    assert solution.status != "converged"
    assert 1e-3 < solution.relative_residual < 1.0  # better than no wrench at all
    assert solution.starts == 10


def test_targets_far_out_of_reach_stay_finite() -> None:
    problem = unreachable(0, 2)._replace(target=np.full(10, 1e6))
    solution = allocate(*problem)
    assert_consistent(solution, problem)
    assert solution.status != "converged"


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("seed", range(4))
def test_a_miss_is_a_local_minimum(seed: int, n_epm: int) -> None:
    """SciPy's SLSQP, begun at the solution, must not find anything better by more than 0.1 %."""
    problem = unreachable(seed, n_epm)
    target, positions, moments, system = problem
    solution = allocate(*problem, seed=seed)
    scale = 1 / SCALES / np.linalg.norm(target / SCALES)

    def error(pose: Floats) -> Floats:
        return scale * (robot_wrench(positions, moments, pose, system.epm_moment_am2) - target)

    def slope(pose: Floats) -> Floats:
        return (scale[:, None] * wrench_jacobian(positions, moments, pose, system.epm_moment_am2)).T @ error(pose)

    def squared_gaps(pose: Floats) -> Floats:
        centres, _ = to_cartesian(pose)
        i, j = np.triu_indices(n_epm, 1)
        return np.sum((centres[i] - centres[j]) ** 2, axis=-1) / system.gap_min_m**2 - 1

    bounds = [(system.r_min_m, system.r_max_m) if i % POSE_SIZE == 2 else (None, None) for i in range(5 * n_epm)]
    polished = minimize(
        lambda pose: 0.5 * float(error(pose) @ error(pose)),
        solution.pose,
        jac=slope,
        method="SLSQP",
        bounds=bounds,
        constraints=[{"type": "ineq", "fun": squared_gaps}],
        options={"maxiter": 300, "ftol": 1e-13},
    )
    assert squared_gaps(polished.x).min() > -1e-6
    assert solution.relative_residual <= np.sqrt(2 * polished.fun) * (1 + 1e-3)


@pytest.mark.parametrize("n_epm", [2, 3])
def test_a_miss_is_told_as_stationary(n_epm: int) -> None:
    """The iterations are enough to find most minima: the status says so."""
    statuses = [allocate(*unreachable(seed, n_epm), seed=seed, starts=3).status for seed in range(8)]
    assert statuses.count("stationary") == 8


@pytest.mark.filterwarnings("ignore:delta_grad == 0.0:UserWarning")
@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("seed", range(2))
def test_reachable_targets_agree_with_trust_constr(seed: int, n_epm: int) -> None:
    problem = reachable(seed, n_epm)
    # With three EPMs the same start may lead the two methods to different minima.
    ours = allocate(*problem, seed=seed, starts=2 if n_epm == 2 else 10)
    theirs = allocate(*problem, seed=seed, starts=2, method="trust-constr")
    assert_consistent(theirs, problem)
    assert ours.relative_residual <= theirs.relative_residual + 1e-8


@pytest.mark.parametrize("seed", range(4))
def test_slsqp_ends_feasible_and_at_times_meets_the_target(seed: int) -> None:
    problem = reachable(seed, 3)
    theirs = allocate(*problem, seed=seed, starts=5, method="SLSQP", stop_early=True)
    assert_consistent(theirs, problem)
    assert theirs.relative_residual < 1e-8


@pytest.mark.filterwarnings("ignore:delta_grad == 0.0:UserWarning")
@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("seed", range(2))
def test_targets_out_of_reach_are_met_as_well_as_by_trust_constr(seed: int, n_epm: int) -> None:
    problem = unreachable(seed, n_epm)
    # With three EPMs the same start may lead the two methods to different minima.
    ours = allocate(*problem, seed=seed, starts=2 if n_epm == 2 else 10)
    theirs = allocate(*problem, seed=seed, starts=2, method="trust-constr")
    assert_consistent(theirs, problem)
    assert ours.relative_residual <= theirs.relative_residual * (1.01 if n_epm == 2 else 1.03)


def test_seed_decides() -> None:
    problem = reachable(3, 2)
    assert_same(allocate(*problem, seed=7), allocate(*problem, seed=7))
    assert_same(allocate(*problem, seed=7), allocate(*problem, seed=np.random.default_rng(7)))
    assert not np.array_equal(allocate(*problem, seed=7).pose, allocate(*problem, seed=8).pose)


def test_inputs_are_left_alone() -> None:
    problem = reachable(4, 2)
    before = [value.copy() for value in problem[:3]]
    initial = np.tile([0.1, 0.2, 0.14, 0.3, 0.4], 2)
    first = initial.copy()
    allocate(*problem, initial=initial)
    for value, kept in zip([*problem[:3], initial], [*before, first], strict=True):
        np.testing.assert_array_equal(value, kept)


def test_warm_start_at_the_solution_needs_no_iterations() -> None:
    problem = reachable(5, 2)
    cold = allocate(*problem, seed=0)
    warm = allocate(*problem, initial=cold.pose, starts=0)
    assert warm.status == "converged"
    assert warm.starts == 1
    assert warm.iterations <= 5
    near = allocate(*problem, initial=cold.pose + 0.01, starts=0)
    assert near.status == "converged"
    assert near.iterations < 30


def test_warm_start_comes_before_the_random_ones() -> None:
    problem = reachable(6, 2)
    cold = allocate(*problem, seed=1)
    warm = allocate(*problem, seed=1, initial=cold.pose)
    assert warm.starts == 11
    assert warm.relative_residual <= cold.relative_residual
    early = allocate(*problem, seed=1, initial=cold.pose, stop_early=True)
    assert early.starts == 1


def test_early_stop_spares_the_rest_and_meets_the_target() -> None:
    for seed in range(5):
        problem = reachable(seed, 3)
        full, early = allocate(*problem, seed=seed), allocate(*problem, seed=seed, stop_early=True)
        assert early.status == full.status == "converged"
        assert early.starts < full.starts
        assert early.iterations < full.iterations
        assert early.relative_residual < 1e-8


def test_more_starts_are_never_worse() -> None:
    problem = unreachable(3, 2)
    residuals = [allocate(*problem, seed=2, starts=k).relative_residual for k in (1, 3, 10)]
    assert residuals[1] <= residuals[0] * (1 + 1e-6)
    assert residuals[2] <= residuals[1] * (1 + 1e-6)


def test_iteration_limit_holds() -> None:
    solution = allocate(*unreachable(3, 2), starts=4, max_iterations=3)
    assert solution.status == "iteration_limit"
    assert solution.iterations <= 12


def test_scales_weigh_the_components() -> None:
    """With a tiny torque scale the torques are met better, the forces worse."""
    problem = unreachable(5, 2)
    torques = [0, 1, 5, 6]
    usual = allocate(*problem, seed=0)
    strict = allocate(*problem, seed=0, torque_scale_nm=1e-4)

    def torque_error(solution: Solution) -> float:
        return float(np.linalg.norm(solution.wrench[torques] - problem.target[torques]))

    assert torque_error(strict) < torque_error(usual)


def test_the_mutual_wrench_is_inside_u() -> None:
    """Asking for nothing at 25 mm, where the robots pull each other, needs EPMs that hold against it."""
    system = System()
    positions = np.array([[0.0, 0.0125, 0.0], [0.0, -0.0125, 0.0]])
    moments = planar_moments([0.0, 0.0], system.ipm_moment_am2)
    solution = allocate(np.zeros(10), positions, moments, system)
    far = robot_wrench(positions, moments, np.tile([0, 0, 0.5, 0, 0.0], 2), 1e-300)
    assert np.linalg.norm(far / SCALES) > 1e-3
    assert solution.residual < 1e-7


@pytest.mark.parametrize(
    "initial",
    [
        np.tile([0.0, 0.0, 0.3, 0.0, 0.0], 2),
        np.tile([0.0, 0.0, 0.01, 0.0, 0.0], 2),
        np.array([0.0, 0.0, 0.15, 0.0, 0.0, 0.0, 0.0, 9.0, 0.0, 0.0]),
        np.array([100.0, 50.0, 0.2, -70.0, 30.0, 0.0, 0.0, 0.2, 0.0, 0.0]),
        np.zeros(10),
    ],
)
def test_impossible_warm_starts_are_made_possible(initial: Floats) -> None:
    problem = reachable(2, 2)
    assert_consistent(allocate(*problem, initial=initial, starts=0), problem)


def test_warm_start_of_three_epms_on_one_ray_is_made_possible() -> None:
    problem = reachable(2, 3)
    initial = np.array([0, 0, 0.15, 0, 0, 0, 0, 0.325, 0, 0, 0, 0, 0.5, 0, 0.0])
    assert_feasible(allocate(*problem, initial=initial, starts=0).pose, problem.system)
