"""What the arms reach: the shell, commands and starts within it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from messages import told
from reached import PLANT, SHELL, anywhere, away, beyond, nearest_pair, project

import magenv.starts
from magenv.actions import Actions, pose_to_action
from magenv.env import TwoRobots
from magenv.params import PLANTS, Plant, System, plant_named
from magenv.poses import from_cartesian, home_pose, to_cartesian
from magenv.reach import Shell, shoulder
from magenv.starts import holding_epms
from magenv.trajectories import shaped
from magenv.vector_env import TwoRobotsVector

# The shell


def test_the_shell_is_that_of_the_data_sheet() -> None:
    """Upper arm 0.42 m, forearm 0.4 m, elbow bent by up to 120 degrees."""
    assert SHELL.outer == pytest.approx(0.42 + 0.40)
    bent = math.sqrt(0.42**2 + 0.40**2 - 2 * 0.42 * 0.40 * math.cos(math.pi / 3))
    assert SHELL.inner == pytest.approx(bent, abs=1e-3)


@pytest.mark.parametrize("n_epm", [2, 3])
def test_each_arm_reaches_much_and_not_all(rng: np.random.Generator, n_epm: int) -> None:
    """Round the workspace nearest to it, over the top, and two thirds of all directions and radii."""
    directions = rng.normal(size=(20_000, n_epm, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    distances = away(directions * rng.uniform(0.15, 0.5, (20_000, 1, 1)))
    share = ((distances >= SHELL.inner) & (distances <= SHELL.outer)).mean(axis=0)
    np.testing.assert_allclose(share, 0.64, atol=0.015)
    assert beyond(0.15 * directions) <= 0.0
    for height in (0.15, 0.3, 0.5):
        assert beyond(np.array([[0.0, 0.0, height]] * n_epm)) <= 0.0
    bases = np.array([shoulder(SHELL, k, n_epm) for k in range(n_epm)])
    np.testing.assert_allclose(bases[0], [0.0, PLANT.arm_distance_m, PLANT.arm_height_m], atol=1e-15)
    np.testing.assert_allclose(bases[:, :2].sum(axis=0), 0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("text", "name", "must_be"),
    [
        ("arm:arm_reach_m=0", "arm_reach_m", "a number above 0"),
        ("arm:arm_reach_m=nan", "arm_reach_m", "a number above 0"),
        ("arm:arm_reach_m=0.4", "arm_reach_min_m", "a number of at least 0 and below arm_reach_m = 0.4"),
        ("arm:arm_reach_m=0.75", "arm_reach_m", "at least 0.7976, for arms to reach all round"),
        ("arm-reach:arm_reach_min_m=-0.1", "arm_reach_min_m", "a number of at least 0 and below arm_reach_m = 0.82"),
        ("arm-reach:arm_distance_m=-1", "arm_distance_m", "a positive, finite number"),
        ("arm-reach:arm_height_m=inf", "arm_height_m", "a finite number"),
        (
            "arm-reach:arm_distance_m=0.3",
            "arm_distance_m",
            "such that shoulders 0.45 m high are 0.6466 to 0.669 m",
        ),
    ],
)
def test_unsound_shells_are_told(text: str, name: str, must_be: str) -> None:
    with pytest.raises(ValueError, match=f"Input {name} must be {must_be}.*; instead received "):
        TwoRobots(plant=text)


def test_default_plants_reach_everywhere() -> None:
    assert all(plant.arm_reach_m == math.inf for name, plant in PLANTS.items() if name != "arm-reach")
    assert plant_named("arm:arm_reach_m=0.82") == PLANTS["arm-reach"]
    assert Plant().arm_reach_m == math.inf


# Commands


@pytest.mark.parametrize("n_epm", [2, 3])
def test_projection_is_feasible_idempotent_and_keeps_moments(rng: np.random.Generator, n_epm: int) -> None:
    """Random poses, many of them with near or coincident centres."""
    system, told_moved = System(n_epm=n_epm), 0
    for trial in range(400):
        epms = anywhere(rng, system)
        if trial % 2:
            epms[:, :3] = epms[0, :3] + rng.normal(0.0, 10.0 ** rng.integers(-12, -1), (n_epm, 3))
        before = epms.copy()
        moved = project(epms, system)
        told_moved += moved
        radii = np.linalg.norm(epms[:, :3], axis=-1)
        assert system.r_min_m - 1e-9 <= radii.min() <= radii.max() <= system.r_max_m + 1e-9
        assert nearest_pair(epms[:, :3]) >= system.gap_min_m - 1e-9
        assert beyond(epms[:, :3]) <= 1e-9
        np.testing.assert_array_equal(epms[:, 3:], before[:, 3:])
        assert moved or np.abs(epms - before).max() <= 1e-3  # near centres may be clipped to the least radius
        again = epms.copy()
        assert not project(again, system)
        np.testing.assert_allclose(again, epms, atol=2e-9)
    assert 200 < told_moved < 400


@pytest.mark.parametrize(("distance", "nearest"), [(0.83, 0.82), (0.40, 0.41), (0.5, 0.5)])
def test_a_lone_centre_goes_to_the_nearest_point_of_its_shell(distance: float, nearest: float) -> None:
    """On the line from the shoulder; the other stays."""
    base, line = np.array(shoulder(SHELL, 0, 2)), np.array([0.0, -0.6, -0.8])
    epms = np.array([[*(base + distance * line), 1.0, 0.0, 0.0], [0.2, -0.3, 0.1, 0.0, 1.0, 0.0]])
    if distance > 0.8:
        line = np.array([0.5, -0.7, -math.sqrt(0.26)])
        epms[0, :3] = base + distance * line
    expected = epms.copy()
    expected[0, :3] = base + nearest * line
    assert project(epms, System()) == (distance != nearest)
    np.testing.assert_allclose(epms, expected, atol=1e-12)


def test_commands_beyond_reach_are_projected_and_told() -> None:
    """In every mode that tells poses; on plants whose EPMs jump, too, which begin at home within reach."""
    far = from_cartesian([[0.1, -0.4, -0.2], [0.3, 0.0, 0.3]], [[1, 0, 0], [0, 0, 1]])
    near = from_cartesian([[0.0, 0.1, 0.2], [0.3, 0.0, 0.3]], [[1, 0, 0], [0, 0, 1]])
    for plant in ("paper:arm_reach_m=0.82", "arm-reach"):
        env = TwoRobots(scenario="approach-60", plant=plant, action="pose")
        for pose, projected in ((far, True), (near, False)):
            env.reset(seed=0)
            info = env.step(pose_to_action(pose, System()))[4]
            assert info["projected"] == projected
            assert beyond(to_cartesian(info["epm_pose"])[0]) <= 1e-9
    for mode, size in (("home", 10), ("step", 10), ("wrench", 6)):
        actions = Actions(mode, System(), shell=SHELL)  # type: ignore[arg-type]
        measured = np.zeros((50, 2, 3))
        measured[:, :, 2] = np.linspace(-3.0, 3.0, 50)[:, None]
        measured[:, 0, 0], measured[:, 1, 0] = -0.04, 0.04
        targets, moved = actions.to_epms(
            np.random.default_rng(0).uniform(-1, 1, (50, size)), measured, actions.home(measured)
        )
        assert beyond(targets[..., :3]) <= 1e-9
        assert moved.any()


def test_an_episode_begins_within_reach() -> None:
    """At home where commands act at once; else at poses that hold the robots, sought until the arms reach them."""
    for plant in ("paper:arm_reach_m=0.82", "arm-reach"):
        env = TwoRobots(plant=plant)
        for seed in range(10):
            assert beyond(to_cartesian(env.reset(seed=seed)[1]["epm_pose"])[0]) <= 1e-9


def test_where_epms_accelerate_an_episode_begins_as_near_home_as_robots_can_be_held() -> None:
    """Whatever home is: the mean way from either home is least for the plant that has it."""
    ways = []
    for plant in ("arm", "arm:home_turn_rad=0.977"):
        held = TwoRobots("approach-60", plant).reset(seed=0)[1]["epm_pose"]
        homes = [home_pose(2, plant_named(name).home_turn_rad) for name in ("arm", "arm:home_turn_rad=0.977")]
        ways.append([np.linalg.norm(to_cartesian(held)[0] - to_cartesian(home)[0]) for home in homes])
    assert ways[0][0] < ways[0][1]
    assert ways[1][1] < ways[1][0]


def test_a_start_that_no_arm_can_hold_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Robots that head backwards: the first poses found are out of reach, and no others are sought."""
    reference = shaped("approach", 0.060).at(0.0) + np.array([0.0, 0.0, 3.0])
    first = holding_epms(reference, System(), Shell.of(System(), PLANTS["arm"]))
    assert beyond(first[:, :3]) > 0.0
    assert beyond(holding_epms(reference, System(), SHELL)[:, :3]) <= 0.0
    monkeypatch.setattr(magenv.starts, "_TURNS", 1)
    must_be = "so large that EPMs within reach hold the robots at the start"
    with pytest.raises(ValueError, match=told("arm_reach_m", must_be, 0.82)):
        holding_epms(reference, System(), SHELL)


