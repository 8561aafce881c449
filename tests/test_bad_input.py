"""Bad input to an environment is told in one line; nothing moves, and the env stays usable."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import gymnasium
import numpy as np
import pytest
from messages import refusal, told
from numpy.typing import NDArray
from rollouts import MODES, MakeEnv

import magenv
from magenv.actions import ActionMode
from magenv.env import TwoRobots
from magenv.home import home_epms
from magenv.params import PLANTS, Plant, System, TaskParams
from magenv.poses import from_cartesian
from magenv.reach import Shell, beyond_reach
from magenv.starts import holding_epms
from magenv.trajectories import Trajectory, shaped
from magenv.vector_env import TwoRobotsVector
from magenv.world import World
from magenv.wrench import IN_PLANE, planar_moments, robot_wrench

SCENARIOS = (
    "random, approach-<s>, crossing-<s>, meeting-<s>, eight-<s>, still-<s> or approach-<s>-anti "
    "with s from 12 to 100 (mm), or random-<s> with s from 12 to 80"
)
CONTROL_HZ = "a number from 0.01 to 1000.0"
CHANGES = ", ".join(f.name for f in dataclasses.fields(Plant) if f.name != "body")

ARGUMENTS: list[tuple[dict[str, Any], str, str]] = [
    ({"scenario": "approach-5"}, "scenario", SCENARIOS),
    ({"scenario": "approach-101"}, "scenario", SCENARIOS),
    ({"scenario": "approach--30"}, "scenario", SCENARIOS),
    ({"scenario": "approach-30-ante"}, "scenario", SCENARIOS),
    ({"scenario": "approach-30\n"}, "scenario", SCENARIOS),
    ({"scenario": "approach-nan"}, "scenario", SCENARIOS),
    ({"scenario": "meeting-30-anti"}, "scenario", SCENARIOS),
    ({"scenario": "eights-30"}, "scenario", SCENARIOS),
    ({"scenario": ""}, "scenario", SCENARIOS),
    ({"scenario": None}, "scenario", SCENARIOS),
    ({"scenario": 30}, "scenario", SCENARIOS),
    ({"plant": "swamp"}, "plant", "one of arm, arm-reach, cylinders, high-drag, low-drag, moving, paper"),
    ({"plant": None}, "plant", "one of arm, arm-reach, cylinders, high-drag, low-drag, moving, paper"),
    ({"plant": "swamp:mismatch=0.1"}, "plant", "one of arm, arm-reach, cylinders, high-drag, low-drag, moving, paper"),
    ({"plant": "paper:"}, "plant", "one with parameters out of " + CHANGES + ", each once"),
    ({"plant": "paper:body=1"}, "plant", "one with parameters out of " + CHANGES + ", each once"),
    ({"plant": "paper:mismatch=0.1,mismatch=0.2"}, "plant", "one with parameters out of " + CHANGES + ", each once"),
    ({"plant": "paper:mismatch"}, "plant", "changed by numbers in mismatch"),
    ({"plant": "paper:mismatch=much"}, "plant", "changed by numbers in mismatch"),
    ({"plant": "paper:epm_cylinders=1"}, "plant", "changed by true or false in epm_cylinders"),
    ({"n_epm": 0}, "n_epm", "2 or 3"),
    ({"n_epm": 1}, "n_epm", "2 or 3"),
    ({"n_epm": 4}, "n_epm", "2 or 3"),
    ({"n_epm": -2}, "n_epm", "2 or 3"),
    ({"n_epm": True}, "n_epm", "2 or 3"),
    ({"n_epm": "2"}, "n_epm", "2 or 3"),
    ({"action": "push"}, "action", "one of home, pose, step, wrench, velocity"),
    ({"action": None}, "action", "one of home, pose, step, wrench, velocity"),
    ({"observation": "some"}, "observation", "one of full, errors"),
    ({"frame": "moon"}, "frame", "one of robots, global"),
    ({"control_hz": 0}, "control_hz", CONTROL_HZ),
    ({"control_hz": -2.0}, "control_hz", CONTROL_HZ),
    ({"control_hz": math.inf}, "control_hz", CONTROL_HZ),
    ({"control_hz": math.nan}, "control_hz", CONTROL_HZ),
    ({"control_hz": "2"}, "control_hz", CONTROL_HZ),
    ({"control_hz": None}, "control_hz", CONTROL_HZ),
]


@pytest.mark.parametrize(("arguments", "name", "must_be"), ARGUMENTS, ids=[str(a[0]) for a in ARGUMENTS])
def test_arguments_of_the_env(arguments: dict[str, Any], name: str, must_be: str) -> None:
    """By the constructors and by ``gymnasium.make``."""
    received = arguments[name]
    with pytest.raises(ValueError, match=told(name, must_be, received)):
        TwoRobots(**arguments)
    with pytest.raises(ValueError, match=told(name, must_be, received)):
        TwoRobotsVector(2, **arguments)
    with pytest.raises(ValueError, match=told(name, must_be, received)):
        gymnasium.make(magenv.ENV_ID, **arguments)


def test_render_mode() -> None:
    with pytest.raises(ValueError, match=told("render_mode", "one of None, human, rgb_array", "ascii")):
        TwoRobots(render_mode="ascii")
    with pytest.raises(ValueError, match=told("render_mode", "None or rgb_array", "human")):
        TwoRobotsVector(2, render_mode="human")


@pytest.mark.parametrize("num_envs", [0, -1, 2.0, True, "3"])
def test_num_envs(num_envs: Any) -> None:
    with pytest.raises(ValueError, match=told("num_envs", "a whole number of at least 1", num_envs)):
        TwoRobotsVector(num_envs)


def test_autoreset_mode() -> None:
    with pytest.raises(ValueError, match=told("autoreset_mode", "one of NextStep, SameStep, Disabled", "Never")):
        TwoRobotsVector(2, autoreset_mode="Never")


# Actions


def state(env: TwoRobots | TwoRobotsVector) -> list[NDArray[Any]]:
    world = env._episodes.world
    return [world.robots.copy(), world.epms.copy(), world.step_count.copy(), env._episodes.observe()]


def assert_unmoved(env: TwoRobots | TwoRobotsVector, before: list[NDArray[Any]]) -> None:
    for value, kept in zip(state(env), before, strict=True):
        np.testing.assert_array_equal(value, kept)


@pytest.mark.parametrize("mode", MODES)
def test_action_of_the_wrong_shape(make_env: MakeEnv, mode: ActionMode) -> None:
    env = make_env(action=mode)
    env.reset(seed=0)
    before, size = state(env), env.action_space.shape[0] if env.action_space.shape else 0
    for shape in ((), (0,), (size - 1,), (size + 1,), (1, size), (size, 1), (2, size)):
        received = re.escape(f"instead received {shape!r}.")
        with pytest.raises(ValueError, match=rf"^Input action must be an array of shape \({size},\).*; {received}$"):
            env.step(np.zeros(shape, np.float32))
        assert_unmoved(env, before)
    assert np.isfinite(env.step(np.zeros(size, np.float32))[0]).all()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_action_that_is_not_finite(make_env: MakeEnv, mode: ActionMode, value: float) -> None:
    env, twin = make_env(action=mode, control_hz=20.0), make_env(action=mode, control_hz=20.0)
    env.reset(seed=0)
    twin.reset(seed=0)
    before = state(env)
    action = np.random.default_rng(0).uniform(-1, 1, env.action_space.shape).astype(np.float32)
    action[2] = value
    message = refusal(lambda: env.step(action))
    assert re.fullmatch(r"Input action must be finite; instead received .+\.", message), message
    assert_unmoved(env, before)
    good = np.full_like(action, 0.1)
    np.testing.assert_array_equal(env.step(good)[0], twin.step(good)[0])


def test_message_of_a_long_action_is_one_line() -> None:
    env = TwoRobotsVector(64, n_epm=3)
    env.reset(seed=0)
    message = refusal(lambda: env.step(np.full((64, 15), np.nan, np.float32)))
    assert re.fullmatch(r"Input \w+ must be .*finite.*; instead received .+\.", message), message
    assert len(message) < 300


@pytest.mark.parametrize(
    "action",
    ["forward", None, [[1, 2], [3]], ["0.1"] * 10, [10**400] * 10, [1j] * 10, np.zeros(10, "datetime64[s]")],
    ids=["text", "nothing", "ragged", "texts", "huge", "complex", "dates"],
)
def test_action_that_is_no_array_of_numbers(make_env: MakeEnv, action: Any) -> None:
    env = make_env()
    env.reset(seed=0)
    before = state(env)
    message = refusal(lambda: env.step(action))
    assert re.fullmatch(r"Input action must be .+; instead received .+\.", message), message
    assert_unmoved(env, before)


@pytest.mark.parametrize("bad", [np.zeros((3, 9)), np.zeros((2, 10)), np.zeros(10), np.full((3, 10), np.nan)])
def test_actions_of_a_batch(bad: NDArray[Any]) -> None:
    env, twin = TwoRobotsVector(3), TwoRobotsVector(3)
    env.reset(seed=0)
    twin.reset(seed=0)
    before = state(env)
    with pytest.raises(ValueError, match=r"^Input action must be"):
        env.step(bad)
    assert_unmoved(env, before)
    good = np.zeros((3, 10), np.float32)
    for _ in range(6):
        for a, b in zip(env.step(good)[:4], twin.step(good)[:4], strict=True):
            np.testing.assert_array_equal(a, b)


def test_one_nan_in_a_batch_moves_no_row() -> None:
    env = TwoRobotsVector(3)
    env.reset(seed=0)
    before, actions = state(env), np.zeros((3, 10), np.float32)
    actions[1, 4] = np.nan
    with pytest.raises(ValueError, match=r"^Input action must be finite"):
        env.step(actions)
    assert_unmoved(env, before)


# Resets


@pytest.mark.parametrize("seed", [-1, 1.5, "7"])
def test_seed_of_the_env_is_gymnasiums_matter(make_env: MakeEnv, seed: Any) -> None:
    env = make_env()
    env.reset(seed=0)
    with pytest.raises(gymnasium.error.Error, match=r"[Ss]eed"):
        env.reset(seed=seed)
    assert env.reset(seed=0)[0] in env.observation_space


@pytest.mark.parametrize("seed", [[1], [1, 2, 3], [1, -1], -1, 1.5, "ab", True])
def test_seeds_of_a_batch(seed: Any) -> None:
    env, other = TwoRobotsVector(2), TwoRobotsVector(2)
    for batch in (env, other):
        batch.reset(seed=4)
    with pytest.raises(ValueError, match=told("seed", "a whole number of at least 0, or 2 of them", seed)):
        env.reset(seed=seed)
    np.testing.assert_array_equal(env.reset()[0], other.reset()[0], "no generator was replaced")


@pytest.mark.parametrize("seed", [np.int64(3), np.arange(3, 5), [np.uint8(3), np.int64(4)], (3, 4)])
def test_seeds_of_a_batch_may_be_numpys(seed: Any) -> None:
    one, other = TwoRobotsVector(2).reset(seed=seed)[0], TwoRobotsVector(2).reset(seed=3)[0]
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("mask", [[True], [False, False], [1, 0], np.ones((2, 1), bool), "ab"])
def test_reset_mask(mask: Any) -> None:
    env = TwoRobotsVector(2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=told("reset_mask", "2 booleans, one of them true", mask)):
        env.reset(options={"reset_mask": mask})


# What robots cannot reach.


NARROW = "such that bodies 11 mm wide keep off each other and the wall at 80 mm"


@pytest.mark.parametrize("scenario", ["approach-60", "approach-12-anti", "random"])
def test_a_scenario_that_leaves_the_workspace(scenario: str) -> None:
    plant = "paper:workspace_radius_m=0.08"
    received = f"{scenario!r} on {plant!r}"
    for make in (TwoRobots, lambda **arguments: TwoRobotsVector(2, **arguments)):
        with pytest.raises(ValueError, match=told("scenario", NARROW, received)):
            make(scenario=scenario, plant=plant)
    TwoRobots(scenario=scenario, plant="paper:workspace_radius_m=0.09")


def a_world(**changes: Any) -> World:
    return World(1, System(), dataclasses.replace(PLANTS["paper"], **changes), TaskParams())


def test_a_trajectory_that_leaves_the_workspace() -> None:
    far, meeting = shaped("approach", 0.06), shaped("approach", 0.06)
    far.coefficients[..., 0, :] *= 1.6
    meeting.coefficients[:, :, 1] = 0.0
    for trajectory in (far, meeting):
        with pytest.raises(ValueError, match=r"^Input trajectory must be such that bodies 11 mm wide keep off each"):
            World(1, System(), PLANTS["paper"], TaskParams(), trajectory)
        with pytest.raises(ValueError, match=r"^Input trajectory must be such that bodies 11 mm wide keep off each"):
            a_world().start(0, trajectory, np.zeros((2, 6)), home_epms(2))


@pytest.mark.parametrize(
    ("robots", "epms", "message"),
    [
        ([[-0.1, 0, 0], [0.06, 0, 0]], None, "robots must be such that bodies 11 mm wide keep off each other"),
        ([[0.01, 0, 0], [0.02, 0, 0]], None, "robots must be such that bodies 11 mm wide keep off each other"),
        ([[np.nan, 0, 0], [0.06, 0, 0]], None, r"robots must be a finite array of shape \(2, 6\)"),
        ([[-0.06, 0, 0]], None, r"robots must be a finite array of shape \(2, 6\)"),
        ([[-0.06, 0, 0], [0.06, 0, 0]], np.full((2, 6), np.inf), r"epms must be a finite array of shape \(2, 6\)"),
        ([[-0.06, 0, 0], [0.06, 0, 0]], np.zeros((3, 6)), r"epms must be a finite array of shape \(2, 6\)"),
    ],
)
def test_a_start_that_cannot_be(robots: Any, epms: Any, message: str) -> None:
    states = np.pad(np.array(robots, dtype=float), ((0, 0), (0, 3)))
    world = a_world()
    with pytest.raises(ValueError, match="^Input " + message):
        world.start(0, shaped("approach", 0.06), states, home_epms(2) if epms is None else epms)
    assert not world.robots.any(), "nothing was put anywhere"


@pytest.mark.parametrize("apart_m", [0.011, 0.014])
def test_a_start_at_which_nothing_holds_the_robots(apart_m: float) -> None:
    """Side by side, parallel robots nearer than 18.8 mm pull each other with more than any EPMs can."""
    reference = np.array([[0.0, -0.5 * apart_m, 0.0], [0.0, 0.5 * apart_m, 0.0]])
    system, anywhere = System(), Shell.of(System(), PLANTS["paper"])
    with pytest.raises(ValueError, match=r"^Input reference must be one at whose start EPMs can hold the robots; inst"):
        holding_epms(reference, system, anywhere)
    assert np.isfinite(holding_epms(3 * reference, system, anywhere)).all()


@pytest.mark.parametrize("plant", ["paper", "arm-reach"])
def test_a_start_that_chance_draws_begins_as_well_as_it_can(plant: str) -> None:
    """In line, two EPMs cannot hold robots nearer than 24 mm; the random family has such starts, and must go on."""
    reference = np.array([[0.000871, 0.04582, -1.426596], [-0.007767, 0.065699, -1.437143]])
    system, shell = System(), Shell.of(System(), PLANTS[plant])
    epms = holding_epms(reference, system, shell, at_best=True)
    positions = np.pad(reference[:, :2], ((0, 0), (0, 1)))
    moments = planar_moments(reference[:, 2], system.ipm_moment_am2)
    found, at_home = (
        robot_wrench(positions, moments, from_cartesian(e[:, :3], e[:, 3:]), system.epm_moment_am2)[list(IN_PLANE)]
        for e in (epms, home_epms(2))
    )
    assert np.linalg.norm(found[[1, 2, 4, 5]]) < np.linalg.norm(at_home[[1, 2, 4, 5]])  # forces
    if plant == "arm-reach":
        assert beyond_reach(epms, shell, False) == 0.0


@pytest.mark.parametrize("knots", [np.zeros((33, 2)), np.zeros((32, 2, 3)), np.full((33, 2, 3), np.nan)])
def test_knots_of_a_trajectory(knots: NDArray[Any]) -> None:
    with pytest.raises(ValueError, match=r"^Input knots must be a finite array of shape \(33, 2, 3\)"):
        Trajectory.through(100.0, knots)
    for duration_s in (0.0, math.inf, math.nan):
        with pytest.raises(ValueError, match=r"^Input duration_s must be a positive, finite number"):
            Trajectory.through(duration_s, np.zeros((33, 2, 3)))
