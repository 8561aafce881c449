"""The adapter to Stable-Baselines3: the scalar environment, many at once, in SB3's words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from agents.sb3_vec import EPISODE_KEYS, TwoRobotsVecEnv
from magenv.episodes import Settings
from magenv.params import PLANTS, Body, Plant
from magenv.task import unpack

Floats = NDArray[np.float64]

WRENCH = Settings(scenario="approach-60", plant="sticky", action="wrench", frame="global", control_hz=0.5)
"""Fifty steps an episode, and a plant and an action with which a law of one line can hold the robots."""


@pytest.fixture
def venv(monkeypatch: pytest.MonkeyPatch) -> Iterator[TwoRobotsVecEnv]:
    """Return four episodes on WRENCH, of seeds 20 to 23."""
    body = Body(drag_linear_nspm=1.0, drag_rotational_nmsprad=5e-4)
    monkeypatch.setitem(PLANTS, "sticky", Plant(body=body))
    made = TwoRobotsVecEnv(4, WRENCH, seed=20)
    yield made
    made.close()


def actions_for(observations: NDArray[np.float32], layout: Any, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return actions (4, 6) that hold the first two rows' robots and push the others' about."""
    pull = np.array([10.0, 10.0, 0.1]) * unpack(observations, layout).error
    actions = np.clip(pull.reshape(len(observations), 6), -1.0, 1.0)
    actions[2:] = rng.uniform(-1.0, 1.0, actions[2:].shape)
    return actions.astype(np.float32)


def test_it_equals_the_scalar_environment_through_resets(venv: TwoRobotsVecEnv, make_env: Any) -> None:
    rng = np.random.default_rng(0)
    scalars = [make_env(**vars(WRENCH)) for _ in range(4)]
    observations = venv.reset()
    for row, env in enumerate(scalars):
        np.testing.assert_array_equal(env.reset(seed=20 + row)[0], observations[row])
    past: list[list[dict[str, Any]]] = [[] for _ in scalars]
    ends: list[tuple[int, bool]] = []
    for _ in range(130):
        actions = actions_for(observations, scalars[0].layout, rng)
        observations, rewards, dones, infos = venv.step(actions)
        for row, env in enumerate(scalars):
            observation, reward, terminated, truncated, info = env.step(actions[row])
            past[row].append(info | {"reward": reward})
            assert rewards[row] == np.float32(reward)
            assert dones[row] == (terminated or truncated)
            if not dones[row]:
                assert infos[row] == {}
            else:
                told = infos[row]
                np.testing.assert_array_equal(told["terminal_observation"], observation)
                assert told["TimeLimit.truncated"] is truncated
                assert told["is_success"] is info["is_success"] is truncated
                for key in EPISODE_KEYS:
                    assert told[key] == pytest.approx(np.mean([step[key] for step in past[row]]), rel=1e-12)
                returned = sum(step["reward"] for step in past[row])
                assert told["episode"]["r"] == pytest.approx(returned, rel=1e-12)
                assert told["episode"]["l"] == len(past[row])
                ends.append((row, truncated))
                past[row] = []
                observation, _ = env.reset()
            np.testing.assert_array_equal(observations[row], observation)
    assert ends.count((0, True)) == ends.count((1, True)) == 2, "nobody came to the end of the reference"
    assert sum(not truncated for _, truncated in ends) > 4, "nobody lost control"


def test_it_speaks_in_the_types_of_stable_baselines(venv: TwoRobotsVecEnv) -> None:
    observations = venv.reset()
    assert observations.dtype == np.float32
    assert observations.shape == (4, *venv.observation_space.shape)  # type: ignore[misc]
    rng = np.random.default_rng(1)
    returned: list[tuple[NDArray[Any], NDArray[Any]]] = [(observations, observations.copy())]
    ended = 0
    for _ in range(20):
        actions = rng.uniform(-1, 1, (4, 6)).astype(np.float32)
        given = actions.copy()
        observations, rewards, dones, infos = venv.step(actions)
        returned += [(array, array.copy()) for array in (observations, rewards, dones)]
        returned += [(info[key], info[key].copy()) for info in infos for key in info if key == "terminal_observation"]
        for array, kept in [*returned, (actions, given)]:
            np.testing.assert_array_equal(array, kept)
        assert (observations.dtype, observations.shape) == (np.float32, (4, *venv.observation_space.shape))  # type: ignore[misc]
        assert (rewards.dtype, rewards.shape) == (np.float32, (4,))
        assert (dones.dtype, dones.shape) == (np.bool_, (4,))
        assert isinstance(infos, list)
        assert all(venv.observation_space.contains(row) for row in observations)
        for done, info in zip(dones, infos, strict=True):
            assert bool(info) == done
            if done:
                ended += 1
                assert venv.observation_space.contains(info["terminal_observation"])
                assert type(info["TimeLimit.truncated"]) is type(info["is_success"]) is bool
                assert {key: type(value) for key, value in info["episode"].items()} == {
                    "r": float,
                    "l": int,
                    "t": float,
                }
                assert all(type(info[key]) is float for key in EPISODE_KEYS)
    assert ended


