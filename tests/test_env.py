"""The scalar environment: contract, determinism, endings, losses, aliasing."""

from __future__ import annotations

import copy
import functools
import json
import pickle
from collections.abc import Callable, Iterator
from typing import Any, get_args

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import magenv
from magenv import episodes
from magenv.actions import ActionMode
from magenv.env import TwoRobots
from magenv.params import PLANTS, TaskParams
from magenv.task import Frame, ObservationMode
from magenv.trajectories import Trajectory, draw
from magenv.world import LOSSES

Floats = NDArray[np.float64]
MakeEnv = Callable[..., TwoRobots]
Step = tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]

MODES: tuple[ActionMode, ...] = get_args(ActionMode)
SEEDS = [0, 1, 2**32 - 1]


def still(env: TwoRobots) -> NDArray[np.float32]:
    return np.zeros(env.action_space.shape or (), np.float32)


def rollout(env: TwoRobots, seed: int | None, action_seed: int, steps: int = 40) -> Iterator[Step]:
    """Random actions, episode after episode; the first begins with ``seed``, the others go on."""
    rng = np.random.default_rng(action_seed)
    observation, info = env.reset(seed=seed)
    yield observation, 0.0, False, False, info
    for _ in range(steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        result: Step = env.step(action)
        yield result
        if result[2] or result[3]:
            observation, info = env.reset()
            yield observation, 0.0, False, False, info


def assert_same_bits(a: object, b: object) -> None:
    if isinstance(a, dict):
        assert isinstance(b, dict)
        assert a.keys() == b.keys()
        for key in a:
            assert_same_bits(a[key], b[key])
    else:
        one, two = np.asarray(a), np.asarray(b)
        assert one.dtype == two.dtype
        assert one.shape == two.shape
        assert one.tobytes() == two.tobytes()


def assert_same_rollouts(a: Iterator[Step], b: Iterator[Step]) -> None:
    for one, two in zip(a, b, strict=True):
        for x, y in zip(one, two, strict=True):
            assert_same_bits(x, y)


def lead(env: TwoRobots, trajectory: Trajectory) -> None:
    """Put both robots on the reference at the end of the coming hold; the stuck plant keeps them there."""
    world = env._episodes.world
    world.robots[0, :, :3] = trajectory.at((world.step_count[0] + 1) * world.period_s)
    world.robots[0, :, 3:] = 0.0


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
            size = 6 if mode == "wrench" else 5 * n_epm
            assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32)
            assert env.observation_space.dtype == np.float32
            assert env.observation_space.is_bounded()
    assert make_env(observation="errors").observation_space.shape == (8,)


def test_default_action_mode_is_home(make_env: MakeEnv) -> None:
    a, b = make_env(), make_env(action="home")
    assert_same_rollouts(rollout(a, 0, 0), rollout(b, 0, 0))


# Determinism


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


# Endings


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
    with pytest.raises(RuntimeError, match=r"call reset\(\)"):
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
    with pytest.raises(RuntimeError):
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


def test_step_before_reset_is_told(make_env: MakeEnv) -> None:
    env = make_env()
    with pytest.raises(RuntimeError, match=r"call reset\(\)"):
        env.step(still(env))


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
