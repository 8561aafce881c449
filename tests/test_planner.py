"""Where plans come from: the last one, and elsewhere where that is not good enough."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from foreseen import CERTAIN, PAPER, UNMOVED, WEIGHTS, Floats, at_home, end_of, goal_of, held, on_the_way
from lane import magnets

from agents import planner as planner_module
from agents.planner import ENOUGH, TROUBLE, Planner, Problem
from magenv.manoeuvre import allow
from magenv.params import PLANTS, System

HOLD_S, SUBSTEPS, SETTLING = 0.1, 20, np.repeat([1.0, 0.2], 6)


def a_planner(stages: int, n_epm: int = 2) -> Planner:
    return Planner(System(n_epm=n_epm), PAPER, HOLD_S, SUBSTEPS, stages)


def a_problem(stages: int, n_epm: int = 2, time_s: float = 40.0) -> Problem:
    """Robots on an approach to 30 mm, no doubt, EPMs at home."""
    state = on_the_way(0.03, time_s)
    ahead = np.stack([on_the_way(0.03, time_s + HOLD_S * (stage + 1)) for stage in range(stages)])
    goal = goal_of(ahead, (SUBSTEPS,), WEIGHTS * SETTLING)
    return Problem(state, UNMOVED, CERTAIN, goal, at_home(state, n_epm))


def cost_of(planner: Planner, problem: Problem, commands: Floats) -> float:
    """Cost of commands (H, N, 6), from the motion alone."""
    state, total = problem.state, 0.0
    for command, reference in zip(commands, problem.goal.references[:, 0], strict=True):
        state = end_of(planner.model, state, problem.pushing, held(command, SUBSTEPS))
        total += float(np.sum((problem.goal.weights * (state - reference)) ** 2))
    return total


@pytest.mark.parametrize(("stages", "n_epm"), [(1, 2), (1, 3), (2, 2), (3, 3)])
def test_a_good_plan_is_found_from_elsewhere(stages: int, n_epm: int) -> None:
    """The last plan is far away, where EPMs hardly act and no descent comes to a good one; its array stays as it is."""
    planner, problem = a_planner(stages, n_epm), a_problem(stages, n_epm)
    last = np.repeat(problem.before[None], stages, axis=0) * [2.4, 2.4, 2.4, 1, 1, 1]
    kept = last.copy()
    commands, cost, sought = planner.plan(problem, last, np.random.default_rng(0))
    assert sought
    assert cost < ENOUGH * stages
    assert cost == pytest.approx(cost_of(planner, problem, commands), rel=1e-9)
    np.testing.assert_array_equal(last, kept)


def test_commands_made_one_after_another_are_good_before_they_are_improved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each reckons with where the one before lands, and aims at a reference of its own."""
    planner, problem = a_planner(3, 3), a_problem(3, 3)
    monkeypatch.setattr(planner, "polish", lambda problem, commands: cost_of(planner, problem, commands))
    costs = [
        planner._from_elsewhere(problem, problem.before[None], 0, math.inf, np.random.default_rng(seed))[0]
        for seed in range(5)
    ]
    assert min(costs) < 0.1
    assert np.median(costs) < ENOUGH


def test_a_good_plan_is_kept_and_nothing_drawn() -> None:
    planner, problem = a_planner(2), a_problem(2)
    good, cost, _ = planner.plan(problem, np.repeat(problem.before[None], 2, axis=0), np.random.default_rng(0))
    rng = np.random.default_rng(1)
    again, same, sought = planner.plan(problem, good, rng)
    assert not sought
    assert same <= cost < 2 * ENOUGH
    assert rng.random() == np.random.default_rng(1).random()
    assert cost_of(planner, problem, again) == pytest.approx(same, rel=1e-9)


