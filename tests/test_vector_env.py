"""The batched environment: the scalar one, bit for bit; no row reaches into another."""

from __future__ import annotations

import functools
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from numpy.typing import NDArray
from rollouts import AUTORESETS, MODES, MakeEnv, N, assert_same_bits, assert_same_info, info_of, record, vector

import magenv
from magenv import episodes, trajectories
from magenv.actions import ActionMode
from magenv.env import TwoRobots
from magenv.params import TaskParams
from magenv.world import LOSSES


def scalars(autoreset: AutoresetMode, **arguments: Any) -> SyncVectorEnv:
    """Gymnasium's loop over scalar environments: says what a vector environment must give."""
    return SyncVectorEnv([functools.partial(TwoRobots, **arguments)] * N, autoreset_mode=autoreset)


@pytest.fixture
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """References of 1 s and no loss by deviation: both endings come often, by contact and by time."""
    monkeypatch.setattr(trajectories, "DURATION_S", 1.0)
    monkeypatch.setattr(trajectories, "RANDOM_TURN_MAX_RADPS", 10.0)
    monkeypatch.setattr(episodes, "TaskParams", functools.partial(TaskParams, loss_distance_m=1.0))


@pytest.mark.parametrize("control_hz", [2.0, 10.0])
@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("autoreset", AUTORESETS)
@pytest.mark.usefixtures("short_episodes")
def test_batch_is_the_scalar_env_bit_for_bit(
    autoreset: AutoresetMode, mode: ActionMode, n_epm: int, control_hz: float
) -> None:
    """Observations, rewards, flags and infos, final ones included, through several episodes."""
    arguments = {"action": mode, "n_epm": n_epm, "control_hz": control_hz}
    ours, theirs = vector(autoreset=autoreset, **arguments), scalars(autoreset, **arguments)
    steps = 30 if control_hz == 2.0 else 80
    endings = np.zeros(2)
    for one, two in zip(record(ours, steps), record(theirs, steps), strict=True):
        for a, b in zip(one[:4], two[:4], strict=True):
            assert_same_bits(a, b)
        for row in range(N):
            assert_same_info(info_of(one[4], row), info_of(two[4], row))
        endings += one[2].sum(), one[3].sum()
    assert endings.sum() > 2 * N
    assert mode == "velocity" or endings.min() > 0  # robots that go where they are sent touch nothing in a second
    theirs.close()


@pytest.mark.parametrize("autoreset", AUTORESETS)
@pytest.mark.parametrize("frame", ["robots", "global"])
@pytest.mark.parametrize("observation", ["full", "errors"])
def test_batch_is_the_scalar_env_in_every_observation(autoreset: AutoresetMode, frame: str, observation: str) -> None:
    arguments = {"frame": frame, "observation": observation, "scenario": "approach-30"}
    for one, two in zip(
        record(vector(autoreset=autoreset, **arguments), 20), record(scalars(autoreset, **arguments), 20), strict=True
    ):
        for a, b in zip(one[:4], two[:4], strict=True):
            assert_same_bits(a, b)


def test_row_behaves_as_a_scalar_env_with_its_seed(make_env: MakeEnv) -> None:
    """Against single environments by hand: row i has seed + i, and goes on without seeds after its end."""
    env = vector(3, control_hz=4.0)
    observations, _ = env.reset(seed=5)
    singles = [make_env(control_hz=4.0) for _ in range(3)]
    for row, single in enumerate(singles):
        assert_same_bits(single.reset(seed=5 + row)[0], observations[row])
    rng, ended = np.random.default_rng(1), [False] * 3
    for _ in range(40):
        actions = rng.uniform(-1, 1, (3, 10)).astype(np.float32)
        observations, rewards, terminated, truncated, _ = env.step(actions)
        for row, single in enumerate(singles):
            if ended[row]:
                expected: Any = (single.reset()[0], 0.0, False, False)
            else:
                expected = single.step(actions[row])[:4]
            got = (observations[row], rewards[row], terminated[row], truncated[row])
            assert_same_bits(got[0], expected[0])
            assert got[1:] == expected[1:]
            ended[row] = bool(expected[2] or expected[3])


def test_rows_do_not_depend_on_their_neighbours() -> None:
    """The same seed in another row of another batch gives the same bits."""
    few, many = vector(1), vector(7)
    a, _ = few.reset(seed=[42])
    b, _ = many.reset(seed=[1, 2, 3, 4, 42, 5, 6])
    rng = np.random.default_rng(0)
    for _ in range(30):
        assert_same_bits(a[0], b[4])
        actions = rng.uniform(-1, 1, (7, 10)).astype(np.float32)
        a, b = few.step(actions[4:5])[0], many.step(actions)[0]


@pytest.mark.parametrize("seed", [0, 1, 2**32 - 1])
def test_same_seed_same_bits_whatever_came_before(seed: int) -> None:
    used, fresh = vector(), vector()
    for _ in record(used, 15, 3, 77):
        pass
    for one, two in zip(record(used, 15, 4, seed), record(fresh, 15, 4, seed), strict=True):
        for a, b in zip(one[:4], two[:4], strict=True):
            assert_same_bits(a, b)


