"""The batched environment: the scalar one, bit for bit, in all three autoreset modes."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any, get_args

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from numpy.typing import NDArray

import magenv
from magenv import episodes, trajectories
from magenv.actions import ActionMode
from magenv.env import TwoRobots
from magenv.params import TaskParams
from magenv.trajectories import draw
from magenv.vector_env import TwoRobotsVector
from magenv.world import LOSSES

MakeEnv = Callable[..., TwoRobots]
Arrays = dict[str, Any]
Record = tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], Arrays]

MODES: tuple[ActionMode, ...] = get_args(ActionMode)
AUTORESETS = list(AutoresetMode)
N = 4


def vector(n: int = N, autoreset: AutoresetMode = AutoresetMode.NEXT_STEP, **arguments: Any) -> TwoRobotsVector:
    env = gymnasium.make_vec(
        magenv.ENV_ID,
        num_envs=n,
        vectorization_mode="vector_entry_point",
        autoreset_mode=autoreset,
        **arguments,
    )
    assert isinstance(env.unwrapped, TwoRobotsVector)
    return env.unwrapped


def scalars(autoreset: AutoresetMode, **arguments: Any) -> SyncVectorEnv:
    """Gymnasium's loop over scalar environments: says what a vector environment must give."""
    return SyncVectorEnv([functools.partial(TwoRobots, **arguments)] * N, autoreset_mode=autoreset)


def record(env: VectorEnv[Any, Any, Any], steps: int, action_seed: int = 0, seed: int | None = 10) -> Iterator[Record]:
    """Seeded reset, then random actions; in ``Disabled`` mode ended episodes are reset by mask."""
    rng, n = np.random.default_rng(action_seed), env.num_envs
    observations, info = env.reset(seed=seed)
    none = np.zeros(n)
    yield observations, none, none > 0, none > 0, info
    for _ in range(steps):
        actions = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        result = env.step(actions)
        yield result
        ended = result[2] | result[3]
        if env.metadata["autoreset_mode"] == AutoresetMode.DISABLED and ended.any():
            observations, info = env.reset(options={"reset_mask": ended.copy()})
            yield observations, none, none > 0, none > 0, info


def assert_same_bits(a: NDArray[Any], b: NDArray[Any]) -> None:
    one, two = np.asarray(a), np.asarray(b)
    assert one.dtype == two.dtype
    assert one.shape == two.shape
    assert one.tobytes() == two.tobytes()


def told(info: Arrays, row: int) -> Arrays:
    """Return what an info says about one episode, by Gymnasium's masks."""
    found: Arrays = {}
    for name, value in info.items():
        if name.startswith("_") or not info[f"_{name}"][row]:
            continue
        found[name] = told(value, row) if isinstance(value, dict) else value[row]
    return found


def assert_same_info(a: Arrays, b: Arrays) -> None:
    assert a.keys() == b.keys()
    for name, value in a.items():
        if isinstance(value, dict):
            assert_same_info(value, b[name])
        else:
            one, two = np.asarray(value), np.asarray(b[name])
            assert one.dtype.kind == two.dtype.kind, name
            assert one.tobytes() == two.tobytes(), name


@pytest.fixture
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """References of 1 s and no loss by deviation: both endings come often, by contact and by time."""
    monkeypatch.setattr(trajectories, "DURATION_S", 1.0)
    monkeypatch.setattr(trajectories, "_RANDOM_TURN_MAX_RADPS", 10.0)
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
            assert_same_info(told(one[4], row), told(two[4], row))
        endings += one[2].sum(), one[3].sum()
    assert endings.sum() > 2 * N
    assert endings.min() > 0
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


# Autoreset


def end_row(env: TwoRobotsVector, row: int) -> Record:
    """Step with one row's robots put beyond the loss distance."""
    env._episodes.world.robots[row, 0, :2] += 0.035 * np.array([1.0, 0.0])
    return env.step(np.zeros(env.action_space.shape or (), np.float32))


def test_next_step_delivers_the_end_and_begins_anew_at_the_next() -> None:
    env = vector(autoreset=AutoresetMode.NEXT_STEP, scenario="approach-60", control_hz=20.0)
    env.reset(seed=0)
    observations, _, terminated, _, info = end_row(env, 2)
    assert terminated.tolist() == [False, False, True, False]
    assert info["is_success"][2] == np.False_
    assert info["_is_success"].tolist() == terminated.tolist()
    np.testing.assert_allclose(np.delete(info["time_s"], 2), 0.05)
    np.testing.assert_allclose(info["time_s"][2], info["substeps"][2] * 0.005)
    last = observations[2].copy()
    observations, rewards, terminated, truncated, info = env.step(np.zeros((N, 10), np.float32))
    assert rewards[2] == 0.0
    assert not terminated[2]
    assert not truncated[2]
    assert info["time_s"].tolist() == [0.1, 0.1, 0.0, 0.1]
    assert not info["_loss"][2]
    assert not np.array_equal(observations[2], last)


