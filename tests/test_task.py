"""What an agent is told and paid: packing, unpacking, frames, bounds, reward terms."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from magenv.actions import ActionMode
from magenv.env import TwoRobots
from magenv.episodes import Episodes, Settings
from magenv.task import HEADING_SCALES_RAD, POSITION_SCALES_M, Frame, ObservationMode, reward_terms, unpack
from magenv.trajectories import draw

Floats = NDArray[np.float64]
MakeEnv = Callable[..., TwoRobots]

FRAMES: tuple[Frame, ...] = get_args(Frame)
OBSERVATIONS: tuple[ObservationMode, ...] = get_args(ObservationMode)
MODES: tuple[ActionMode, ...] = get_args(ActionMode)
HEADING_OF_FRAME = slice(23, 25)


def assert_same_angle(a: Floats, b: Floats, atol: float) -> None:
    np.testing.assert_allclose(np.exp(1j * np.asarray(a)), np.exp(1j * np.asarray(b)), atol=atol)


def assert_same_poses(a: Floats, b: Floats, length: float = 1e-7, angle: float = 1e-6) -> None:
    """Compare x, y, heading (..., 3) within float32."""
    np.testing.assert_allclose(a[..., :2], b[..., :2], atol=length)
    assert_same_angle(a[..., 2], b[..., 2], angle)


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("scenario", ["random", "approach-40-anti"])
def test_unpacked_observation_is_the_true_state(make_env: MakeEnv, scenario: str, frame: Frame, n_epm: int) -> None:
    """Every part against ``info`` and the reference itself, over several episodes under random actions."""
    env = make_env(scenario=scenario, frame=frame, n_epm=n_epm, control_hz=10.0)
    env.action_space.seed(1)
    for seed in range(4):
        observation, info = env.reset(seed=seed)
        trajectory = draw(scenario, np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed))))
        before, ended = info["robots"][:, :3], False
        while not ended:
            parts = unpack(observation, env.layout)
            robots, time, period = info["robots"][:, :3], info["time_s"], 0.1
            assert_same_poses(parts.robots, robots)
            error = trajectory.at(time + period) - robots
            assert_same_poses(parts.error, error)
            rates = (robots - before) / period
            rates[:, 2] = np.angle(np.exp(1j * (robots - before)[:, 2])) / period
            np.testing.assert_allclose(parts.rates, rates, rtol=1e-5, atol=1e-6)
            assert parts.separation == pytest.approx(np.linalg.norm(robots[1, :2] - robots[0, :2]), rel=1e-6)
            for k in range(5):
                assert_same_poses(parts.reference[k], trajectory.at(time + (1 + k) * period), 2e-7, 2e-6)
            pose = info["epm_pose"].reshape(n_epm, 5)
            centre = pose[:, 2:3] * np.stack(
                [np.cos(pose[:, 1]) * np.cos(pose[:, 0]), np.cos(pose[:, 1]) * np.sin(pose[:, 0]), np.sin(pose[:, 1])],
                axis=-1,
            )
            moment = np.stack(
                [np.cos(pose[:, 4]) * np.cos(pose[:, 3]), np.cos(pose[:, 4]) * np.sin(pose[:, 3]), np.sin(pose[:, 4])],
                axis=-1,
            )
            np.testing.assert_allclose(parts.epm_positions, centre, atol=2e-7)
            np.testing.assert_allclose(parts.epm_directions, moment, atol=1e-6)
            before = robots
            observation, _, terminated, truncated, info = env.step(env.action_space.sample())
            ended = terminated or truncated


@pytest.mark.parametrize("frame", FRAMES)
def test_unpack_takes_batches(make_env: MakeEnv, frame: Frame) -> None:
    env = make_env(frame=frame)
    observations = [env.reset(seed=k)[0] for k in range(6)]
    together = unpack(np.reshape(observations, (2, 3, -1)), env.layout)
    for k, observation in enumerate(observations):
        for name, value in vars(unpack(observation, env.layout)).items():
            np.testing.assert_allclose(getattr(together, name)[k // 3, k % 3], value, atol=1e-15)


def test_both_frames_and_modes_tell_the_same(make_env: MakeEnv) -> None:
    for seed in range(5):
        carried, fixed = make_env(frame="robots"), make_env(frame="global")
        (a, _), (b, _) = carried.reset(seed=seed), fixed.reset(seed=seed)
        parts_a, parts_b = unpack(a, carried.layout), unpack(b, fixed.layout)
        for name, value in vars(parts_a).items():
            if name in ("error", "robots", "reference"):
                assert_same_poses(value, getattr(parts_b, name), 2e-7, 2e-6)
            else:
                np.testing.assert_allclose(value, getattr(parts_b, name), atol=1e-6)
        np.testing.assert_array_equal(a[HEADING_OF_FRAME], b[HEADING_OF_FRAME])
        for frame, full in (("robots", a), ("global", b)):
            errors, _ = make_env(frame=frame, observation="errors").reset(seed=seed)
            np.testing.assert_array_equal(errors, full[:8])


def test_pose_errors_come_first_scaled(make_env: MakeEnv) -> None:
    env = make_env(frame="global", scenario="approach-60")
    observation, info = env.reset(seed=3)
    error = draw("approach-60", np.random.default_rng(0)).at(0.5) - info["robots"][:, :3]
    for robot in range(2):
        x, y, sine, cosine = observation[4 * robot : 4 * robot + 4]
        np.testing.assert_allclose([x, y], error[robot, :2] / 0.03, rtol=1e-5)
        np.testing.assert_allclose([sine, cosine], [math.sin(error[robot, 2]), math.cos(error[robot, 2])], atol=1e-6)


@pytest.mark.parametrize("turn", [3.0, -3.0, 2 * math.pi - 0.3, 0.3 - 2 * math.pi])
def test_rate_is_the_shortest_turn(turn: float) -> None:
    """A heading that passes the cut between pi and -pi from one measurement to the next is no fast turn."""
    episodes = Episodes(1, Settings(frame="global"))
    episodes.seed(0, np.random.default_rng(0))
    episodes.start(np.ones(1, np.bool_))
    episodes.state.measured[0, 1, 2] = episodes.state.before[0, 1, 2] + turn
    rate = unpack(episodes.observe()[0], episodes.layout).rates[1, 2]
    assert rate == pytest.approx(math.remainder(turn, 2 * math.pi) / 0.5, rel=1e-6)


def turned_scene(episodes: Episodes, angle: float) -> None:
    """Turn all that an episode holds about the vertical, in place."""
    c, s = math.cos(angle), math.sin(angle)
    q = np.array([[c, -s], [s, c]])
    world = episodes.world
    for poses in (episodes.state.measured, episodes.state.before, world.robots):
        poses[..., :2] = poses[..., :2] @ q.T
        poses[..., 2] += angle
    world.robots[..., 3:5] = world.robots[..., 3:5] @ q.T
    world.epms[..., :2] = world.epms[..., :2] @ q.T
    world.epms[..., 3:5] = world.epms[..., 3:5] @ q.T
    world.coefficients[:, :, :, :2] = np.einsum("ij,nrsjp->nrsip", q, world.coefficients[:, :, :, :2])
    world.coefficients[:, :, :, 2, 0] += angle


@pytest.mark.parametrize("angle", [0.8, -2.0, math.pi, 5.0])
@pytest.mark.parametrize("n_epm", [2, 3])
def test_robots_frame_observation_does_not_change_when_the_scene_turns(n_epm: int, angle: float) -> None:
    episodes = {frame: Episodes(8, Settings(n_epm=n_epm, frame=frame)) for frame in FRAMES}
    rng = np.random.default_rng(2)
    actions = rng.uniform(-0.3, 0.3, (8, 5 * n_epm))
    change = {}
    for frame, batch in episodes.items():
        for row in range(8):
            batch.seed(row, np.random.default_rng(row))
        batch.start(np.ones(8, np.bool_))
        batch.step(actions, np.ones(8, np.bool_))
        before = batch.observe()
        turned_scene(batch, angle)
        change[frame] = np.abs(batch.observe() - before)
    others = np.delete(change["robots"], [23, 24], axis=1)
    assert others.max() < 1e-4
    assert np.median(others) < 1e-6
    assert change["robots"][:, HEADING_OF_FRAME].max() > 0.1
    assert change["global"].max() > 0.1


@pytest.mark.parametrize("angle", [0.8, math.pi])
def test_a_turned_episode_stays_turned_in_home_mode(angle: float) -> None:
    """The same actions in the turned scene: same rewards, same flags, same observations but for the frame's heading."""
    straight, turned = (Episodes(6, Settings(control_hz=10.0)) for _ in range(2))
    for batch in (straight, turned):
        for row in range(6):
            batch.seed(row, np.random.default_rng(row))
        batch.start(np.ones(6, np.bool_))
    turned_scene(turned, angle)
    rng, active = np.random.default_rng(0), np.ones(6, np.bool_)
    for _ in range(3):
        actions = rng.uniform(-0.3, 0.3, (6, 10))
        for batch in (straight, turned):
            batch.step(actions, active)
        reward, terminated, _ = straight.outcome()
        turned_reward, turned_terminated, _ = turned.outcome()
        np.testing.assert_allclose(turned_reward[active], reward[active], atol=1e-6)
        np.testing.assert_array_equal(turned_terminated, terminated)
        active &= ~terminated
        a, b = (np.delete(batch.observe()[active], [23, 24], axis=1) for batch in (straight, turned))
        np.testing.assert_allclose(a, b, atol=1e-3)
    assert active.any()


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("n_epm", [2, 3])
def test_no_entry_is_constant_over_random_episodes(make_env: MakeEnv, n_epm: int, frame: Frame) -> None:
    env = make_env(n_epm=n_epm, frame=frame, control_hz=5.0)
    env.action_space.seed(0)
    seen = []
    for seed in range(20):
        seen.append(env.reset(seed=seed)[0])
        ended = False
        while not ended:
            observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
            seen.append(observation)
            ended = terminated or truncated
    spread = np.ptp(np.array(seen), axis=0)
    assert spread.min() > 1e-3


