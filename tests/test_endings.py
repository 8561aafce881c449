"""How an episode of the scalar environment ends: with its reference, or by each of the losses."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray
from rollouts import MakeEnv, Step, rollout, still

from magenv import episodes
from magenv.env import TwoRobots
from magenv.params import TaskParams
from magenv.trajectories import Trajectory, draw
from magenv.world import LOSSES

Floats = NDArray[np.float64]


def lead(env: TwoRobots, trajectory: Trajectory) -> None:
    """Put both robots on the reference at the end of the coming hold; the stuck plant keeps them there."""
    world = env._episodes.world
    world.robots[0, :, :3] = trajectory.at((world.step_count[0] + 1) * world.period_s)
    world.robots[0, :, 3:] = 0.0


@pytest.mark.parametrize(
    ("control_hz", "steps"), [(2.0, 200), (10.0, 1000), (3.0, 300), (7.0, 700), (0.3, 30), (0.7, 70), (1.5, 150)]
)
def test_end_of_the_reference_truncates(make_env: MakeEnv, stuck_plant: str, control_hz: float, steps: int) -> None:
    env = make_env(scenario="approach-30", plant=stuck_plant, control_hz=control_hz)
    env.reset(seed=0)
    trajectory = draw("approach-30", np.random.default_rng(0))
    for step in range(1, steps + 1):
        lead(env, trajectory)
        _, _, terminated, truncated, info = env.step(still(env))
        assert not terminated
        assert truncated == (step == steps)
        assert info["time_s"] == pytest.approx(step / control_hz)
        assert ("is_success" in info) == (step == steps)
    assert info["is_success"] is True
    assert LOSSES[info["loss"]] == "none"
    with pytest.raises(ResetNeeded, match=r"call reset\(\)"):
        env.step(still(env))


def test_reference_that_ends_within_a_hold_truncates_at_its_end(
    make_env: MakeEnv, stuck_plant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 0.035 Hz the fourth hold passes the end of the reference."""
    monkeypatch.setattr(episodes, "TaskParams", functools.partial(TaskParams, loss_distance_m=1.0))
    env = make_env(scenario="approach-100", plant=stuck_plant, control_hz=0.035)
    env.reset(seed=0)
    flags = [env.step(still(env))[2:4] for _ in range(3)]
    assert flags == [(False, False)] * 3
    assert env.step(still(env))[2:4] == (False, True)


def test_loss_in_the_last_hold_terminates(make_env: MakeEnv, stuck_plant: str) -> None:
    """Loss goes before the end: never both flags, no success."""
    env = make_env(scenario="approach-30", plant=stuck_plant)
    env.reset(seed=0)
    env._episodes.world.step_count[0] = 199
    _, _, terminated, truncated, info = env.step(still(env))
    assert (terminated, truncated) == (True, False)
    assert info["is_success"] is False


def lost(env: TwoRobots, poses: Floats, step: int = 0) -> dict[str, Any]:
    """Put the robots at ``poses`` (2, 3) at a control instant, step, and return the info of the loss."""
    env.reset(seed=0)
    env._episodes.world.step_count[0] = step
    env._episodes.world.robots[0, :, :3] = poses
    _, _, terminated, truncated, info = env.step(still(env))
    assert terminated
    assert not truncated
    assert info["is_success"] is False
    assert info["substeps"] == 1
    with pytest.raises(ResetNeeded):
        env.step(still(env))
    return info


def test_loss_by_deviation(make_env: MakeEnv, stuck_plant: str) -> None:
    env, reference = make_env(scenario="approach-60", plant=stuck_plant), draw("approach-60", np.random.default_rng(0))
    poses = reference.at(0.0)
    poses[1, 0] += 0.031
    info = lost(env, poses)
    assert LOSSES[info["loss"]] == "deviation"
    assert info["position_error_m"] == pytest.approx(0.0155, abs=1e-4)
    poses[1, 0] -= 0.002
    env.reset(seed=0)
    env._episodes.world.robots[0, :, :3] = poses
    assert not env.step(still(env))[2]


def test_loss_by_touch(make_env: MakeEnv, stuck_plant: str) -> None:
    env, reference = make_env(scenario="approach-20", plant=stuck_plant), draw("approach-20", np.random.default_rng(0))
    poses = reference.at(50.0)
    poses[:, 1] = [-0.00549, 0.00549]
    info = lost(env, poses, 100)
    assert LOSSES[info["loss"]] == "touch"
    assert info["separation_min_m"] == pytest.approx(0.011)
    poses[:, 1] = [-0.00551, 0.00551]
    env.reset(seed=0)
    env._episodes.world.step_count[0] = 100
    env._episodes.world.robots[0, :, :3] = poses
    assert not env.step(still(env))[2]


def test_loss_by_wall(make_env: MakeEnv, stuck_plant: str) -> None:
    env, reference = make_env(scenario="approach-60", plant=stuck_plant), draw("approach-60", np.random.default_rng(0))
    poses = reference.at(0.0)
    poses[0, :2] *= 0.0946 / np.linalg.norm(poses[0, :2])
    info = lost(env, poses)
    assert LOSSES[info["loss"]] == "wall"
    assert np.linalg.norm(info["robots"][0, :2]) == pytest.approx(0.1 - 0.0055)
    poses[0, :2] *= 0.0944 / np.linalg.norm(poses[0, :2])
    env.reset(seed=0)
    env._episodes.world.robots[0, :, :3] = poses
    assert not env.step(still(env))[2]


def test_final_observation_is_of_the_state_at_the_loss(make_env: MakeEnv) -> None:
    """What a learner bootstraps from: finite, in the space, of the last true state."""
    env = make_env(frame="global", scenario="approach-60")
    for seed in range(10):
        for result in rollout(env, seed, seed, 5):
            observation, _, terminated, _, info = result
            if terminated:
                assert observation in env.observation_space
                np.testing.assert_allclose(0.1 * observation[8:10], info["robots"][0, :2], atol=1e-7)


@pytest.fixture
def nan_step(make_env: MakeEnv) -> Step:
    """The step after a robot's position was overwritten with NaN."""
    env = make_env()
    env.reset(seed=0)
    env._episodes.world.robots[0, 1, 0] = np.nan
    return env.step(still(env))


def test_nan_state_is_a_loss(nan_step: Step) -> None:
    _, _, terminated, truncated, info = nan_step
    assert terminated
    assert not truncated
    assert LOSSES[info["loss"]] == "deviation"


def test_nan_state_gives_a_finite_reward(nan_step: Step) -> None:
    assert 0 <= nan_step[1] <= 1


def test_nan_state_gives_an_observation_within_the_space(make_env: MakeEnv, nan_step: Step) -> None:
    assert nan_step[0] in make_env().observation_space
