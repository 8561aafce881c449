"""The solver of the ``wrench`` mode says how it ended; where it finds nothing, the last safe command is held."""

from __future__ import annotations

import numpy as np
import pytest
from rollouts import MakeEnv, N, vector

from agents.baseline import Baseline, paper_baseline, tuned_baseline
from agents.rollout import run
from magenv.env import TwoRobots
from magenv.outcome import CONVERGED, FELL_BACK, NOT_CONVERGED
from magenv.vector_env import TwoRobotsVector

SMALL = np.full(6, 0.02, np.float32)
"""Four tenths of a millinewton, twenty micronewton metres: in reach."""
LARGE = np.array([-1, 1, 1, 1, 1, 1], np.float32)
"""28 mN and 1 mN m on each robot, one pushed left, the other right: out of reach at the start of approach-60."""


def coincide(env: TwoRobots | TwoRobotsVector, row: int) -> None:
    """Let both robots be measured on one spot, where their mutual wrench is infinite: there is nothing to be found."""
    measured = env._episodes.state.measured
    measured[row, 1] = measured[row, 0]


@pytest.fixture
def env(make_env: MakeEnv) -> TwoRobots:
    return make_env(scenario="approach-60", action="wrench", control_hz=20.0)


def test_how_the_solver_ended_is_told(env: TwoRobots) -> None:
    assert "solver" not in env.reset(seed=0)[1]
    info = env.step(SMALL)[4]
    assert type(info["solver"]) is int
    assert info["solver"] == CONVERGED
    env.reset(seed=0)
    assert env.step(LARGE)[4]["solver"] == NOT_CONVERGED


def test_other_modes_have_no_solver(make_env: MakeEnv) -> None:
    env = make_env()
    env.reset(seed=0)
    assert "solver" not in env.step(np.zeros(10, np.float32))[4]


def test_a_solver_that_fails_holds_the_last_command(env: TwoRobots) -> None:
    env.reset(seed=0)
    last = env.step(SMALL)[4]["epm_pose"]
    coincide(env, 0)
    observation, reward, _, _, info = env.step(-SMALL)
    assert (info["solver"], info["projected"]) == (FELL_BACK, False)
    np.testing.assert_array_equal(info["epm_pose"], last)
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)
    assert env.step(-SMALL)[4]["solver"] == CONVERGED, "and the next command is found again"


def test_before_the_first_command_it_holds_where_the_episode_began(env: TwoRobots) -> None:
    env.reset(seed=0)
    env.step(SMALL)
    start = env.reset(seed=1)[1]["epm_pose"]
    coincide(env, 0)
    info = env.step(SMALL)[4]
    assert info["solver"] == FELL_BACK
    np.testing.assert_array_equal(info["epm_pose"], start)


def test_rows_of_a_batch_fail_alone() -> None:
    env, whole = (vector(scenario="approach-60", action="wrench", control_hz=20.0) for _ in range(2))
    for batch in (env, whole):
        batch.reset(seed=0)
        batch.step(np.tile(SMALL, (N, 1)))
    coincide(env, 2)
    before = env._episodes.state.targets[2].copy()
    info, other = (batch.step(np.tile(-SMALL, (N, 1)))[4] for batch in (env, whole))
    assert info["solver"].tolist() == [CONVERGED, CONVERGED, FELL_BACK, CONVERGED]
    assert info["_solver"].all()
    np.testing.assert_array_equal(env._episodes.state.targets[2], before)
    for row in (0, 1, 3):
        np.testing.assert_array_equal(info["robots"][row], other["robots"][row])


@pytest.mark.parametrize("controller", [paper_baseline(), tuned_baseline()], ids=lambda one: one.name)
def test_a_baseline_that_finds_nothing_holds_the_present_poses(make_env: MakeEnv, controller: Baseline) -> None:
    env = make_env(scenario="approach-60", action="pose")
    present = env.reset(seed=0)[1]["epm_pose"]
    coincide(env, 0)
    action, state = controller.predict(env._episodes.observe())
    assert state.solver.tolist() == [FELL_BACK]
    np.testing.assert_allclose(env.step(action[0])[4]["epm_pose"], present, atol=1e-6)
    _, state = controller.predict(env._episodes.observe(), state)
    assert state.solver[0] in (CONVERGED, NOT_CONVERGED)


class Asking:
    """Asks for more than there is."""

    name, action, observation, frame = "asking", "wrench", "full", "global"

    def seed(self, seed: int) -> None: ...

    def predict(self, observation: object, *rest: object, **more: object) -> tuple[object, None]:
        return LARGE[None], None


def test_records_of_the_wrench_mode_tell_it() -> None:
    (record,) = run(Asking(), "approach-60", control_hz=20.0, episodes=1)  # type: ignore[arg-type]
    assert record.solver[0] == NOT_CONVERGED
    assert len(record.solver) == len(record.substeps)
