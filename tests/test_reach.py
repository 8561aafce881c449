"""What the arms reach: the shell, commands within it, ways within it, plans within it."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest
from messages import told
from numpy.typing import NDArray

import magenv.starts
from magenv.actions import Actions, pose_to_action
from magenv.env import TwoRobots
from magenv.forecast import Course
from magenv.manoeuvre import Arms, allow, move
from magenv.params import PLANTS, Plant, System, TaskParams, plant_named
from magenv.poses import from_cartesian, pose_bounds, to_cartesian
from magenv.reach import Shell, project_reach, room, shoulder, stays
from magenv.starts import holding_epms
from magenv.trajectories import approach
from magenv.vector_env import TwoRobotsVector
from magenv.ways import way_round
from magenv.world import World

Floats = NDArray[np.float64]

PLANT = dataclasses.replace(PLANTS["arm-reach"], latency_s=0.0)
"""Commands act at once."""
SHELL = Shell.of(System(), PLANT)
H = PLANT.substep_s
FREE = TaskParams(control_hz=1.0 / H, loss_distance_m=10.0)
"""A hold is one substep, so that every one is seen; the robots may go where they like."""
PASSING = 1e6
"""Attraction (N) that lets EPMs pass each other at 27 mm: each goes as if alone."""


def away(centres: Floats) -> Floats:
    """Distances (..., N) of centres (..., N, 3) from their arms' shoulders."""
    n_epm = centres.shape[-2]
    bases = np.array([shoulder(SHELL, k, n_epm) for k in range(n_epm)])
    distances: Floats = np.linalg.norm(centres - bases, axis=-1)
    return distances


def beyond(centres: Floats) -> float:
    """By how much centres (..., N, 3) are out of reach, m."""
    distances = away(centres)
    return float(max(SHELL.inner - distances.min(), distances.max() - SHELL.outer))


def nearest_pair(centres: Floats) -> float:
    """Least distance of two EPMs of (..., N, 3)."""
    pairs = itertools.combinations(range(centres.shape[-2]), 2)
    return min(float(np.linalg.norm(centres[..., j, :] - centres[..., k, :], axis=-1).min()) for j, k in pairs)


def anywhere(rng: np.random.Generator, system: System) -> Floats:
    """EPMs (N, 6) anywhere within the bounds of poses."""
    return np.concatenate(to_cartesian(rng.uniform(*pose_bounds(system))), axis=-1)


def project(epms: Floats, system: System) -> bool:
    return bool(project_reach(epms, system.r_min_m, system.r_max_m, system.gap_min_m, SHELL))


def within(rng: np.random.Generator, system: System) -> Floats:
    """Allowed EPMs (N, 6)."""
    epms = anywhere(rng, system)
    project(epms, system)
    return epms


def arcs(rng: np.random.Generator, size: int) -> Any:
    """Ways of a first EPM: unit vector, that at right angles to it, angle; and shares of it, directions there."""
    shares = np.linspace(0.0, 1.0, 400)
    for _ in range(size):
        u, v = rng.normal(size=(2, 3))
        u /= np.linalg.norm(u)
        v = v / np.linalg.norm(v) if rng.random() < 0.5 else u + 0.03 * v
        angle, across = way_round(tuple(u), tuple(v / np.linalg.norm(v)))
        turned = np.cos(shares * angle)[:, None] * u + np.sin(shares * angle)[:, None] * np.array(across)
        yield tuple(u), across, angle, shares, turned


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