@pytest.mark.parametrize("action", ["home", "pose"])
def test_arms_that_reach_everywhere_are_no_limit(rng: np.random.Generator, action: Any) -> None:
    """The same bits with a shell so wide that nothing is beyond it."""
    actions, seen = rng.uniform(-0.2, 0.2, (3, 8, 10)).astype(np.float32), []
    for plant in ("arm", "arm:arm_reach_m=5,arm_reach_min_m=0"):
        envs = TwoRobotsVector(8, scenario="approach-60", plant=plant, action=action, control_hz=10.0)
        observations = [envs.reset(seed=5)[0], *(envs.step(each)[0] for each in actions)]
        seen.append(np.array(observations).tobytes())
    assert seen[0] == seen[1]


def test_a_batch_equals_single_episodes(rng: np.random.Generator) -> None:
    arguments: dict[str, Any] = {"scenario": "approach-60", "plant": "arm-reach", "action": "pose", "control_hz": 10.0}
    envs, one = TwoRobotsVector(5, **arguments), TwoRobots(**arguments)
    assert envs.reset(seed=3)[0][2].tobytes() == one.reset(seed=5)[0].tobytes()
    for action in rng.uniform(-1, 1, (3, 5, 10)).astype(np.float32):
        assert envs.step(action)[0][2].tobytes() == one.step(action[2])[0].tobytes()