def test_what_is_planned_first_does_not_change_what_is_planned_next() -> None:
    """A planner remembers nothing."""
    problem, other = a_problem(2), a_problem(2, time_s=70.0)
    far = np.repeat(problem.before[None], 2, axis=0) * [2.4, 2.4, 2.4, 1, 1, 1]
    used, fresh = a_planner(2), a_planner(2)
    used.plan(replace(other, doubt=1e-3 * np.eye(12)), far, np.random.default_rng(5))
    one, two = (planner.plan(problem, far, np.random.default_rng(0)) for planner in (used, fresh))
    assert one[1:] == two[1:]
    np.testing.assert_array_equal(one[0], two[0])


@pytest.mark.parametrize("spoilt", [math.nan, math.inf])
@pytest.mark.parametrize("stages", [1, 2])
def test_where_there_is_none_the_cost_is_infinite(stages: int, spoilt: float) -> None:
    planner, problem = a_planner(stages), a_problem(stages)
    problem.state[0] = spoilt
    last = np.repeat(problem.before[None], stages, axis=0)
    commands, cost, sought = planner.plan(problem, last, np.random.default_rng(0))
    assert cost == math.inf
    assert not sought
    np.testing.assert_array_equal(commands, last)


def test_the_way_ahead_is_the_shorter_one_round() -> None:
    problem = a_problem(1)
    problem.state[2], problem.state[5] = 3.0, -3.0
    problem.goal.references[0, 0, [2, 5]] = -3.0, 3.0 + 4 * math.pi
    expected = problem.goal.references[0, 0, :6] - problem.state[:6]
    expected[[2, 5]] = [2 * math.pi - 6.0, 6.0 - 2 * math.pi]
    np.testing.assert_allclose(problem.ahead(), expected, atol=1e-12)


def test_searches_begin_where_errors_grow_least(monkeypatch: pytest.MonkeyPatch) -> None:
    """Robots 20 mm apart at 2 Hz: errors grow less by commands sought with a doubt in mind than by those without."""
    state, ahead = on_the_way(0.02, 50.0), on_the_way(0.02, 50.5)
    planner, grown = Planner(System(), PAPER, 0.5, 100, 1), []
    problem = Problem(state, UNMOVED, CERTAIN, goal_of(ahead[None], (100,), WEIGHTS * SETTLING), at_home(state))
    for doubt in (planner_module.DOUBT, CERTAIN):
        monkeypatch.setattr(planner_module, "DOUBT", doubt)
        rng, factors = np.random.default_rng(0), []
        for _ in range(20):
            cost, command = planner._led_up_to(problem, planner._held(problem, rng))
            if cost < ENOUGH:
                ends = [end_of(planner.model, state + e, UNMOVED, held(command[0], 100)) for e in 1e-7 * np.eye(12)[:6]]
                away = np.array(ends) - end_of(planner.model, state, UNMOVED, held(command[0], 100))
                factors.append(np.linalg.norm(away[:, [0, 1, 3, 4]]) / 1e-7)
        assert len(factors) > 5
        grown.append(np.median(factors))
    assert grown[0] < 0.8 * grown[1]


@pytest.mark.parametrize("plant", ["moving", "arm", "arm-reach"])
def test_every_command_of_a_plan_is_one_that_is_allowed(rng: np.random.Generator, plant: str) -> None:
    """Radii, gap, reach and speed are kept from each command to the next: to allow them changes nothing."""
    planner, troubled = Planner(System(), PLANTS[plant], HOLD_S, SUBSTEPS, 2), 0
    for _ in range(10):
        problem = replace(a_problem(2), before=magnets(rng))
        allow(planner.arms, problem.before.copy(), problem.before)
        commands, cost, _ = planner.plan(problem, np.repeat(problem.before[None], 2, axis=0), rng)
        troubled += cost > TROUBLE * 2
        before = problem.before
        for command in commands:
            once = command.copy()
            allow(planner.arms, before, once)
            np.testing.assert_allclose(once, command, rtol=0, atol=1e-9)
            before = command
    assert troubled > 0  # some were sought elsewhere
