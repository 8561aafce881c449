"""The scalar environment: contract, copies, aliasing, commands."""

from __future__ import annotations

import copy
import dataclasses
import json
import pickle
from collections.abc import Callable
from typing import Any, get_args

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray
from rollouts import MODES, MakeEnv, assert_same_bits, assert_same_rollouts, rollout, still
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import magenv
from magenv.actions import PLANAR, ActionMode
from magenv.env import TwoRobots
from magenv.params import PLANTS, plant_named
from magenv.task import Frame, ObservationMode

# Contract


@pytest.mark.parametrize("observation", get_args(ObservationMode))
@pytest.mark.parametrize("frame", get_args(Frame))
@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("mode", MODES)
def test_checkers_find_nothing(
    make_env: MakeEnv, mode: ActionMode, n_epm: int, frame: Frame, observation: ObservationMode
) -> None:
    """Gymnasium's and SB3's, every warning an error."""
    env = make_env(action=mode, n_epm=n_epm, frame=frame, observation=observation)
    check_env(env, skip_render_check=True)
    check_env_sb3(env, warn=True, skip_render_check=True)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_of_a_drawn_env_goes_on_as_the_original(make_env: MakeEnv, copied: Callable[[Any], Any]) -> None:
    env = make_env(render_mode="rgb_array")
    env.reset(seed=3)
    before = env.render()
    other = copied(env)
    action = np.full(10, 0.1, np.float32)
    np.testing.assert_array_equal(other.step(action)[0], env.step(action)[0])
    assert before is not None
    assert other.render().shape == before.shape
    other.close()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_shares_nothing_and_goes_on_alike(make_env: MakeEnv, copied: Callable[[Any], Any]) -> None:
    """Through ends and new beginnings: what the kernels are given is the copy's own state, all of it."""
    env = make_env(control_hz=20.0)
    env.reset(seed=3)
    env.step(still(env))
    other = copied(env)
    ended = 0
    for result in rollout(env, None, 5):
        ended += result[2]
    assert ended > 0
    rest = rollout(other, None, 5)
    for one, two in zip(rollout(copied(other), None, 5), rest, strict=True):
        for x, y in zip(one, two, strict=True):
            assert_same_bits(x, y)
    np.testing.assert_array_equal(other._episodes.world.measurements.loss, other._episodes.world.measurements.counts[1])


def test_spec_goes_through_json_and_pickle() -> None:
    env = gymnasium.make(magenv.ENV_ID, scenario="approach-30", n_epm=3, action="step", control_hz=4.0)
    assert env.spec is not None
    text = env.spec.to_json()
    assert json.loads(text)["kwargs"] == {
        "scenario": "approach-30",
        "n_epm": 3,
        "action": "step",
        "control_hz": 4.0,
    }
    for spec in (EnvSpec.from_json(text), pickle.loads(pickle.dumps(env.spec))):
        twin = gymnasium.make(spec)
        assert twin.action_space == env.action_space
        assert twin.observation_space == env.observation_space
        assert_same_bits(twin.reset(seed=3)[0], env.reset(seed=3)[0])
        twin.close()
    env.close()


def test_env_is_made_by_module_and_id() -> None:
    env = gymnasium.make("magenv:magenv/TwoRobots-v0", scenario="approach-30", plant="paper", n_epm=2)
    assert isinstance(env.unwrapped, TwoRobots)
    env.close()


def test_spaces(make_env: MakeEnv) -> None:
    for n_epm in (2, 3):
        for mode in MODES:
            env = make_env(n_epm=n_epm, action=mode)
            size = 6 if mode in PLANAR else 5 * n_epm
            assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32)
            assert env.observation_space.dtype == np.float32
            assert env.observation_space.is_bounded()
    assert make_env(observation="errors").observation_space.shape == (8,)


def test_default_action_mode_is_home(make_env: MakeEnv) -> None:
    a, b = make_env(), make_env(action="home")
    assert_same_rollouts(rollout(a, 0, 0), rollout(b, 0, 0))


def test_step_before_reset_is_told(make_env: MakeEnv) -> None:
    env = make_env()
    with pytest.raises(ResetNeeded, match=r"call reset\(\)"):
        env.step(still(env))


# Aliasing