def test_action_of_a_resetting_row_is_ignored() -> None:
    a, b = (vector(autoreset=AutoresetMode.NEXT_STEP) for _ in range(2))
    results = []
    for env, value in ((a, -1.0), (b, 1.0)):
        env.reset(seed=0)
        end_row(env, 1)
        actions = np.zeros((N, 10), np.float32)
        actions[1] = value
        results.append(env.step(actions))
    for one, two in zip(results[0][:4], results[1][:4], strict=True):
        assert_same_bits(one, two)


def test_same_step_delivers_the_end_beside_the_new_beginning() -> None:
    same = vector(autoreset=AutoresetMode.SAME_STEP, scenario="approach-60", control_hz=20.0)
    later = vector(autoreset=AutoresetMode.NEXT_STEP, scenario="approach-60", control_hz=20.0)
    same.reset(seed=0)
    later.reset(seed=0)
    observations, _, terminated, _, info = end_row(same, 2)
    last, _, _, _, last_info = end_row(later, 2)
    begun, _, _, _, begun_info = later.step(np.zeros((N, 10), np.float32))
    assert terminated.tolist() == [False, False, True, False]
    assert info["_final_obs"].tolist() == info["_final_info"].tolist() == terminated.tolist()
    assert info["final_obs"][0] is None
    assert_same_bits(info["final_obs"][2], last[2])
    assert_same_bits(observations[2], begun[2])
    assert_same_bits(observations[0], last[0])
    final = told(info, 2)["final_info"]
    assert final["is_success"] == np.False_
    assert_same_info(final, told(last_info, 2))
    np.testing.assert_array_equal(info["robots"][2], begun_info["robots"][2])


def test_disabled_mode_waits_for_the_mask() -> None:
    env = vector(autoreset=AutoresetMode.DISABLED, scenario="approach-60", control_hz=20.0)
    env.reset(seed=0)
    observations, _, terminated, _, _ = end_row(env, 2)
    with pytest.raises(RuntimeError, match=r"\[2\] have ended"):
        env.step(np.zeros((N, 10), np.float32))
    again, info = env.reset(options={"reset_mask": terminated})
    keep = [0, 1, 3]
    assert_same_bits(again[keep], observations[keep])
    assert not np.array_equal(again[2], observations[2])
    assert info["_robots"].tolist() == terminated.tolist()
    assert env.step(np.zeros((N, 10), np.float32))[4]["time_s"].tolist() == [0.1, 0.1, 0.05, 0.1]


def test_masked_reset_seeds_its_rows_alone(make_env: MakeEnv) -> None:
    env, single = vector(3, AutoresetMode.DISABLED), make_env()
    before, _ = env.reset(seed=0)
    after, _ = env.reset(seed=[9, 9, 9], options={"reset_mask": np.array([False, True, False])})
    assert_same_bits(after[1], single.reset(seed=9)[0])
    assert_same_bits(after[[0, 2]], before[[0, 2]])
    fresh = vector(3)
    fresh.reset(seed=0)
    assert_same_bits(env.reset()[0][[0, 2]], fresh.reset()[0][[0, 2]])  # their streams went on untouched


def test_autoreset_mode_is_told() -> None:
    for mode in AUTORESETS:
        assert vector(autoreset=mode).metadata["autoreset_mode"] == mode
    assert TwoRobotsVector(2, autoreset_mode="SameStep").metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert "autoreset_mode" not in TwoRobotsVector.metadata


@pytest.mark.parametrize("control_hz", [2.0, 10.0, 3.0])
def test_end_of_the_reference_truncates_every_row(stuck_plant: str, control_hz: float) -> None:
    env = vector(2, AutoresetMode.SAME_STEP, scenario="approach-30", plant=stuck_plant, control_hz=control_hz)
    env.reset(seed=0)
    world, trajectory = env._episodes.world, draw("approach-30", np.random.default_rng(0))
    for step in range(1, round(100 * control_hz) + 1):
        world.robots[:, :, :3] = trajectory.at(step / control_hz)
        _, _, terminated, truncated, info = env.step(np.zeros((2, 10), np.float32))
        assert not terminated.any()
        assert truncated.all() == truncated.any() == (step == round(100 * control_hz))
    assert info["final_info"]["is_success"].all()
    np.testing.assert_allclose(info["final_info"]["time_s"], 100.0)
    np.testing.assert_array_equal(info["time_s"], 0.0)


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
            assert_same_info(told(a[4], row), told(b[4], row))
        if step == 0:
            assert a[2][1]
            assert not a[3][1]
            info = told(a[4], 1).get("final_info") or told(a[4], 1)
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
    with pytest.raises(RuntimeError, match=r"call reset\(\)"):
        vector(2).step(np.zeros((2, 10), np.float32))