def test_a_start_that_no_arm_can_hold_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Robots that head backwards: the first poses found are out of reach, and no others are sought."""
    reference = approach(0.060).at(0.0) + np.array([0.0, 0.0, 3.0])
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


# Ways


def test_room_is_the_greatest_radius_all_the_way_round(rng: np.random.Generator) -> None:
    base = shoulder(SHELL, 0, 2)
    for u, across, angle, _, turned in arcs(rng, 200):
        radius = room(SHELL, base, u, across, angle)
        distances = np.linalg.norm(radius * turned - base, axis=-1)
        inside = np.linspace(0.15, radius, 20)[:, None, None] * turned
        assert np.linalg.norm(inside - base, axis=-1).max() <= SHELL.outer + 1e-12
        assert np.linalg.norm(inside - base, axis=-1).min() >= SHELL.inner - 1e-12
        assert min(SHELL.outer - distances.max(), distances.min() - SHELL.inner) < 1e-5  # between samples it touches


def test_a_way_that_stays_is_within_reach(rng: np.random.Generator) -> None:
    """Nothing that leaves is said to stay; of short ways, nothing that stays by 10 micrometres is said to leave."""
    base, found = shoulder(SHELL, 0, 2), np.zeros(2, np.int64)
    for u, across, angle, shares, turned in arcs(rng, 2000):
        near, far = rng.uniform(0.15, 0.5, 2)
        if angle < 0.1:
            far = near + rng.normal(0.0, 0.01)
        far = min(far, room(SHELL, base, tuple(turned[-1]), across, 0.0))
        near = min(near, room(SHELL, base, u, across, 0.0))
        distances = np.linalg.norm((near + shares * (far - near))[:, None] * turned - base, axis=-1)
        spare = min(SHELL.outer - distances.max(), distances.min() - SHELL.inner)
        if stays(SHELL, base, u, across, angle, near, far, 0.0):
            assert spare > -1e-12
            found[0] += 1
        elif angle < 0.1:
            assert spare < 1e-5
            found[1] += 1
    assert found.min() > 100


def travelled(system: System, draws: Floats, substeps: int) -> Floats:
    """EPMs after each substep (K, n, N, 6), from the first of the draws (G, n, N, 6) towards each of the others."""
    world, trajectory = World(draws.shape[1], system, PLANT, FREE), approach(0.060)
    robots = np.zeros((2, 6))
    robots[:, :3] = trajectory.at(0.0)
    for row, epms in enumerate(draws[0]):
        world.start(row, trajectory, robots, epms)
    path = [world.epms.copy()]
    for goals in draws[1:]:
        for _ in range(substeps):
            world.step(goals, np.ones(len(goals), np.bool_))
            path.append(world.epms.copy())
    return np.array(path)


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("substeps", [20, 110])
def test_limits_hold_all_the_way(rng: np.random.Generator, n_epm: int, substeps: int) -> None:
    """Reach, radii, gap and speeds, between random allowed poses, the command changed before it is reached."""
    system = System(n_epm=n_epm)
    way = travelled(system, np.array([[within(rng, system) for _ in range(30)] for _ in range(4)]), substeps)
    centres, moments = way[..., :3], way[..., 3:]
    radii = np.linalg.norm(centres, axis=-1)
    assert beyond(centres) < 2e-9
    assert radii.min() > system.r_min_m - 1e-9
    assert radii.max() < system.r_max_m + 1e-9
    assert nearest_pair(centres) > system.gap_min_m - 2e-9
    assert np.linalg.norm(np.diff(centres, axis=0), axis=-1).max() < PLANT.epm_speed_mps * H * (1.0 + 1e-8)
    turned = np.linalg.norm(np.cross(moments[1:], moments[:-1]), axis=-1)
    assert turned.max() < math.sin(PLANT.epm_turn_radps * H) * (1.0 + 1e-8)


def test_every_goal_within_reach_is_reached_with_the_acceleration_of_the_arm(rng: np.random.Generator) -> None:
    """Each EPM as if alone; many a way leads round what is out of reach, by parts from rest to rest."""
    system = System(attraction_max_n=PASSING)
    draws = np.array([[within(rng, system) for _ in range(100)] for _ in range(2)])
    way = travelled(system, draws, 800)
    centres = way[..., :3]
    near = np.linalg.norm(centres[:, :, 0] - centres[:, :, 1], axis=-1).min(axis=0) < system.gap_min_m + 1e-2
    assert beyond(centres) < 2e-9
    np.testing.assert_array_equal(way[-1][~near], draws[-1][~near])
    speed = np.linalg.norm(np.diff(centres[:, ~near], axis=0), axis=-1) / H
    changes = np.abs(np.diff(speed, axis=0)) / H
    # Radius and angle go in step: in space, at angle p to the radius r, speed v changes by v^2 cos p sin^2 p / r too.
    assert changes.max() < 1.01 * PLANT.epm_acceleration_mps2 + 0.385 * PLANT.epm_speed_mps**2 / system.r_min_m
    rests = (speed[1:-1] < speed[:-2]) & (speed[1:-1] < speed[2:]) & (speed[1:-1] < 2 * PLANT.epm_acceleration_mps2 * H)
    assert rests.any(axis=0).mean() > 0.2
    assert rests.sum(axis=0).max() <= 2


# Plans


@pytest.mark.parametrize("n_epm", [2, 3])
def test_what_is_allowed_is_within_reach_all_the_way_as_foreseen(rng: np.random.Generator, n_epm: int) -> None:
    """From commands to wished-for ones that are mostly beyond reach, by steps of a tenth of a second.

    What is allowed is told as an action and moves the EPMs as foreseen, is not projected, and is allowed again.
    """
    system, substeps, rows, moves = System(n_epm=n_epm), 20, 20, 25
    arms, motion = Arms.of(system, PLANT, H, substeps), Course.of(n_epm, substeps, True)
    actions = Actions("pose", system, shell=SHELL)
    world, trajectory = World(rows, system, PLANT, FREE), approach(0.060)
    before = np.array([within(rng, system) for _ in range(rows)])
    wished = np.array([anywhere(rng, system) for _ in range(rows)])
    robots, touched, gone = np.zeros((2, 6)), 0, 0.0
    robots[:, :3] = trajectory.at(0.0)
    for row in range(rows):
        allow(arms, before[row].copy(), before[row])
        world.start(row, trajectory, robots, before[row])
    for _ in range(moves):
        commands, foreseen = wished.copy(), np.empty((substeps, rows, n_epm, 6))
        for row in range(rows):
            allow(arms, before[row], commands[row])
            again = commands[row].copy()
            allow(arms, before[row], again)
            np.testing.assert_allclose(again, commands[row], atol=1e-9)
            move(arms, before[row], commands[row], np.empty((0, n_epm, 6, 5)), motion)
            foreseen[:, row] = motion.path
        poses = np.stack([pose_to_action(from_cartesian(each[:, :3], each[:, 3:]), system) for each in commands])
        targets, projected = actions.to_epms(poses.astype(np.float64), np.zeros((rows, 2, 3)), world.epms)
        assert beyond(targets[..., :3]) < 0.0
        roomy = np.array([nearest_pair(each[:, :3]) > system.gap_min_m + 0.02 for each in commands])
        assert not projected[roomy].any()
        path = [world.epms.copy()]
        for _ in range(substeps):
            world.step(targets, np.ones(rows, np.bool_))
            path.append(world.epms.copy())
        seen = 0.5 * (np.array(path[1:]) + np.array(path[:-1]))
        np.testing.assert_allclose(seen[:, roomy], foreseen[:, roomy], rtol=0, atol=1e-5)
        spare = np.minimum(away(commands[..., :3]) - SHELL.inner, SHELL.outer - away(commands[..., :3]))
        touched += int((spare < 1.1e-5).sum())
        gone += float(np.linalg.norm(commands[..., :3] - before[..., :3], axis=-1).mean())
        world.epms[:] = commands  # the next begins where this one ends, without what it was rounded by
        before = commands
    assert touched > 20
    assert gone > 0.4 * moves * 0.0125  # what may be gone in a tenth of a second is 12.5 mm


def test_the_wish_to_pass_the_bound_leads_along_it() -> None:
    """A goal out of reach round the corner of a shell is approached as near as may be, not given up at the bound."""
    system, arms = System(), Arms.of(System(), PLANT, H, 20)
    base = np.array(shoulder(SHELL, 0, 2))
    before = np.array([[0.25, 0.2, 0.25, 1.0, 0.0, 0.0], [0.0, -0.3, -0.1, 0.0, 1.0, 0.0]])
    wished = before.copy()
    wished[0, :3] = [-0.25, 0.42, 0.1]  # 0.43 m from the shoulder; what is in between is too near for it
    start = before.copy()
    for _ in range(120):
        command = wished.copy()
        allow(arms, before, command)
        assert SHELL.inner < np.linalg.norm(command[0, :3] - base)
        before = command
    project(wished, system)
    assert np.linalg.norm(before[0, :3] - wished[0, :3]) < 0.05 * np.linalg.norm(start[0, :3] - wished[0, :3])


def test_default_plants_reach_everywhere() -> None:
    assert all(plant.arm_reach_m == math.inf for name, plant in PLANTS.items() if name != "arm-reach")
    assert plant_named("arm:arm_reach_m=0.82") == PLANTS["arm-reach"]
    assert Plant().arm_reach_m == math.inf