def test_the_first_reset_begins_at_the_seed_and_later_ones_go_on() -> None:
    one, other = (TwoRobotsVecEnv(3, Settings(), seed=7) for _ in range(2))
    first = one.reset()
    np.testing.assert_array_equal(first, other.reset())
    second = one.reset()
    assert not np.array_equal(second, first)
    np.testing.assert_array_equal(second, other.reset())
    assert not np.array_equal(first, TwoRobotsVecEnv(3, Settings(), seed=8).reset())


def test_seed_counts_at_the_next_reset(venv: TwoRobotsVecEnv) -> None:
    venv.reset()
    assert venv.seed(5) == [5, 6, 7, 8]
    np.testing.assert_array_equal(venv.reset(), TwoRobotsVecEnv(4, WRENCH, seed=5).reset())
    assert not np.array_equal(venv.reset(), TwoRobotsVecEnv(4, WRENCH, seed=5).reset())


def test_a_reset_forgets_the_sums_of_the_episodes_it_ends(venv: TwoRobotsVecEnv) -> None:
    rng = np.random.default_rng(2)
    venv.reset()
    venv.step(np.zeros((4, 6), np.float32))
    venv.reset()
    for step in range(1, 40):
        _, rewards, dones, infos = venv.step(rng.uniform(-1, 1, (4, 6)).astype(np.float32))
        if step == 1:
            firsts = rewards
        if dones.any():
            row = int(np.flatnonzero(dones)[0])
            assert infos[row]["episode"]["l"] == step
            if step == 1:
                assert infos[row]["episode"]["r"] == pytest.approx(firsts[row], rel=1e-6)
            break
    else:
        pytest.fail("no episode ended")


def test_attributes_are_shared_and_cannot_be_set(venv: TwoRobotsVecEnv) -> None:
    assert venv.get_attr("render_mode") == [None] * 4
    assert venv.get_attr("num_envs", [0, 2]) == [4, 4]
    assert venv.env_is_wrapped(VecNormalize) == [False] * 4
    assert venv.env_is_wrapped(VecNormalize, 1) == [False]
    assert not venv.has_attr("nothing")
    with pytest.raises(NotImplementedError, match="share"):
        venv.set_attr("render_mode", "human")
    with pytest.raises(NotImplementedError, match="own"):
        venv.env_method("reset")


@pytest.mark.parametrize("bad", [np.zeros((4, 5), np.float32), np.full((4, 6), np.nan, np.float32)])
def test_a_bad_action_is_refused_and_nothing_moves(venv: TwoRobotsVecEnv, bad: NDArray[np.float32]) -> None:
    venv.reset()
    with pytest.raises(ValueError, match="Input action must be"):
        venv.step(bad)
    other = TwoRobotsVecEnv(4, WRENCH, seed=20)
    other.reset()
    actions = np.full((4, 6), 0.1, np.float32)
    np.testing.assert_array_equal(venv.step(actions)[0], other.step(actions)[0])


def test_ppo_learns_on_it_inside_vec_normalize() -> None:
    env = VecNormalize(TwoRobotsVecEnv(8, Settings(scenario="approach-100"), seed=0), norm_reward=False, clip_obs=5.0)
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=64, n_epochs=2, seed=0, device="cpu")
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(256)
    after = model.policy.state_dict()
    assert all(bool(torch.isfinite(value).all()) for value in after.values())
    assert not any(torch.equal(before[name], after[name]) for name in before if name.endswith("weight"))
    assert model.ep_info_buffer
    assert model.ep_success_buffer
    assert all(set(episode) == {"r", "l", "t"} for episode in model.ep_info_buffer)
    seen = env.obs_rms
    assert not isinstance(seen, dict)
    assert seen.count == pytest.approx(256 + 8, abs=1)  # every observation once, and the first ones
    env.close()
