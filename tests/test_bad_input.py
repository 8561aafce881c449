"""Bad input is told in one line: what it must be and what was received; nothing moves, and the env stays usable."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, get_args

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

import magenv
from magenv.actions import ActionMode, Actions
from magenv.allocation import allocate
from magenv.dipole import field, field_and_gradient, gradient
from magenv.env import TwoRobots
from magenv.params import Body, Magnet, Plant, System, TaskParams
from magenv.poses import from_cartesian, home_pose, project, to_cartesian
from magenv.task import unpack
from magenv.trajectories import approach
from magenv.vector_env import TwoRobotsVector
from magenv.wrench import robot_wrench, wrench_jacobian

MakeEnv = Callable[..., TwoRobots]

MODES: tuple[ActionMode, ...] = get_args(ActionMode)
SCENARIOS = "random, approach-<s> or approach-<s>-anti with s from 12 to 100 (mm)"
POSITIVE = "a positive, finite number"
CONTROL_HZ = "a number from 0.01 to 1000.0"
NOT_NEGATIVE = "a finite number of at least 0"


def told(name: str, must_be: str, received: object) -> str:
    """The whole message, as a pattern."""
    return "^" + re.escape(f"Input {name} must be {must_be}; instead received {received!r}.") + "$"


def one_line(error: BaseException) -> None:
    assert re.fullmatch(r"Input \w+ must be .+; instead received .+\.", str(error)), str(error)


ARGUMENTS: list[tuple[dict[str, Any], str, str]] = [
    ({"scenario": "approach-5"}, "scenario", SCENARIOS),
    ({"scenario": "approach-101"}, "scenario", SCENARIOS),
    ({"scenario": "approach--30"}, "scenario", SCENARIOS),
    ({"scenario": "approach-30-ante"}, "scenario", SCENARIOS),
    ({"scenario": "approach-30\n"}, "scenario", SCENARIOS),
    ({"scenario": "approach-nan"}, "scenario", SCENARIOS),
    ({"scenario": ""}, "scenario", SCENARIOS),
    ({"scenario": None}, "scenario", SCENARIOS),
    ({"scenario": 30}, "scenario", SCENARIOS),
    ({"plant": "swamp"}, "plant", "one of paper"),
    ({"plant": None}, "plant", "one of paper"),
    ({"n_epm": 0}, "n_epm", "2 or 3"),
    ({"n_epm": 1}, "n_epm", "2 or 3"),
    ({"n_epm": 4}, "n_epm", "2 or 3"),
    ({"n_epm": -2}, "n_epm", "2 or 3"),
    ({"n_epm": True}, "n_epm", "2 or 3"),
    ({"n_epm": "2"}, "n_epm", "2 or 3"),
    ({"action": "push"}, "action", "one of home, pose, step, wrench"),
    ({"action": None}, "action", "one of home, pose, step, wrench"),
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


def usable(env: TwoRobots, before: list[NDArray[Any]]) -> None:
    """Nothing has moved, and the next good action is as in an env that never saw the bad one."""
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
        usable(env, before)
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
    with pytest.raises(ValueError, match=r"^Input action must be finite; instead received .+\.$") as caught:
        env.step(action)
    one_line(caught.value)
    usable(env, before)
    good = np.full_like(action, 0.1)
    np.testing.assert_array_equal(env.step(good)[0], twin.step(good)[0])


def test_message_of_a_long_action_is_one_line() -> None:
    env = TwoRobotsVector(64, n_epm=3)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="finite") as caught:
        env.step(np.full((64, 15), np.nan, np.float32))
    one_line(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("action", ["forward", None, [[1, 2], [3]]])
def test_action_that_is_no_array_of_numbers(make_env: MakeEnv, action: Any) -> None:
    env = make_env()
    env.reset(seed=0)
    before = state(env)
    with pytest.raises(ValueError, match=r"^Input action must be") as caught:
        env.step(action)
    one_line(caught.value)
    usable(env, before)


@pytest.mark.parametrize("bad", [np.zeros((3, 9)), np.zeros((2, 10)), np.zeros(10), np.full((3, 10), np.nan)])
def test_actions_of_a_batch(bad: NDArray[Any]) -> None:
    env, twin = TwoRobotsVector(3), TwoRobotsVector(3)
    env.reset(seed=0)
    twin.reset(seed=0)
    before = state(env)
    with pytest.raises(ValueError, match=r"^Input action must be"):
        env.step(bad)
    for value, kept in zip(state(env), before, strict=True):
        np.testing.assert_array_equal(value, kept)
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
    for value, kept in zip(state(env), before, strict=True):
        np.testing.assert_array_equal(value, kept)


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


# Parameters


@pytest.mark.parametrize("value", [0.0, -0.01, math.nan, math.inf, "1", None, True])
@pytest.mark.parametrize("name", ["mass_kg", "inertia_kgm2", "diameter_m"])
def test_body_is_positive(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, POSITIVE, value)):
        Body(**{name: value})


@pytest.mark.parametrize("value", [-0.01, math.nan, math.inf])
@pytest.mark.parametrize("name", ["drag_linear_nspm", "drag_rotational_nmsprad"])
def test_drag_is_not_negative(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, NOT_NEGATIVE, value)):
        Body(**{name: value})
    assert getattr(Body(**{name: 0.0}), name) == 0.0


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["diameter_m", "length_m", "remanence_t"])
def test_magnet_is_positive(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, POSITIVE, value)):
        Magnet(**({"diameter_m": 0.1, "length_m": 0.1} | {name: value}))


def test_numpys_numbers_are_numbers() -> None:
    assert System(n_epm=np.int64(3)).gap_min_m == System(n_epm=3).gap_min_m  # type: ignore[arg-type]
    assert TaskParams(control_hz=np.float32(4)).period_s == 0.25  # type: ignore[arg-type]
    TwoRobots(n_epm=np.int64(2), control_hz=np.float64(2.0)).reset(seed=0)  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [0, -1, 2.0, True, "2", None])
def test_number_of_epms_of_a_system(value: Any) -> None:
    with pytest.raises(ValueError, match=told("n_epm", "a whole number of at least 1", value)):
        System(n_epm=value)


@pytest.mark.parametrize("name", ["r_min_m", "r_max_m", "attraction_max_n"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_limits_of_a_system_are_positive(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, POSITIVE, value)):
        System(**{name: value})


@pytest.mark.parametrize("r_max", [0.1, 0.15])
def test_r_max_below_r_min(r_max: float) -> None:
    with pytest.raises(ValueError, match=told("r_max_m", "greater than r_min_m = 0.15", r_max)):
        System(r_max_m=r_max)


def test_gap_that_fits_nowhere() -> None:
    """The EPMs would have to be farther apart than the outer sphere is wide."""
    with pytest.raises(ValueError, match=r"^Input .+ must be .+; instead received"):
        System(r_max_m=0.16, attraction_max_n=0.1)


@pytest.mark.parametrize("name", ["workspace_radius_m", "substep_s"])
@pytest.mark.parametrize("value", [0.0, -0.1, math.nan])
def test_plant_is_positive(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, POSITIVE, value)):
        Plant(**{name: value})


def test_workspace_holds_the_body() -> None:
    with pytest.raises(ValueError, match=told("workspace_radius_m", "greater than the body's diameter 0.011", 0.01)):
        Plant(workspace_radius_m=0.01)


@pytest.mark.parametrize("name", ["loss_distance_m", "tracking_distance_m"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.inf])
def test_task_is_positive(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, POSITIVE, value)):
        TaskParams(**{name: value})


@pytest.mark.parametrize("name", ["start_position_sd_m", "start_heading_sd_rad"])
def test_start_spread_is_not_negative(name: str) -> None:
    with pytest.raises(ValueError, match=told(name, NOT_NEGATIVE, -1e-3)):
        TaskParams(**{name: -1e-3})


# Functions


def test_dipole_shapes() -> None:
    laws: list[Callable[..., object]] = [field, gradient, field_and_gradient]
    for law in laws:
        for name, arguments in (
            ("moment", ([1, 2], [0, 0, 0], [1, 0, 0])),
            ("source", ([1, 0, 0], [0, 0, 0, 0], [1, 0, 0])),
            ("point", ([1, 0, 0], [0, 0, 0], 1.0)),
        ):
            with pytest.raises(ValueError, match=f"^Input {name} must be an array of shape \\(\\.\\.\\., 3\\)"):
                law(*arguments)


def test_wrench_shapes() -> None:
    positions, moments, pose = np.array([[0.1, 0, 0], [0, 0, 0]]), np.ones((2, 3)), home_pose(2)
    for law in (robot_wrench, wrench_jacobian):
        with pytest.raises(ValueError, match=told("positions", "an array of shape (..., 2, 3)", (3, 3))):
            law(np.zeros((3, 3)), moments, pose, 1.0)
        with pytest.raises(ValueError, match=told("moments", "an array of shape (..., 2, 3)", (3,))):
            law(positions, moments[0], pose, 1.0)
        for bad in (pose[:4], pose[:0], np.array(1.0)):
            with pytest.raises(ValueError, match=told("pose", "an array of shape (..., 5 N)", bad.shape)):
                law(positions, moments, bad, 1.0)
        with pytest.raises(ValueError, match=r"^Input positions, moments, pose must be of leading axes that broadcast"):
            law(np.tile(positions, (2, 1, 1)), np.tile(moments, (3, 1, 1)), pose, 1.0)
        for value in (0.0, -1.0, math.nan, math.inf):
            with pytest.raises(ValueError, match=told("epm_moment_am2", "a positive number", value)):
                law(positions, moments, pose, value)


def test_pose_shapes() -> None:
    with pytest.raises(ValueError, match=told("pose", "an array of shape (..., 5 N)", (7,))):
        to_cartesian(np.zeros(7))
    with pytest.raises(ValueError, match=told("positions", "an array of shape (..., N, 3)", (2, 2))):
        from_cartesian(np.zeros((2, 2)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match=told("directions", "of the shape of positions (2, 3)", (3, 3))):
        from_cartesian(np.zeros((2, 3)), np.zeros((3, 3)))
    for n_epm in (0, 1, 4):
        with pytest.raises(ValueError, match=told("n_epm", "2 or 3", n_epm)):
            home_pose(n_epm)


@pytest.mark.parametrize(
    "pose",
    [np.full(10, np.nan), np.tile(home_pose(2), (2, 1)), home_pose(3), home_pose(2)[:5]],
    ids=["nan", "rows", "three", "one"],
)
def test_projected_pose_is_finite_and_of_the_system(pose: NDArray[np.float64]) -> None:
    with pytest.raises(ValueError, match=r"^Input pose must be"):
        project(pose, System())


def problem(**changes: Any) -> dict[str, Any]:
    return {
        "target": np.full(10, 1e-3),
        "positions": np.array([[0.05, 0.0, 0.0], [-0.05, 0.0, 0.0]]),
        "moments": np.array([[0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]),
        "system": System(),
    } | changes


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"target": np.zeros(6)}, "target"),
        ({"target": np.full(10, np.nan)}, "target"),
        ({"target": np.full(10, 1e160)}, "target"),
        ({"seed": -1}, "seed"),
        ({"max_iterations": -1}, "max_iterations"),
        ({"max_iterations": 2.5}, "max_iterations"),
        ({"tolerance": math.nan}, "tolerance"),
        ({"positions": np.array([[0.0, 1e-9, 0.0], [0.0, -1e-9, 0.0]])}, "positions"),
        ({"seed": "a"}, "seed"),
        ({"positions": np.zeros((2, 2))}, "positions"),
        ({"positions": np.full((2, 3), np.inf)}, "positions"),
        ({"positions": np.zeros((2, 3))}, "positions"),  # coincident robots
        ({"moments": np.zeros((3, 3))}, "moments"),
        ({"moments": np.zeros((2, 3))}, "moments"),  # no direction
        ({"initial": np.zeros(15)}, "initial"),
        ({"initial": np.full(10, np.nan)}, "initial"),
        ({"starts": 0}, "starts"),
        ({"starts": -1}, "starts"),
        ({"starts": 2.5}, "starts"),
        ({"method": "magic"}, "method"),
        ({"force_scale_n": 0.0}, "force_scale_n"),
        ({"torque_scale_nm": -1.0}, "torque_scale_nm"),
    ],
    ids=lambda v: v if isinstance(v, str) else "-".join(f"{k}={np.shape(x) or x}" for k, x in v.items()),
)
def test_allocation(changes: dict[str, Any], name: str) -> None:
    with pytest.raises(ValueError, match=f"^Input {name} must be .+; instead received"):
        allocate(**problem(**changes))


def test_action_mode() -> None:
    with pytest.raises(ValueError, match=told("action", "one of home, pose, step, wrench", "push")):
        Actions("push", System())  # type: ignore[arg-type]


@pytest.mark.parametrize("separation", [0.0119, 0.1001, -0.03, math.nan])
def test_separation(separation: float) -> None:
    with pytest.raises(ValueError, match=told("separation_m", "from 0.012 to 0.100", separation)):
        approach(separation)


def test_observation_that_cannot_be_unpacked(make_env: MakeEnv) -> None:
    env = make_env()
    with pytest.raises(ValueError, match=told("observation", "of shape (..., 63)", (62,))):
        unpack(np.zeros(62), env.layout)
    with pytest.raises(ValueError, match=r"^Input observation must be full: errors alone do not tell the poses"):
        unpack(np.zeros(8), make_env(observation="errors").layout)
