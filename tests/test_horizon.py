"""Plans: the least cost that they find, what they keep to, what they make of doubt and of nonsense."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from foreseen import CERTAIN, NATURAL, Floats, foreseen, held, shifted
from planned import PUSH, SUBSTEPS, Task

from magenv.forecast import STATE, Course
from magenv.horizon import land
from magenv.poses import project_epms


@pytest.mark.parametrize(("n_epm", "seed"), [(2, 0), (2, 2), (2, 5), (2, 7), (3, 5), (3, 7), (3, 8), (3, 9)])
def test_a_plan_of_one_command_is_scipys(n_epm: int, seed: int) -> None:
    """Within 1 % of the least cost from the same start; and from where it ends SciPy goes no lower."""
    task = Task.draw(seed, n_epm)
    commands = task.start()
    first, cost = task.cost(commands), task.plan(commands)
    assert cost == pytest.approx(task.cost(commands), rel=1e-9)
    assert cost < 2e-3 * first
    assert cost < 1.01 * task.best(task.before)
    assert cost < 1.01 * task.best(commands[0])


@pytest.mark.parametrize(("n_epm", "seed"), [(2, 1), (2, 4), (3, 12)])
def test_where_the_last_steps_are_slow_little_is_left(n_epm: int, seed: int) -> None:
    """A plan ends where an iteration takes off less than a hundredth; what SciPy still finds is 0.2 % of the way."""
    task = Task.draw(seed, n_epm)
    commands = task.start()
    first, cost = task.cost(commands), task.plan(commands)
    assert task.best(commands[0]) > cost - 2e-3 * first


@pytest.mark.parametrize("stages", [2, 3])
@pytest.mark.parametrize("seed", [0, 1, 3, 5])
def test_near_the_best_one_iteration_is_enough(seed: int, stages: int) -> None:
    """Later commands answer to what earlier ones change: of what a change of all costs, a thousandth is left."""
    task, rng = Task.draw(seed, 2 + seed % 2, stages, pull=0.3), np.random.default_rng(seed)
    commands = task.start()
    best = min(task.plan(commands) for _ in range(6))
    steps = rng.normal(0.0, 2e-3, (stages, len(task.before), 5)) * [1.0, 1.0, 0.1, 1.0, 1.0]
    away = np.stack([shifted(*pair) for pair in zip(commands, steps.reshape(stages, -1), strict=True)])
    before = task.cost(away)
    assert before > 1.2 * best
    assert task.plan(away, iterations=1) - best < 1e-3 * (before - best)


@pytest.mark.parametrize("n_epm", [2, 3])
def test_commands_keep_to_radii_and_gap(n_epm: int) -> None:
    """Goals out of reach, from EPMs that stand at the gap: bounds are met, and kept within 1e-9 m."""
    nearest, inmost, outmost = math.inf, math.inf, 0.0
    for seed in range(30):
        task, rng = Task.draw(seed, n_epm, stages=2), np.random.default_rng(seed)
        task.goal.references[:] += 10 * NATURAL * rng.normal(size=STATE)
        task.before[:, :3] += rng.normal([0.1, 0.0, 0.0], 0.1)
        task.before[0, :3] = task.before[1, :3] + 0.01
        project_epms(task.before, task.arms.limits.r_min, task.arms.limits.r_max, task.arms.limits.gap)
        commands = task.start()
        first, cost = task.cost(commands), task.plan(commands, iterations=8)
        assert cost < first
        radii = np.linalg.norm(commands[..., :3], axis=-1)
        pairs = itertools.combinations(range(n_epm), 2)
        gaps = [np.linalg.norm(commands[:, i, :3] - commands[:, k, :3], axis=-1).min() for i, k in pairs]
        assert radii.min() >= task.arms.limits.r_min - 1e-9
        assert radii.max() <= task.arms.limits.r_max + 1e-9
        assert min(gaps) >= task.arms.limits.gap - 1e-9
        np.testing.assert_allclose(np.linalg.norm(commands[..., 3:], axis=-1), 1.0, rtol=1e-12)
        nearest, inmost, outmost = min(nearest, *gaps), min(inmost, radii.min()), max(outmost, radii.max())
    assert nearest < task.arms.limits.gap + 1e-6
    assert inmost < task.arms.limits.r_min + 1e-6


@pytest.mark.parametrize("iterations", [1, 2, 20])
@pytest.mark.parametrize(("n_epm", "stages"), [(2, 1), (3, 1), (2, 3)])
def test_a_plan_is_never_worse_than_what_it_was_made_from(n_epm: int, stages: int, iterations: int) -> None:
    for seed in range(20):
        doubt = (0.0, 1e-3, 0.1)[seed % 3]
        task = Task.draw(seed, n_epm, stages, pull=(0.0, 0.1)[seed % 2], doubt=doubt)
        commands = task.start()
        kept = commands.copy()
        before = task.plan(commands, enough=math.inf)
        np.testing.assert_array_equal(commands, kept)
        assert before == pytest.approx(task.cost(commands), rel=1e-9) if doubt == 0.0 else before > task.cost(commands)
        cost = task.plan(commands, iterations)
        assert cost < before
        assert task.plan(commands.copy(), enough=math.inf) == pytest.approx(cost, rel=1e-2 if doubt else 1e-9)


def growth(task: Task, command: Floats) -> float:
    """How much of the doubt is left after a command, in weighted errors."""
    by, motion = np.eye(STATE, STATE + 5 * len(command)), held(command, SUBSTEPS)
    foreseen(task.model, task.state, PUSH, motion, task.goal, by)
    return float(np.linalg.svd(task.goal.weights[:, None] * (by[:, :STATE] @ task.doubt), compute_uv=False)[0])


@pytest.mark.parametrize("n_epm", [2, 3])
def test_doubt_makes_plans_that_let_it_grow_less(n_epm: int) -> None:
    """Of a single direction in doubt the risk is the square of its growth, and errors are accepted for it."""
    for seed in range(6):
        task = Task.draw(seed, n_epm, pull=0.01, doubt=1.0)
        task.doubt[:, 1:] = 0.0
        certain, doubtful = task.start(), task.start()
        cost = task.plan(doubtful)
        assert cost == pytest.approx(task.cost(doubtful) + growth(task, doubtful[0]) ** 2, rel=1e-4)
        replace(task, doubt=CERTAIN).plan(certain)
        assert growth(task, doubtful[0]) < 0.95 * growth(task, certain[0])
        assert task.cost(doubtful) > task.cost(certain)


def test_nothing_of_an_earlier_plan_is_left_in_the_scratch() -> None:
    """Doubt, more stages, other EPMs: plans in used room are those in new room."""
    task, doubtful = Task.draw(1, stages=2), Task.draw(2, stages=2, doubt=1.0)
    fresh, used, scratch = task.start(), task.start(), task.scratch()
    doubtful.plan(doubtful.start(), scratch=scratch)
    assert task.plan(used, scratch=scratch) == task.plan(fresh)
    np.testing.assert_array_equal(used, fresh)


@pytest.mark.parametrize("spoilt", ["state", "before", "goal", "together"])
@pytest.mark.parametrize("stages", [1, 2])
def test_what_cannot_be_planned_costs_infinitely(spoilt: str, stages: int) -> None:
    task = Task.draw(0, stages=stages)
    if spoilt == "state":
        task.state[7] = math.nan
    elif spoilt == "goal":
        task.goal.references[-1, 0, 0] = math.nan
    elif spoilt == "before":
        task.before[0, 0] = math.nan
    else:
        task.state[3:5] = task.state[:2]
        task.state[6:] = 0.0
    commands = task.start()
    assert task.plan(commands) == math.inf


def test_landing_is_the_motion_itself() -> None:
    task = Task.draw(0)
    command = shifted(task.before, np.full(10, 0.05))
    end, errors, _ = foreseen(task.model, task.state, PUSH, held(command, SUBSTEPS), task.goal)
    state, motion = task.state.copy(), Course.of(2, SUBSTEPS, False)
    cost = land(task.model, state, PUSH, task.goal, task.arms, motion, 0, task.before, command)
    np.testing.assert_array_equal(state, end)
    assert cost == pytest.approx(errors @ errors, rel=1e-14)
