"""The recursion under a plan against the least-squares problem that it solves."""

from __future__ import annotations

import numpy as np
import pytest
from foreseen import CERTAIN, Floats, shifted
from planned import PUSH, SUBSTEPS, Task, joint

from magenv.forecast import STATE, Course
from magenv.horizon import Scratch, _backward, _linearise
from magenv.manoeuvre import Arms
from magenv.params import Plant, System
from magenv.poses import project_epms


def followed(s: Scratch) -> Floats:
    """Steps (H u,) that the gains make where the motion is linear."""
    before, state, steps = np.zeros(s.gains.shape[1]), np.zeros(STATE), []
    for k in range(len(s.gains)):
        step = s.gains[k, :, :-1] @ np.concatenate([before, state]) + s.gains[k, :, -1]
        steps.append(step)
        before, state = step, s.by[k] @ np.concatenate([before, state, step])
    return np.concatenate(steps)


@pytest.fixture
def arms() -> Arms:
    return Arms.of(System(), Plant(), 0.005, 100)


def random_problem(rng: np.random.Generator, stages: int) -> tuple[Scratch, Floats]:
    """Numbers in all places where a plan has any, those of the command before among them; commands off the bounds."""
    s = Scratch.of(stages, 2, 1)
    for array in (s.residuals, s.jacobians, s.by):
        array[:] = rng.normal(0.0, 0.3, array.shape)
    return s, np.tile([0.0, 0.2, 0.2, 1.0, 0.0, 0.0], (stages, 2, 1))


@pytest.mark.parametrize("stages", [1, 2, 4])
def test_the_recursion_solves_the_least_squares_of_all_commands(
    rng: np.random.Generator, stages: int, arms: Arms
) -> None:
    for _ in range(5):
        s, commands = random_problem(rng, stages)
        assert _backward(commands, arms, 0.0, s)
        residuals, jacobian = joint(s)
        expected = np.linalg.lstsq(jacobian, -residuals)[0]
        np.testing.assert_allclose(followed(s), expected, atol=1e-9 * np.abs(expected).max())


