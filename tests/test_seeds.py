"""Seeds of the scalar environment: the same seed the same bits, and the episodes that seeds begin."""

from __future__ import annotations

import numpy as np
import pytest
from rollouts import MODES, MakeEnv, assert_same_rollouts, rollout

from magenv.actions import ActionMode

SEEDS = [0, 1, 2**32 - 1]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", SEEDS)
def test_same_seed_same_bits(make_env: MakeEnv, seed: int, mode: ActionMode) -> None:
    a, b = (make_env(action=mode) for _ in range(2))
    assert_same_rollouts(rollout(a, seed, 7), rollout(b, seed, 7))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("n_epm", [2, 3])
def test_reset_env_is_a_fresh_env(make_env: MakeEnv, n_epm: int, mode: ActionMode) -> None:
    """Nothing of a random history is left after a seeded reset."""
    used, fresh = (make_env(action=mode, n_epm=n_epm) for _ in range(2))
    for _ in rollout(used, 11, 3):
        pass
    assert_same_rollouts(rollout(used, 5, 8), rollout(fresh, 5, 8))


def test_reset_in_the_middle_of_an_episode_forgets_it(make_env: MakeEnv) -> None:
    used, fresh = make_env(control_hz=50.0), make_env(control_hz=50.0)
    used.reset(seed=1)
    used.step(np.ones(10, np.float32))
    used.reset(seed=2)
    used.step(-np.ones(10, np.float32))
    assert_same_rollouts(rollout(used, 5, 8), rollout(fresh, 5, 8))


def test_seeds_give_streams_of_their_own(make_env: MakeEnv) -> None:
    """Neighbouring seeds share no episode, neither their first nor any later one."""
    env, starts = make_env(), []
    for seed in (0, 1, 2, 2**32 - 2, 2**32 - 1):
        starts += [env.reset(seed=seed)[1]["robots"]] + [env.reset()[1]["robots"] for _ in range(5)]
    flat = np.array(starts).reshape(len(starts), -1)[:, [0, 1, 2, 6, 7, 8]]
    apart = np.abs(flat[:, None] - flat[None]).max(axis=-1)
    assert apart[np.triu_indices(len(flat), 1)].min() > 1e-6


# Starts


def test_episode_is_fixed_by_scenario_plant_and_seed(make_env: MakeEnv) -> None:
    """Neither action mode, number of EPMs, frame nor control rate, nor what the controller does, changes a start."""
    for scenario in ("random", "approach-30"):
        rng, expected = np.random.default_rng(0), None
        for arguments in (
            {},
            {"action": "step"},
            {"action": "wrench", "n_epm": 3},
            {"frame": "global", "observation": "errors"},
            {"control_hz": 10.0},
        ):
            env = make_env(scenario=scenario, **arguments)
            infos = [env.reset(seed=9)[1]]
            env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
            infos.append(env.reset()[1])
            starts = np.array([[info["robots"][:, :3], info["reference"]] for info in infos])
            expected = starts if expected is None else expected
            np.testing.assert_array_equal(starts, expected)


def test_start_has_the_designs_spread(make_env: MakeEnv) -> None:
    """1 mm and 3 degrees standard deviation, at rest, EPMs at home, whatever the action mode."""
    offsets = []
    for mode in MODES:
        env = make_env(scenario="approach-60", action=mode)
        for seed in range(150):
            info = env.reset(seed=seed)[1]
            offsets.append(info["robots"][:, :3] - info["reference"])
            np.testing.assert_array_equal(info["robots"][:, 3:], 0.0)
            np.testing.assert_allclose(info["epm_pose"][[2, 7]], 0.2)
            assert info["time_s"] == 0.0
    spread = np.array(offsets[:150])
    np.testing.assert_allclose(spread[..., :2].std(), 1e-3, rtol=0.1)
    np.testing.assert_allclose(spread[..., 2].std(), np.radians(3), rtol=0.15)
    assert np.abs(spread[..., :2].mean(axis=(0, 1))).max() < 2.5e-4
    assert abs(spread[..., 2].mean()) < np.radians(0.7)


def test_random_scenario_draws_a_new_reference_each_episode(make_env: MakeEnv) -> None:
    env = make_env(scenario="random")
    starts = [env.reset(seed=4 if k == 0 else None)[1]["reference"] for k in range(4)]
    assert all(not np.allclose(starts[i], starts[j]) for i in range(4) for j in range(i))