def test_reset_without_seed_goes_on_with_each_rows_stream(make_env: MakeEnv) -> None:
    env, single = vector(2), make_env()
    env.reset(seed=[3, 4])
    single.reset(seed=4)
    assert_same_bits(env.reset()[0][1], single.reset()[0])
    single.reset(seed=8)
    observations, _ = env.reset(seed=[None, 8])
    single.reset(seed=8)
    assert_same_bits(env.reset()[0][1], single.reset()[0])
    assert not np.array_equal(observations[0], observations[1])


def test_seed_may_be_a_numpy_integer() -> None:
    a, b = vector(2), vector(2)
    assert_same_bits(a.reset(seed=np.int64(6))[0], b.reset(seed=6)[0])  # type: ignore[arg-type]


def test_unseeded_batches_differ() -> None:
    a, b = vector(2).reset()[0], vector(2).reset()[0]
    assert not np.array_equal(a, b)
    assert not np.array_equal(a[0], a[1])


# Isolation and aliasing


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("autoreset", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_nan_in_one_row_ends_that_row_alone(autoreset: AutoresetMode, mode: ActionMode) -> None:
    """The poisoned row is lost; its neighbours keep their bits, then and in all steps that follow."""
    sick, well = (vector(autoreset=autoreset, action=mode, scenario="approach-60", control_hz=20.0) for _ in range(2))
    sick.reset(seed=0)
    well.reset(seed=0)
    sick._episodes.world.robots[1, 0, 3] = np.nan
    others, rng = [0, 2, 3], np.random.default_rng(0)
    for step in range(6):
        actions = rng.uniform(-0.2, 0.2, sick.action_space.shape).astype(np.float32)
        a, b = sick.step(actions), well.step(actions)
        for one, two in zip(a[:4], b[:4], strict=True):
            assert_same_bits(one[others], two[others])
        for row in others:
            assert_same_info(info_of(a[4], row), info_of(b[4], row))
        if step == 0:
            assert a[2][1]
            assert not a[3][1]
            info = info_of(a[4], 1).get("final_info") or info_of(a[4], 1)
            assert LOSSES[info["loss"]] == "deviation"
            assert not info["is_success"]
        else:
            assert np.isfinite(a[0]).all()
            assert np.isfinite(a[1]).all()


def test_nan_in_one_row_gives_finite_reward_and_observation() -> None:
    env = vector(autoreset=AutoresetMode.NEXT_STEP)
    env.reset(seed=0)
    env._episodes.world.robots[1] = np.nan
    observations, rewards, terminated, _, _ = env.step(np.zeros((N, 10), np.float32))
    assert terminated[1]
    assert np.isfinite(rewards).all()
    assert observations in env.observation_space


@pytest.mark.parametrize("autoreset", AUTORESETS)
def test_what_was_returned_does_not_change_later(autoreset: AutoresetMode) -> None:
    env = vector(autoreset=autoreset)
    kept: list[NDArray[Any]] = []
    copies: list[NDArray[Any]] = []
    for observations, rewards, terminated, truncated, info in record(env, 12):
        final = info.get("final_info", {})
        arrays = [observations, rewards, terminated, truncated, *info.values(), *final.values()]
        numeric = [v for v in arrays if isinstance(v, np.ndarray) and v.dtype != object]
        kept += numeric
        copies += [v.copy() for v in numeric]
    for value, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(value, copy)


def test_info_holds_no_views_of_the_plant() -> None:
    spoiled, clean = vector(), vector()
    for one, two in zip(record(spoiled, 12), record(clean, 12), strict=True):
        for a, b in zip(one[:4], two[:4], strict=True):
            assert_same_bits(a, b)
        for value in [*one[:4], *one[4].values()]:
            if isinstance(value, np.ndarray) and value.dtype != object:
                value[:] = 0


# Beside others


def test_batch_spaces() -> None:
    env = vector(5, n_epm=3)
    assert env.observation_space.shape == (5, 70)
    assert env.action_space.shape == (5, 15)
    assert env.single_action_space == gymnasium.make(magenv.ENV_ID, n_epm=3).action_space
    observations, _ = env.reset(seed=0)
    assert observations in env.observation_space
    assert env.step(env.action_space.sample())[0] in env.observation_space


def test_gymnasiums_vector_wrappers_go_round_it() -> None:
    env = RecordEpisodeStatistics(vector(autoreset=AutoresetMode.NEXT_STEP))
    env.action_space.seed(0)
    env.reset(seed=0)
    ends = 0
    for _ in range(30):
        info = env.step(env.action_space.sample())[4]
        ends += int(np.sum(info.get("_episode", 0)))
    assert ends > 0
    env.close()


def test_no_episode_before_reset() -> None:
    with pytest.raises(ResetNeeded, match=r"call reset\(\)"):
        vector(2).step(np.zeros((2, 10), np.float32))
