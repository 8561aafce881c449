"""The EPMs' way from command to command as it is foreseen: its derivatives, and what of a command is allowed."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from foreseen import CERTAIN, Floats, bases_of, foreseen, shifted
from lane import magnets
from planned import PUSH, SUBSTEPS, Task, joint

from magenv.actions import Actions, pose_to_action
from magenv.forecast import STATE, Course
from magenv.horizon import _linearise
from magenv.manoeuvre import Arms, allow, move
from magenv.params import PLANTS, System
from magenv.poses import from_cartesian

H = 0.005


def arms_of(plant: str, n_epm: int, substeps: int) -> Arms:
    return Arms.of(System(n_epm=n_epm), PLANTS[plant], H, substeps)


def moved(arms: Arms, before: Floats, command: Floats, substeps: int) -> Course:
    """Course from one command to the next, with its derivatives."""
    motion = Course.of(len(command), substeps, True)
    move(arms, before, command, np.stack([bases_of(before), bases_of(command)]), motion)
    return motion


@pytest.mark.parametrize("plant", ["arm", "moving"])
@pytest.mark.parametrize("angle", [0.02, 0.6])
def test_derivatives_of_a_way_are_those_by_its_ends(rng: np.random.Generator, plant: str, angle: float) -> None:
    """By the command before and by the command, in their local coordinates; times of rising and falling are whole.

    The latter change by jumps, which no derivative tells; here they do not.
    """
    substeps, h, arms = 200, 1e-7, arms_of(plant, 2, 200)
    for _ in range(10):
        before = magnets(rng)
        command = shifted(before, rng.normal(0.0, angle, 10) * np.tile([1, 1, 0.05, 1, 1], 2), 0.15, 0.5)
        motion = moved(arms, before, command, substeps)
        np.testing.assert_allclose(motion.path[-1], command, atol=1e-12)
        for column, e in enumerate(h * np.eye(20)):
            up, down = (
                moved(arms, shifted(before, sign * e[:10]), shifted(command, sign * e[10:]), substeps).path
                for sign in (1.0, -1.0)
            )
            end, k, c = column // 10, column // 5 % 2, column % 5
            np.testing.assert_allclose(motion.by[:, end, k, :, c], (up - down)[:, k] / (2 * h), atol=1e-6)
            np.testing.assert_array_equal(up[:, 1 - k], down[:, 1 - k])


@pytest.mark.parametrize("axis", range(3))
def test_derivatives_where_epms_stay(axis: int) -> None:
    """Exactly: along an axis, no way tells a direction. At the end, where they are is what is commanded."""
    epms = np.zeros((2, 6))
    epms[0, [axis, 3 + axis]] = -0.2, 1.0
    epms[1, [(axis + 1) % 3, 3 + axis]] = 0.3, -1.0
    motion, bases = moved(arms_of("arm", 2, 40), epms, epms, 40), bases_of(epms)
    np.testing.assert_allclose(motion.path, np.repeat(epms[None], 40, axis=0), atol=1e-15)
    np.testing.assert_allclose(motion.by[-1, 1], bases, atol=1e-12)
    np.testing.assert_allclose(motion.by[-1, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(motion.by[0, 0] + motion.by[0, 1], bases, atol=1e-12)


def test_what_jumps_is_where_it_is_commanded(rng: np.random.Generator) -> None:
    before, command = magnets(rng), magnets(rng)
    motion = Course.of(2, 10, False)
    bases = np.stack([bases_of(before), bases_of(command)])
    move(arms_of("paper", 2, 10), before, command, bases, motion)
    np.testing.assert_array_equal(motion.path, command[None])
    np.testing.assert_array_equal(motion.by[0, 1], bases[1])
    assert (motion.by[0, 0] == 0.0).all()


@pytest.mark.parametrize("plant", ["arm", "moving", "paper"])
@pytest.mark.parametrize("n_epm", [2, 3])
def test_what_is_allowed_keeps_radii_and_gap_and_is_allowed_again(
    rng: np.random.Generator, plant: str, n_epm: int
) -> None:
    system, arms = System(n_epm=n_epm), arms_of(plant, n_epm, 40)
    for _ in range(50):
        before, command = magnets(rng, system), magnets(rng, system)
        command[:, :3] *= rng.uniform(0.5, 1.5, (n_epm, 1))
        allow(arms, before, command)
        once = command.copy()
        radii, pairs = np.linalg.norm(command[:, :3], axis=1), itertools.combinations(command[:, :3], 2)
        assert system.r_min_m - 1e-9 <= radii.min() <= radii.max() <= system.r_max_m + 1e-9
        assert min(np.linalg.norm(one - other) for one, other in pairs) >= system.gap_min_m - 1e-9
        if arms.travels:  # and on the way
            path = moved(arms, before, command, 40).path[..., :3]
            pairs = itertools.combinations(path.swapaxes(0, 1), 2)
            assert min(np.linalg.norm(one - other, axis=1).min() for one, other in pairs) >= system.gap_min_m - 1e-4
        np.testing.assert_allclose(np.linalg.norm(command[:, 3:], axis=1), 1.0, rtol=1e-12)
        allow(arms, before, command)
        np.testing.assert_allclose(command, once, atol=1e-9)


def test_what_is_allowed_arrives_in_time_as_it_is_told(rng: np.random.Generator) -> None:
    """Rounded to an action; a way that is longer by that much would take one substep more, and another course."""
    system, arms, actions = System(), arms_of("arm", 2, 20), Actions("pose", System())
    for _ in range(50):
        before, command = magnets(rng, system), magnets(rng, system)
        allow(arms, before, command)
        action = pose_to_action(from_cartesian(command[:, :3], command[:, 3:]), system).astype(np.float64)
        acting = actions.to_epms(action[None], np.zeros((1, 2, 3)), before[None])[0][0]
        np.testing.assert_allclose(moved(arms, before, acting, 20).path[-1], acting, rtol=0, atol=1e-12)


@pytest.mark.parametrize("n_epm", [2, 3])
def test_the_linearisation_where_epms_travel(n_epm: int) -> None:
    """Derivatives of all residuals by all commands, through states and ways between them, against differences."""
    task = Task.draw(3, n_epm, stages=3)
    task.arms = arms_of("arm", n_epm, SUBSTEPS)
    commands, s, u = task.start(), task.scratch(), 5 * n_epm
    before = task.before
    for command, step in zip(commands, np.random.default_rng(1).normal(0.0, 0.01, (3, u)), strict=True):
        command[:] = shifted(before, step, 0.15, 0.5)  # near enough to be reached in time
        before = command
    motion = Course.of(n_epm, SUBSTEPS, True)

    def residuals(commands: Floats) -> Floats:
        state, before, parts = task.state, task.before, []
        for stage, command in enumerate(commands):
            goal = task.goal._replace(references=task.goal.references[stage:])
            state, errors, _ = foreseen(task.model, state, PUSH, moved(task.arms, before, command, SUBSTEPS), goal)
            parts += [errors, np.zeros(STATE), *task.besides(stage, command)]
            before = command
        return np.concatenate(parts)

    s.states[0] = task.state
    cost, _ = _linearise(task.model, PUSH, task.goal, task.arms, motion, task.before, CERTAIN, commands, s)
    np.testing.assert_allclose(s.residuals.ravel(), residuals(commands), rtol=1e-9, atol=1e-9)
    assert cost == pytest.approx(float(np.sum(s.residuals**2)), rel=1e-12)
    jacobian = joint(s)[1]
    for column, e in enumerate(1e-6 * np.eye(3 * u)):
        parts = e.reshape(3, u)
        up, down = (np.stack([shifted(x, sign * p) for x, p in zip(commands, parts, strict=True)]) for sign in (1, -1))
        expected = (residuals(up) - residuals(down)) / 2e-6
        np.testing.assert_allclose(jacobian[:, column], expected, atol=1e-5 * np.abs(expected).max())
