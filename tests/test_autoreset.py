"""How a batch delivers the end of an episode and begins anew, in all three autoreset modes."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from rollouts import AUTORESETS, MakeEnv, N, Record, assert_same_bits, assert_same_info, info_of, vector

from magenv.steps import begin_episodes
from magenv.trajectories import draw, shaped
from magenv.vector_env import TwoRobotsVector


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
    final = info_of(info, 2)["final_info"]
    assert final["is_success"] == np.False_
    assert_same_info(final, info_of(last_info, 2))
    np.testing.assert_array_equal(info["robots"][2], begun_info["robots"][2])


def test_disabled_mode_waits_for_the_mask() -> None:
    env = vector(autoreset=AutoresetMode.DISABLED, scenario="approach-60", control_hz=20.0)
    env.reset(seed=0)
    observations, _, terminated, _, _ = end_row(env, 2)
    with pytest.raises(ResetNeeded, match=r"\[2\] have ended"):
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


def test_rows_out_of_step_are_told_the_references_of_their_own_times() -> None:
    env = vector(autoreset=AutoresetMode.DISABLED, scenario="approach-60", control_hz=10.0)
    env.reset(seed=0)
    still = np.zeros((N, 10), np.float32)
    env.step(still)
    env.reset(options={"reset_mask": np.arange(N) == 1})
    _, _, _, _, info = env.step(still)
    assert info["time_s"][0] > info["time_s"][1]
    for time, reference in zip(info["time_s"], info["reference"], strict=True):
        np.testing.assert_allclose(reference, shaped("approach", 0.060).at(time), rtol=0, atol=1e-15)


def test_a_mask_need_not_lie_in_one_piece() -> None:
    env = vector(autoreset=AutoresetMode.DISABLED, scenario="approach-60")
    env.reset(seed=0)
    signatures = len(begin_episodes.signatures)
    strided = np.ones(2 * N, np.bool_)[::2]
    strided.flags.writeable = False
    env.reset(options={"reset_mask": strided})
    assert len(begin_episodes.signatures) == signatures, "compiled anew"