def test_the_feedback_is_the_best_answer_to_where_a_command_begins(rng: np.random.Generator, arms: Arms) -> None:
    s, commands = random_problem(rng, 1)
    assert _backward(commands, arms, 0.0, s)
    j, y = s.jacobians[0], STATE + 10
    for _ in range(5):
        begins = rng.normal(size=y)
        answer = s.gains[0] @ np.append(begins, 1.0)
        expected = np.linalg.lstsq(j[:, y:], -s.residuals[0] - j[:, :y] @ begins)[0]
        np.testing.assert_allclose(answer, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("damping", [1e-3, 0.5, 100.0])
def test_damped_each_command_solves_what_follows_of_the_later_ones(
    rng: np.random.Generator, damping: float, arms: Arms
) -> None:
    """The second command answers as it is damped; what the first one faces then is a least-squares problem as well."""
    (s, commands), y = random_problem(rng, 2), STATE + 10
    assert _backward(commands, arms, damping, s)

    def damped(residuals: Floats, jacobian: Floats) -> Floats:
        """Return the step, and the answers to where the command begins, of a problem in (y, u)."""
        normal = jacobian[:, y:].T @ jacobian[:, y:]
        heavier = normal + damping * np.diag(np.diag(normal) + 1e-3)
        beside = np.column_stack([jacobian[:, :y], residuals])
        return np.asarray(np.linalg.solve(heavier, -jacobian[:, y:].T @ beside))

    last = damped(s.residuals[1], s.jacobians[1])
    np.testing.assert_allclose(s.gains[1], last, atol=1e-10 * np.abs(last).max())
    begins = np.concatenate([np.eye(10, y + 10, y), s.by[0]])  # of the second command, by all of the first
    answered = np.concatenate([begins, last[:, :y] @ begins])
    residuals = s.residuals[1] + s.jacobians[1][:, y:] @ last[:, y]
    first = damped(
        np.concatenate([s.residuals[0], residuals]), np.concatenate([s.jacobians[0], s.jacobians[1] @ answered])
    )
    np.testing.assert_allclose(s.gains[0], first, atol=1e-10 * np.abs(first).max())


@pytest.mark.parametrize("stages", [1, 3])
def test_radii_at_a_bound_stay_there_and_all_else_is_solved(rng: np.random.Generator, stages: int, arms: Arms) -> None:
    found = set()
    for _ in range(10):
        s, commands = random_problem(rng, stages)
        commands[:, 0, 2], commands[:, 0, 1] = arms.limits.r_min, 0.0
        commands[:, 1, 2], commands[:, 1, 1] = arms.limits.r_max, 0.0
        assert _backward(commands, arms, 0.0, s)
        free = (s.gains != 0.0).any(axis=2)
        assert free[:, [i for i in range(10) if i not in (2, 7)]].all()
        residuals, jacobian = joint(s)
        expected = np.zeros(free.size)
        expected[free.ravel()] = np.linalg.lstsq(jacobian[:, free.ravel()], -residuals)[0]
        np.testing.assert_allclose(followed(s), expected, atol=1e-9 * np.abs(expected).max())
        slope = (s.jacobians[-1].T @ s.residuals[-1])[-10:]
        assert free[-1, 2] == (slope[2] <= 0.0), "inwards it may not go, outwards it may"
        assert free[-1, 7] == (slope[7] >= 0.0)
        found |= {(bool(free[-1, 2]), bool(free[-1, 7]))}
    assert len(found) > 2


def test_what_has_no_minimum_has_no_gains(rng: np.random.Generator, arms: Arms) -> None:
    s, commands = random_problem(rng, 2)
    s.jacobians[1, 0, -1] = np.nan
    assert not _backward(commands, arms, 0.0, s)


@pytest.mark.parametrize("crowded", [False, True])
@pytest.mark.parametrize("n_epm", [2, 3])
def test_the_linearisation_is_that_of_cost_and_motion(n_epm: int, crowded: bool) -> None:
    """Derivatives of all residuals by all commands, through the states between them, against differences.

    Where EPMs are crowded, they stand hardly farther apart than the least gap, and that costs as well.
    """
    stages = 1 if crowded else 3  # robots are flung about by EPMs like that
    task = Task.draw(3, n_epm, stages=stages)
    if crowded:
        task.before[0, :3] = task.before[1, :3] + 0.01
        project_epms(task.before, task.arms.limits.r_min, task.arms.limits.r_max, task.arms.limits.gap + 0.015)
    commands, s, u = task.start(), task.scratch(), 5 * n_epm
    for command, step in zip(
        commands, np.random.default_rng(1).normal(0.0, 0.005 if crowded else 0.05, (stages, u)), strict=True
    ):
        command[:] = shifted(command, step)
    s.states[0] = task.state
    motion = Course.of(n_epm, SUBSTEPS, False)
    cost, scale = _linearise(task.model, PUSH, task.goal, task.arms, motion, task.before, CERTAIN, commands, s)
    assert scale == 0.0
    assert cost == pytest.approx(task.cost(commands), rel=1e-12)
    residuals, jacobian = joint(s)
    pairs = n_epm * (n_epm - 1) // 2
    doubted = np.tile(np.repeat([True, False, True], [STATE, STATE, 6 * n_epm + pairs]), stages)
    room = s.residuals[:, -pairs:]
    assert (room > 0.0).any() == crowded
    np.testing.assert_allclose(residuals[doubted], task.residuals(commands), rtol=1e-9, atol=1e-9)
    assert (jacobian[~doubted] == 0.0).all()
    for column, e in enumerate(1e-5 * np.eye(stages * u)):
        up, down = (
            np.stack([shifted(*pair) for pair in zip(commands, sign * e.reshape(stages, u), strict=True)])
            for sign in (1, -1)
        )
        expected = (task.residuals(up) - task.residuals(down)) / 2e-5
        found = jacobian[doubted, column]
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(found).max())
