"""The plant ``arm``: accelerations, latency, noise, parameters that are drawn, friction and disturbance."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from lane import magnets
from numpy.typing import NDArray
from rollouts import MakeEnv

from agents.predictive import Predictive
from agents.rollout import run
from magenv.actions import pose_to_action
from magenv.env import TwoRobots
from magenv.episodes import Episodes, Settings
from magenv.forecast import Course
from magenv.manoeuvre import Arms, allow, move
from magenv.params import PLANTS, Plant, System, TaskParams
from magenv.trajectories import shaped
from magenv.vector_env import TwoRobotsVector
from magenv.ways import longest_way, ramp, share_gone
from magenv.world import World

Floats = NDArray[np.float64]

ARM = PLANTS["arm"]
PROMPT = dataclasses.replace(ARM, latency_s=0.0)
"""Commands act at once."""
H = ARM.substep_s
FREE = TaskParams(control_hz=1.0 / H, loss_distance_m=10.0)
"""A hold is one substep, so that every one is seen; the robots may go where they like."""


def world_of(starts: Floats, plant: Plant = PROMPT, task: TaskParams = FREE) -> World:
    """A world whose EPMs stand at ``starts`` (n, N, 6), the robots at rest."""
    world, trajectory = World(len(starts), System(n_epm=starts.shape[1]), plant, task), shaped("approach", 0.060)
    robots = np.zeros((2, 6))
    robots[:, :3] = trajectory.at(0.0)
    for row, epms in enumerate(starts):
        world.start(row, trajectory, robots, epms)
    return world


def ways(world: World, commands: list[tuple[Floats, int]]) -> Floats:
    """Where the EPMs are after each substep (K, n, N, 6), each command (n, N, 6) given for so many."""
    path = [world.epms.copy()]
    for goals, substeps in commands:
        for _ in range(substeps):
            world.step(goals, np.ones(len(goals), np.bool_))
            path.append(world.epms.copy())
    return np.array(path)


@pytest.mark.parametrize("n_epm", [2, 3])
def test_limits_hold_all_the_way(rng: np.random.Generator, n_epm: int) -> None:
    """Speeds, radii and gap, between random allowed poses, the command changed before it is reached."""
    system = System(n_epm=n_epm)
    draw = np.array([[magnets(rng, system) for _ in range(30)] for _ in range(4)])
    way = ways(world_of(draw[0]), [(goals, 100) for goals in draw[1:]])
    centres, moments = way[..., :3], way[..., 3:]
    radii = np.linalg.norm(centres, axis=-1)
    assert radii.min() > system.r_min_m - 1e-9
    assert radii.max() < system.r_max_m + 1e-9
    assert np.linalg.norm(np.diff(centres, axis=0), axis=-1).max() < ARM.epm_speed_mps * H * (1.0 + 1e-8)
    turned = np.linalg.norm(np.cross(moments[1:], moments[:-1]), axis=-1)
    assert turned.max() < math.sin(ARM.epm_turn_radps * H) * (1.0 + 1e-8)
    for k in range(n_epm):
        for j in range(k):
            assert np.linalg.norm(centres[:, :, k] - centres[:, :, j], axis=-1).min() > system.gap_min_m - 1e-9


def test_speed_changes_as_fast_as_it_may_and_no_faster(rng: np.random.Generator) -> None:
    """Along the way of a lone EPM, its command changed twice on the way, the other far off."""
    near = np.array([[[0.2, 0, 0, 1, 0, 0], [-0.5, 0, 0, 1, 0, 0]]])
    goals = []
    for _ in range(3):
        goal, direction = near.copy(), rng.normal(size=(2, 3))
        direction[:, 0] += 2.0
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        goal[0, 0, :3], goal[0, 0, 3:] = rng.uniform(0.18, 0.3) * direction[0], direction[1]
        goals.append(goal)
    way = ways(world_of(near), [(goals[0], 30), (goals[1], 25), (goals[2], 200)])[:, 0, 0]
    speed = np.linalg.norm(np.diff(way[:, :3], axis=0), axis=1) / H
    change = np.abs(np.diff(np.concatenate([[0.0], speed, [0.0]]))) / H
    # the radius makes the speed in space differ a little from that along the way
    assert 0.5 * ARM.epm_acceleration_mps2 < change.max() < 1.05 * ARM.epm_acceleration_mps2
    turn = np.linalg.norm(np.cross(way[1:, 3:], way[:-1, 3:]), axis=1) / H
    change = np.abs(np.diff(np.concatenate([[0.0], turn, [0.0]]))) / H
    assert change.max() < 1.001 * ARM.epm_turn_acceleration_radps2
    np.testing.assert_array_equal(way[-1], goals[-1][0, 0])


def test_a_command_given_again_changes_nothing(rng: np.random.Generator) -> None:
    heavy = dataclasses.replace(PROMPT, body=dataclasses.replace(ARM.body, mass_kg=1e3, inertia_kgm2=1e3))
    starts, goals = (np.array([magnets(rng) for _ in range(5)]) for _ in range(2))
    once = world_of(starts, heavy, TaskParams(control_hz=1.0, loss_distance_m=10.0))
    once.step(goals, np.ones(5, np.bool_))
    again = ways(world_of(starts, heavy), [(goals, 200)])
    np.testing.assert_array_equal(again[-1], once.epms)


def test_the_motion_foreseen_is_the_motion(rng: np.random.Generator) -> None:
    system, substeps = System(), 100
    arms = Arms.of(system, PROMPT, H, substeps)
    motion, checked = Course.of(2, substeps, True), 0
    for _ in range(20):
        start, goal = magnets(rng), magnets(rng)
        allow(arms, start, goal)
        way = ways(world_of(start[None]), [(goal[None], substeps)])[:, 0]
        move(arms, start, goal, np.empty((0, 2, 6, 5)), motion)
        if np.linalg.norm(way[:, 0, :3] - way[:, 1, :3], axis=1).min() > system.gap_min_m + 0.05:
            checked += 1
            np.testing.assert_allclose(0.5 * (way[1:] + way[:-1]), motion.path, rtol=0, atol=1e-12)
            np.testing.assert_array_equal(way[-1], goal)  # what is allowed is reached in time
    assert checked > 3


@pytest.mark.parametrize("plant", [ARM, dataclasses.replace(PLANTS["paper"], latency_s=0.1)])
@pytest.mark.parametrize("control_hz", [2.0, 10.0, 25.0])
def test_commands_act_after_the_latency(rng: np.random.Generator, plant: Plant, control_hz: float) -> None:
    """Whatever the control rate, and on EPMs that jump, too."""
    starts, goals = (np.array([magnets(rng) for _ in range(3)]) for _ in range(2))
    task = TaskParams(control_hz=control_hz, loss_distance_m=10.0)
    world, holds = world_of(starts, plant, task), math.ceil(0.1 * control_hz - 1e-9)
    for _ in range(holds):
        still = (world.epms == starts).all()
        world.step(goals, np.ones(3, np.bool_))
    assert still
    if holds == round(0.1 * control_hz):  # they act at the end of that hold, to the substep
        assert (world.epms == starts).all()
        world.step(goals, np.ones(3, np.bool_))
    assert not (world.epms == starts).all()


def test_noise_is_that_of_the_literature_and_the_same_for_all() -> None:
    """Differences of what is measured and what is true, over holds, under two controllers that differ."""
    seen = []
    for size in (0.0, 0.05):
        envs = TwoRobotsVector(200, scenario="approach-60", plant="arm", control_hz=20.0)
        envs.reset(seed=0)
        state, noise = envs._episodes.state, []
        for _ in range(4):
            noise.append(state.measured - state.robots[..., :3])
            envs.step(np.full((200, 10), size, np.float32))
        seen.append(np.array(noise))
    np.testing.assert_allclose(seen[0], seen[1], rtol=0, atol=1e-12)
    sizes = seen[0].std(axis=(0, 1, 2))
    np.testing.assert_allclose(sizes, [1.3e-3, 1.3e-3, math.radians(1.1)], rtol=0.06)
    flat = seen[0].reshape(4, -1)
    np.testing.assert_allclose(np.corrcoef(flat) - np.eye(4), 0.0, atol=0.1)  # each instant has its own


def test_parameters_are_drawn_within_the_mismatch() -> None:
    episodes = Episodes(400, Settings("approach-60", "arm"))
    for row in range(400):
        episodes.seed(row, np.random.default_rng(row))
    episodes.start(np.ones(400, np.bool_))
    physics, plain = episodes.world.physics, Episodes(1, Settings("approach-60")).world.physics
    for name in ("mass", "inertia", "drag_linear", "drag_rotational", "ipm_moment", "epm_moment"):
        factor = getattr(physics, name) / getattr(plain, name)
        assert 0.8 <= factor.min() < 0.805, name
        assert 1.195 < factor.max() <= 1.2, name
        assert len(np.unique(factor)) == factor.size, name


@pytest.mark.parametrize("rise", [0.025, 0.0159, 0.3, 1.0, 2.5])
def test_the_longest_way_is_the_last_that_its_ramp_does_in_time(rise: float) -> None:
    """At the end all of it is gone, and no step is longer than full speed allows."""
    for substeps in range(1, 200):
        longest = longest_way(rise, substeps)
        up, flat = ramp(longest, rise)
        assert 2 * up - 1 + flat <= substeps
        up_over, flat_over = ramp(longest * (1.0 + 1e-6), rise)
        assert 2 * up_over - 1 + flat_over > substeps
        gone = np.array([share_gone(j, up, flat) for j in range(substeps + 1)])
        assert gone[0] == 0.0
        assert gone[-1] == 1.0
        assert np.diff(gone).max() * longest <= 1.0 + 1e-9


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("action", ["home", "pose", "step", "wrench"])
def test_without_all_that_is_hard_it_is_the_papers_plant(
    monkeypatch: pytest.MonkeyPatch, action: Any, n_epm: int
) -> None:
    """Infinite speeds, no latency, no noise, no mismatch: the same bits, over losses and new episodes."""
    easy = dataclasses.replace(
        ARM,
        epm_speed_mps=math.inf,
        epm_turn_radps=math.inf,
        epm_acceleration_mps2=math.inf,
        epm_turn_acceleration_radps2=math.inf,
        latency_s=0.0,
        noise_position_m=0.0,
        noise_heading_rad=0.0,
        mismatch=0.0,
    )
    monkeypatch.setitem(PLANTS, "arm", easy)
    told, steps = [], 6 if action == "wrench" else 40  # each of a wrench is an optimisation
    for plant in ("paper", "arm"):
        envs, seen = TwoRobotsVector(4, n_epm=n_epm, plant=plant, action=action, control_hz=20.0), []
        seen.append(envs.reset(seed=5)[0].tobytes())
        actions = np.random.default_rng(1).uniform(-0.1, 0.1, (steps, *envs.action_space.shape))
        for each in actions.astype(np.float32):
            observation, reward, lost, ended, _ = envs.step(each)
            seen.append(b"".join(part.tobytes() for part in (observation, reward, lost, ended)))
        told.append(seen)
    assert told[0] == told[1]


def test_a_batch_equals_single_episodes() -> None:
    envs, one = TwoRobotsVector(5, plant="arm"), TwoRobots(plant="arm")
    first, single = envs.reset(seed=3)[0], one.reset(seed=5)[0]
    assert first[2].tobytes() == single.tobytes()
    action = np.full((5, 10), 0.01, np.float32)
    assert envs.step(action)[0][2].tobytes() == one.step(action[2])[0].tobytes()


@pytest.mark.parametrize("plant", ["arm", "arm:latency_s=0", "paper:epm_acceleration_mps2=5"])
def test_episodes_begin_where_the_epms_hold_the_robots(make_env: MakeEnv, plant: str) -> None:
    """Commands that act late, or EPMs that accelerate, could not hold in time what home lets go."""
    env = make_env(scenario="approach-60", plant=plant, action="pose", control_hz=10.0)
    held, info = make_env(scenario="approach-60", plant="arm").reset(seed=0)[1], env.reset(seed=0)[1]
    np.testing.assert_array_equal(info["epm_pose"], held["epm_pose"])
    for _ in range(4):  # 0.4 s; from home they are lost after 0.2
        *_, terminated, _, _ = env.step(pose_to_action(held["epm_pose"], System()))
        assert not terminated


def test_episodes_do_not_depend_on_the_kind_of_plant(make_env: MakeEnv) -> None:
    """Trajectory and start are those of the paper's plant of the same seed."""
    infos = [make_env(scenario="random", plant=plant).reset(seed=7)[1] for plant in ("paper", "arm")]
    np.testing.assert_array_equal(infos[0]["robots"], infos[1]["robots"])
    np.testing.assert_array_equal(infos[0]["reference"], infos[1]["reference"])


def test_the_predictive_controller_holds_the_robots() -> None:
    """Ten seconds; at home configurations alone they are lost in a fifth of a second."""
    (record,) = run(_Brief(2, 10.0, "arm"), "approach-60", "arm", 2, 10.0, episodes=1, seed=0)
    assert record.time_s[-1] >= 10.0


class _Brief(Predictive):
    """Gives up after ten seconds: one episode of a hundred takes long."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        """Return the controller's actions, then such that lose control."""
        actions, state = super().predict(observation, state, episode_start, deterministic)
        self.calls = 1 if episode_start is not None and episode_start.any() else self.calls + 1
        return (actions if self.calls <= 100 else -actions), state


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("latency_s", -0.1),
        ("latency_s", math.nan),
        ("noise_position_m", -1e-3),
        ("mismatch", 1.0),
        ("dry_friction_n", math.inf),
        ("epm_acceleration_mps2", 0.0),
    ],
)
def test_unsound_parameters_are_told(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"Input {name} must be a .*number"):
        dataclasses.replace(ARM, **{name: value})