@pytest.mark.parametrize("control_hz", [0.5, 2.0, 10.0])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("n_epm", [2, 3])
def test_observations_stay_within_the_space_under_extreme_actions(
    make_env: MakeEnv, n_epm: int, mode: ActionMode, control_hz: float
) -> None:
    rng = np.random.default_rng(4)
    for frame in FRAMES:
        env = make_env(n_epm=n_epm, action=mode, frame=frame, control_hz=control_hz)
        for seed in range(4):
            observation, _ = env.reset(seed=seed)
            assert observation in env.observation_space
            ended = False
            while not ended:
                action = np.sign(rng.uniform(-1, 1, env.action_space.shape)).astype(np.float32)
                observation, reward, terminated, truncated, info = env.step(action)
                assert observation in env.observation_space
                assert 0 <= reward <= 1
                assert all(0 <= info[name] <= 1 for name in ("reward_position", "reward_heading"))
                ended = terminated or truncated


def test_reward_terms_fall_from_one_to_zero() -> None:
    error = np.array([0.0, *np.geomspace(1e-5, 1e3, 60)])
    terms = np.array([reward_terms(e, e) for e in error]).T
    for term, scales in zip(terms, (POSITION_SCALES_M, HEADING_SCALES_RAD), strict=True):
        assert term[0] == 1.0
        assert (np.diff(term) < 0).all()
        assert 0 < term[-1] < 1e-6
        expected = np.mean([1 / (1 + (error / s) ** 2) for s in scales], axis=0)
        np.testing.assert_allclose(term, expected, rtol=1e-12)


def test_reward_is_the_mean_of_its_terms(make_env: MakeEnv) -> None:
    env = make_env()
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.zeros(10, np.float32))
    assert reward == pytest.approx((info["reward_position"] + info["reward_heading"]) / 2, rel=1e-12)
    expected = np.mean([1 / (1 + (info["position_error_m"] / s) ** 2) for s in POSITION_SCALES_M])
    assert info["reward_position"] == pytest.approx(expected, rel=1e-12)
