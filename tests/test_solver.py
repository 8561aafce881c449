"""The solver's parts against finite differences and numpy; its results against IPOPT's, stored for fixed targets."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.targets import CLASSES, TARGETS, Problem, TargetClass, problem
from magenv.allocation import Solutions, allocate, allocate_batch, component_scales
from magenv.cholesky import factorise, gram, solve
from magenv.descent import Problem as Descent
from magenv.descent import new_model, new_state
from magenv.interior import build, evaluate
from magenv.params import System
from magenv.poses import pose_bounds, to_cartesian
from magenv.spheres import move, pose_to_points, tangents_at
from magenv.wrench import planar_moments, robot_frames, robot_wrench

Floats = NDArray[np.float64]

IPOPT = json.loads((Path(__file__).parent / "data" / "allocation_ipopt.json").read_text(encoding="utf-8"))
SCALES = component_scales()


def least_slack(pose: Floats, system: System) -> float:
    """Return by how much a pose keeps clear of its limits, m."""
    centres, _ = to_cartesian(pose)
    i, j = np.triu_indices(system.n_epm, 1)
    gaps = np.linalg.norm(centres[i] - centres[j], axis=-1) - system.gap_min_m
    radii = pose[2::5]
    return float(min(gaps.min(initial=np.inf), (radii - system.r_min_m).min(), (system.r_max_m - radii).min()))


@pytest.mark.parametrize("n", [1, 5, 10, 15])
def test_cholesky(rng: np.random.Generator, n: int) -> None:
    a = rng.normal(size=(10, n))
    lower = np.empty((n, n))
    gram(a, lower)
    np.testing.assert_allclose(np.tril(lower), np.tril(a.T @ a), rtol=1e-12, atol=1e-12)
    full = a.T @ a + np.eye(n)
    factor, x = full.copy(), rng.normal(size=n)
    b = full @ x
    assert factorise(factor)
    solve(factor, b)
    np.testing.assert_allclose(b, x, rtol=1e-9, atol=1e-9)
    assert not factorise(full - 1e3 * np.eye(n))
    assert not factorise(np.full((n, n), np.nan))


@pytest.mark.parametrize("n_epm", [1, 2, 3])
def test_model_is_that_of_finite_differences(rng: np.random.Generator, n_epm: int) -> None:
    """Gradient and Hessian of f - duals . gaps along the steps, at a random point with a large error."""
    system = System(n_epm=n_epm)
    positions = np.array([[0.04, 0.01, 0.0], [-0.03, -0.02, 0.01]])
    moments = planar_moments([0.3, -1.0], system.ipm_moment_am2)
    frames, mutual = np.empty((2, 3, 3)), np.empty(10)
    robot_frames(positions, moments, frames, mutual)
    limits = system.r_min_m, system.r_max_m, system.gap_min_m
    target = 0.5 * SCALES * rng.normal(size=10)
    descent = Descent(target, positions, moments, frames, mutual, system.epm_moment_am2, 1 / SCALES, *limits)
    model, state, moved = new_model(n_epm), new_state(n_epm), new_state(n_epm)
    pose_to_points(rng.uniform(*pose_bounds(system)), state.points)
    cost = evaluate(descent, state, model.work)
    model.duals[:] = rng.uniform(0.1, 1.0, len(model.duals))
    build(descent, state, cost, True, model)
    tangents, duals = model.tangents.copy(), model.duals[2 * n_epm :]

    def lagrangian(step: Floats) -> float:
        move(state.points, tangents, step, moved.points)
        return evaluate(descent, moved, model.work) - float(duals @ moved.gaps)

    h, size = 1e-4, 5 * n_epm
    units = h * np.eye(size)
    slope = np.array([(lagrangian(u) - lagrangian(-u)) / (2 * h) for u in units])
    exact = model.gradient - duals @ model.slopes
    np.testing.assert_allclose(slope, exact, atol=1e-5 * np.abs(exact).max())
    hessian = np.array(
        [[lagrangian(u + v) - lagrangian(u - v) - lagrangian(v - u) + lagrangian(-u - v) for v in units] for u in units]
    ) / (4 * h * h)
    exact = np.tril(model.hessian)
    np.testing.assert_allclose(np.tril(hessian), exact, atol=1e-4 * np.abs(exact).max())


def test_steps_stay_on_the_spheres(rng: np.random.Generator) -> None:
    system = System(n_epm=3)
    points, moved, tangents = np.empty((3, 7)), np.empty((3, 7)), np.empty((3, 5, 3))
    for _ in range(20):
        pose_to_points(rng.uniform(*pose_bounds(system)), points)
        tangents_at(points, tangents)
        step = rng.normal(size=15)
        move(points, tangents, step, moved)
        np.testing.assert_allclose(np.linalg.norm(moved[:, :3], axis=1), 1.0, rtol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(moved[:, 4:], axis=1), 1.0, rtol=1e-12)
        np.testing.assert_allclose(moved[:, 3] - points[:, 3], step[2::5], rtol=1e-12)
        turn = 2 * np.arctan(0.5 * np.hypot(step[0], step[1]))
        np.testing.assert_allclose(points[0, :3] @ moved[0, :3], np.cos(turn), atol=1e-12)


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("target_class", CLASSES)
def test_no_worse_than_ipopt_from_the_same_starts(target_class: TargetClass, n_epm: int) -> None:
    """IPOPT's best of the same ten starts, made by ``python -m benchmarks.ipopt``."""
    theirs = IPOPT["best_relative_residual"][f"{target_class}{n_epm}"]
    reached = 0
    for index, residual in enumerate(theirs):
        given = problem(target_class, index, n_epm)
        ours = allocate(*given, seed=index)
        assert least_slack(ours.pose, given.system) > 0.0
        assert ours.status in ("converged", "stationary")
        assert ours.relative_residual < 1e-8 or target_class != "A"
        reached += ours.relative_residual <= 1.01 * residual + 1e-8
    assert len(theirs) == TARGETS
    assert reached == TARGETS