@pytest.mark.parametrize("observation", get_args(ObservationMode))
def test_what_was_returned_does_not_change_later(make_env: MakeEnv, observation: ObservationMode) -> None:
    env = make_env(observation=observation, control_hz=20.0)
    kept, copies = [], []

    def keep(values: NDArray[np.float32], info: dict[str, Any]) -> None:
        arrays = [values, *(v for v in info.values() if isinstance(v, np.ndarray))]
        kept.extend(arrays)
        copies.extend(v.copy() for v in arrays)

    keep(*env.reset(seed=0))
    for k in range(8):
        action = np.full(10, (-1) ** k, np.float32)
        values, _, terminated, truncated, info = env.step(action)
        np.testing.assert_array_equal(action, (-1) ** k)
        keep(values, info)
        if terminated or truncated:
            keep(*env.reset())
    for value, copied in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(value, copied)
    assert not any(np.shares_memory(a, b) for i, a in enumerate(kept) for b in kept[:i])


def test_caller_cannot_reach_into_the_env(make_env: MakeEnv) -> None:
    """Overwriting what was returned changes nothing."""
    spoiled, clean = make_env(control_hz=20.0), make_env(control_hz=20.0)
    for result, other in zip(rollout(spoiled, 0, 0), rollout(clean, 0, 0), strict=True):
        assert_same_bits(result[0], other[0])
        result[0][:] = 9.0
        for value in result[4].values():
            if isinstance(value, np.ndarray):
                value[:] = 9.0


# Commands


def test_render_before_reset_is_told() -> None:
    env = gymnasium.make(magenv.ENV_ID, render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match=r"call reset\(\)"):
        env.render()


@pytest.mark.parametrize("mode", MODES)
def test_actions_beyond_the_box_are_clipped(make_env: MakeEnv, mode: ActionMode) -> None:
    results = []
    for size in (1.0, 1e9):
        env = make_env(action=mode, control_hz=20.0)
        env.reset(seed=2)
        signs = np.resize([1.0, -1.0, 1.0], env.action_space.shape or ())
        results.append(env.step((size * signs).astype(np.float32)))
    for one, other in zip(*results, strict=True):
        assert_same_bits(one, other)


def test_epms_move_at_once_and_are_held(make_env: MakeEnv) -> None:
    """The paper's plant: the pose told after a step is the one commanded."""
    env = make_env(action="pose", control_hz=20.0)
    env.reset(seed=0)
    action = np.array([0.1, 0.2, -0.3, 0.4, 0.5, -0.8, -0.3, 0.1, 0.0, 0.2], np.float32)
    info = env.step(action)[4]
    middle = np.tile([0.0, 0.0, 0.325, 0.0, 0.0], 2)
    reach = np.tile([np.pi, np.pi / 2, 0.175, np.pi, np.pi / 2], 2)
    assert not info["projected"]
    np.testing.assert_allclose(info["epm_pose"], middle + reach * action.astype(float), atol=1e-9)


def test_info_says_where_the_gap_made_the_command_differ(make_env: MakeEnv) -> None:
    env = make_env(action="pose", control_hz=20.0)
    env.reset(seed=0)
    info = env.step(still(env))[4]  # both EPMs commanded to one place
    assert info["projected"] is True


def test_every_registered_plant_runs(make_env: MakeEnv) -> None:
    for plant in PLANTS:
        env = make_env(plant=plant)
        env.reset(seed=0)
        env.step(still(env))


def test_plant_with_changed_parameters(make_env: MakeEnv) -> None:
    """Told behind a colon; nothing else differs from the plant of that name."""
    changed = plant_named("arm:latency_s=0.05,disturbance_n=1e-3")
    assert changed == dataclasses.replace(PLANTS["arm"], latency_s=0.05, disturbance_n=1e-3)
    assert plant_named("arm") is PLANTS["arm"]
    for value in ("true", "false"):
        assert plant_named(f"arm:epm_cylinders={value}").epm_cylinders == (value == "true")
    env = make_env(plant="paper:epm_speed_mps=1,epm_turn_radps=3.141592653589793")
    twin = make_env(plant="moving")
    env.reset(seed=0)
    twin.reset(seed=0)
    action = np.full_like(still(env), 0.1)
    np.testing.assert_array_equal(env.step(action)[0], twin.step(action)[0])