@pytest.mark.parametrize("n_epm", [2, 3])
def test_every_pose_is_strictly_feasible(n_epm: int) -> None:
    """Also of searches that are cut short, from starts of all kinds."""
    for seed in range(60):
        given = problem("A", seed, n_epm)
        for factor, limit in ((1.0, 200), (30.0, 200), (30.0, 1 + seed % 20)):
            found = allocate(factor * given.target, *given[1:], starts=2, seed=seed, max_iterations=limit)
            assert least_slack(found.pose, given.system) > 0.0
            u = robot_wrench(given.positions, given.moments, found.pose, given.system.epm_moment_am2)
            np.testing.assert_allclose(found.wrench, u, atol=1e-12 * np.abs(u).max())


def stacked(target_class: TargetClass, count: int, n_epm: int = 2) -> tuple[list[Problem], tuple[Any, ...]]:
    problems = [problem(target_class, index, n_epm) for index in range(count)]
    target, positions, moments = (np.stack([given[i] for given in problems]) for i in range(3))
    return problems, (target, positions, moments, problems[0].system)


def assert_rows(batch: Solutions, index: Any, alone: Any) -> None:
    for name, value in dataclasses.asdict(alone).items():
        np.testing.assert_array_equal(getattr(batch, name)[index], value)


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("target_class", ["A", "C"])
def test_batch_has_the_bits_of_one_by_one(target_class: TargetClass, n_epm: int) -> None:
    problems, arguments = stacked(target_class, 7, n_epm)
    one, two = (allocate_batch(*arguments, seed=3, threads=threads) for threads in (1, 2))
    part = allocate_batch(*(value[2:4] for value in arguments[:3]), arguments[3], seed=3)
    assert one.pose.shape == (7, 5 * n_epm)
    for index, given in enumerate(problems):
        alone = allocate(*given, seed=3)
        assert_rows(one, index, alone)
        assert_rows(two, index, alone)
        if index in (2, 3):
            assert_rows(part, index - 2, alone)


def test_batch_broadcasts_leading_axes() -> None:
    _, (target, positions, moments, system) = stacked("A", 6)
    batch = allocate_batch(target.reshape(2, 3, 10), positions[0], moments[0], system, starts=2)
    assert batch.pose.shape == (2, 3, 10)
    assert batch.wrench.shape == (2, 3, 10)
    assert batch.status.shape == batch.residual.shape == batch.starts.shape == (2, 3)
    assert_rows(batch, (1, 2), allocate(target[5], positions[0], moments[0], system, starts=2))
    single = allocate_batch(target[0], positions[0], moments[0], system, starts=2)
    assert single.pose.shape == (10,)
    assert single.residual.shape == ()
    assert allocate_batch(target[:0], positions[0], moments[0], system).pose.shape == (0, 10)


def test_batch_starts_warm() -> None:
    """A target moved by 2 % is met from the pose before; where it is not, the random starts follow."""
    _, (target, positions, moments, system) = stacked("A", 12)
    cold = allocate_batch(target, positions, moments, system)
    direction = np.random.default_rng(1).normal(size=target.shape)
    size = np.linalg.norm(target / SCALES, axis=1, keepdims=True)
    moved = target + 0.02 * size * SCALES * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    warm = allocate_batch(moved, positions, moments, system, initial=cold.pose, stop_early=True)
    assert np.median(warm.iterations[warm.starts == 1]) <= 15
    assert 2 * (warm.starts == 1).sum() >= (warm.status == "converged").sum()  # of those in reach
    assert (warm.status[warm.starts <= 10] == "converged").all()
    assert (warm.status == "converged").sum() > (warm.starts == 1).sum()  # the random starts help
    for index in range(12):
        options: dict[str, Any] = {"initial": cold.pose[index], "stop_early": True}
        assert_rows(warm, index, allocate(moved[index], positions[index], moments[index], system, **options))


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"target": np.zeros((3, 9))}, "target"),
        ({"target": np.full((3, 10), np.nan)}, "target"),
        ({"positions": np.zeros((3, 2, 3))}, "positions"),
        ({"moments": np.zeros(3)}, "moments"),
        ({"initial": np.zeros((3, 15))}, "initial"),
        ({"starts": 0}, "starts"),
        ({"threads": 0}, "threads"),
        ({"threads": 1.5}, "threads"),
    ],
)
def test_batch_refuses_bad_input(changes: dict[str, Any], name: str) -> None:
    target, positions, moments, system = problem("A", 0)
    arguments = {"target": target, "positions": positions, "moments": moments, "system": system} | changes
    with pytest.raises(ValueError, match=f"^Input {name} must be .+; instead received"):
        allocate_batch(**arguments)
