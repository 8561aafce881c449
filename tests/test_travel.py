"""EPMs of finite speed: limits kept all the way, the way itself, what it does to the robots."""

from __future__ import annotations

import dataclasses
import math
import pickle
from typing import Any

import numpy as np
import pytest
from lane import magnets
from numpy.typing import NDArray

from magenv.env import TwoRobots
from magenv.params import PLANTS, Plant, System, TaskParams
from magenv.poses import from_cartesian
from magenv.trajectories import shaped
from magenv.vector_env import TwoRobotsVector
from magenv.world import World
from magenv.wrench import planar_moments, robot_wrench

Floats = NDArray[np.float64]

PLANT = PLANTS["moving"]
H = PLANT.substep_s
FREE = TaskParams(control_hz=1.0 / H, loss_distance_m=10.0)
"""A hold is one substep, so that every one is seen; the robots may go where they like."""


def world_of(systems: System, starts: Floats, plant: Plant = PLANT, task: TaskParams = FREE) -> World:
    """A world whose EPMs stand at ``starts`` (n, N, 6), the robots at rest."""
    world, trajectory = World(len(starts), systems, plant, task), shaped("approach", 0.060)
    robots = np.zeros((2, 6))
    robots[:, :3] = trajectory.at(0.0)
    for row, epms in enumerate(starts):
        world.start(row, trajectory, robots, epms)
    return world


def ways(system: System, starts: Floats, goals: Floats, substeps: int, plant: Plant = PLANT) -> Floats:
    """Where the EPMs are after each substep, (substeps + 1, n, N, 6)."""
    world, path = world_of(system, starts, plant), [starts.copy()]
    for _ in range(substeps):
        world.step(goals, np.ones(len(starts), np.bool_))
        path.append(world.epms.copy())
    return np.array(path)


def angle(u: Floats, v: Floats) -> Floats:
    return np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), (u * v).sum(-1))


@pytest.mark.parametrize("n_epm", [2, 3])
def test_limits_hold_all_the_way(rng: np.random.Generator, n_epm: int) -> None:
    """Speeds, radii and least gap, between random allowed poses, the goal changed before it is reached."""
    system = System(n_epm=n_epm)
    draw = np.array([[magnets(rng, system) for _ in range(40)] for _ in range(4)])
    path = [draw[0][None]]
    for goals in draw[1:]:
        path.append(ways(system, path[-1][-1], goals, 120)[1:])
    way = np.concatenate(path)
    centres, moments = way[..., :3], way[..., 3:]
    radii = np.linalg.norm(centres, axis=-1)
    assert radii.min() > system.r_min_m - 1e-9
    assert radii.max() < system.r_max_m + 1e-9
    np.testing.assert_allclose(np.linalg.norm(moments, axis=-1), 1.0, atol=1e-12)
    moved = np.linalg.norm(np.diff(centres, axis=0), axis=-1)
    assert moved.max() < PLANT.epm_speed_mps * H * (1.0 + 1e-8)
    assert moved.max() > PLANT.epm_speed_mps * H * 0.99
    turned_by = angle(moments[1:], moments[:-1]).max() / (PLANT.epm_turn_radps * H)
    assert 0.99 < turned_by < 1.0 + 1e-6
    for k in range(n_epm):
        for j in range(k):
            gaps = np.linalg.norm(centres[:, :, k] - centres[:, :, j], axis=-1)
            assert gaps.min() > system.gap_min_m - 1e-9
            assert gaps.min() < system.gap_min_m + 1e-3, "some pass each other as near as they may"


@pytest.mark.parametrize("n_epm", [2, 3])
def test_epms_arrive_and_stay(rng: np.random.Generator, n_epm: int) -> None:
    """They come to random goals within half as long again as the longest way takes; there they rest."""
    system = System(n_epm=n_epm)
    starts, goals = (np.array([magnets(rng, system) for _ in range(60)]) for _ in range(2))
    longest = math.pi * system.r_max_m / PLANT.epm_speed_mps
    way = ways(system, starts, goals, math.ceil(1.5 * longest / H))
    there = (np.abs(way[-1] - goals) < 2e-9).all(axis=(1, 2))  # the gap of goals is kept within 1e-9 m
    assert there.mean() > 0.95
    np.testing.assert_allclose(way[-2][there], way[-1][there], rtol=0, atol=1e-9)


def turned(start: Floats, goal: Floats, share: Floats) -> Floats:
    """Unit vectors (n, ..., 3) at shares (n,) of the shortest way from start to goal (..., 3)."""
    between = angle(start, goal)[..., None]
    share = share.reshape(-1, *([1] * start.ndim))
    return (np.sin((1.0 - share) * between) * start + np.sin(share * between) * goal) / np.sin(between)


def evenly(start: Floats, goal: Floats, times: Floats) -> tuple[Floats, float]:
    """One EPM (6,) on its way at given times (s): radius and angle in step, top speed where the radius is largest.

    Also the time (s) at which its centre arrives.
    """
    near, far = np.linalg.norm(start[:3]), np.linalg.norm(goal[:3])
    around = angle(start[:3], goal[:3])
    takes = H * math.ceil(
        math.hypot(max(near, far) * around, far - near) / PLANT.epm_speed_mps / H - 1e-9
    )  # whole substeps
    turns = H * math.ceil(angle(start[3:], goal[3:]) / PLANT.epm_turn_radps / H - 1e-9)
    share = np.minimum(times / takes, 1.0)
    radii = (near + share * (far - near))[:, None]
    centres = radii * turned(start[:3] / near, goal[:3] / far, share)
    return np.concatenate([centres, turned(start[3:], goal[3:], np.minimum(times / turns, 1.0))], axis=1), takes


def test_a_way_is_a_great_circle_gone_evenly() -> None:
    """One EPM goes, the other rests far away; the hold ends at the substep at which it arrives, and before."""
    start = np.array([[0.2, 0, 0, 1, 0, 0], [-0.5, 0, 0, 1, 0, 0]], dtype=np.float64)
    goal = start.copy()
    goal[0] = [0.0, 0.3 * math.cos(0.5), 0.3 * math.sin(0.5), 0.0, 1.0, 0.0]
    takes = evenly(start[0], goal[0], np.zeros(1))[1]
    last = round(takes / H)
    for substeps in (1, 2, 40, last - 1, last, last + 3):
        task = TaskParams(control_hz=1.0 / (substeps * H), loss_distance_m=10.0)
        world = world_of(System(), start[None], PLANT, task)
        assert world.substeps == substeps
        world.step(goal[None], np.ones(1, np.bool_))
        expected = evenly(start[0], goal[0], np.array([substeps * H]))[0][0]
        np.testing.assert_allclose(world.epms[0, 0], expected, rtol=0, atol=1e-13)
        assert (world.epms[0, 0, :3] == goal[0, :3]).all() == (substeps >= last)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_opposite_goals_are_reached(axis: int) -> None:
    """To the other side of the workspace and to the opposite moment there is no shortest way: one is taken."""
    start = np.zeros((1, 2, 6))
    start[0, 0, axis], start[0, 0, 3 + axis] = 0.2, 1.0
    start[0, 1, (axis + 1) % 3], start[0, 1, 3] = 0.5, 1.0
    goal = start.copy()
    goal[0, 0] *= -1.0
    way = ways(System(), start, goal, math.ceil(math.pi * 0.5 / PLANT.epm_speed_mps / H))
    np.testing.assert_array_equal(way[-1], goal)
    assert np.linalg.norm(way[:, 0, 0, :3], axis=1).min() > 0.15 - 1e-9


def test_epms_act_on_the_way(rng: np.random.Generator) -> None:
    """The robots' speeds after a hold, against a sum of the wrenches along the way, the robots too heavy to move."""
    heavy = dataclasses.replace(
        PLANT, body=dataclasses.replace(PLANT.body, mass_kg=1e3, inertia_kgm2=1e3, drag_linear_nspm=0.0)
    )
    system, task = System(), TaskParams(loss_distance_m=10.0)
    starts, goals = (np.array([magnets(rng, system) for _ in range(20)]) for _ in range(2))
    world = world_of(system, starts, heavy, task)
    world.step(goals, np.ones(20, np.bool_))
    times = np.linspace(0.0, task.period_s, 1001)
    robots = world_of(system, starts).robots[0, :, :3]
    positions = np.concatenate([robots[:, :2], np.zeros((2, 1))], axis=1)
    moments = planar_moments(robots[:, 2], system.ipm_moment_am2)
    free = 0
    for row in range(20):
        way = np.stack([evenly(starts[row, k], goals[row, k], times)[0] for k in range(2)], axis=1)
        if np.linalg.norm(way[:, 0, :3] - way[:, 1, :3], axis=-1).min() < system.gap_min_m:
            continue  # they give way to each other
        free += 1
        u = robot_wrench(positions, moments, from_cartesian(way[..., :3], way[..., 3:]), system.epm_moment_am2)
        impulse, most = np.trapezoid(u, times, axis=0), np.trapezoid(np.abs(u), times, axis=0)
        for robot in range(2):
            c, s = np.cos(robots[robot, 2]), np.sin(robots[robot, 2])
            _, torque, along, across, _ = impulse[5 * robot : 5 * robot + 5]
            vx, vy, rate = world.robots[row, robot, 3:] * 1e3
            got = np.array([rate, c * vx + s * vy, c * vy - s * vx])
            off, scale = np.abs(got - [torque, along, across]), most[5 * robot + 1 : 5 * robot + 4]
            np.testing.assert_array_less(off, 5e-3 * scale)  # 0.1 % of speed is 0.1 mm of way
    assert free > 5


def test_commands_far_away_act_late(rng: np.random.Generator) -> None:
    """After a hold the EPMs of ``moving`` are on the way where those of ``paper`` are at their goal; info says so."""
    action = rng.uniform(-1, 1, 10).astype(np.float32)
    poses = {}
    for plant in ("paper", "moving"):
        env = TwoRobots(scenario="approach-60", plant=plant, control_hz=10.0)
        start = env.reset(seed=0)[1]["epm_pose"]
        poses[plant] = env.step(action)[4]["epm_pose"]
    assert np.abs(poses["moving"] - start)[[2, 7]].max() <= 0.1 + 1e-9
    assert np.abs(poses["paper"] - poses["moving"]).max() > 0.1


@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5])
def test_moments_stay_unit_vectors_whatever_is_commanded(rng: np.random.Generator, off: float) -> None:
    """Goals always opposite to the present moment, or nearly: the way round is ill-defined, its length is not."""
    system = System()
    starts = np.array([magnets(rng, system) for _ in range(20)])
    world = world_of(system, starts)
    for _ in range(60):
        goals = starts.copy()
        across = np.cross(world.epms[..., 3:], rng.normal(size=(20, 2, 3)))
        goals[..., 3:] = -world.epms[..., 3:] + off * across
        goals[..., 3:] /= np.linalg.norm(goals[..., 3:], axis=-1, keepdims=True)
        before = world.epms.copy()
        world.step(goals, np.ones(20, np.bool_))
        np.testing.assert_allclose(np.linalg.norm(world.epms[..., 3:], axis=-1), 1.0, atol=1e-14)
        np.testing.assert_allclose(
            angle(before[..., 3:], world.epms[..., 3:]), PLANT.epm_turn_radps * H, rtol=6e-3
        )  # 200 or 201 substeps


def test_the_last_substep_is_no_faster() -> None:
    """A goal farther out and round, just within reach by the present radius, but not by the one in between."""
    reach = PLANT.epm_speed_mps * H
    out, around = 0.999 * reach / math.sqrt(3.0), 0.999 * reach * math.sqrt(2.0 / 3.0) / 0.15
    start = np.array([[[0.15, 0, 0, 1, 0, 0], [-0.5, 0, 0, 1, 0, 0]]], dtype=np.float64)
    goal = start.copy()
    goal[0, 0, :2] = (0.15 + out) * math.cos(around), (0.15 + out) * math.sin(around)
    way = ways(System(), start, goal, 3)[:, 0, 0, :3]
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() < reach * (1.0 + 1e-8)


@pytest.mark.parametrize("n_epm", [2, 3])
def test_epms_that_change_places_pass_each_other(n_epm: int) -> None:
    """Head on, in the plane of both: they step aside instead of standing before each other."""
    start = np.array([[[0.25, 0, 0, 1, 0, 0], [0, 0.25, 0, 1, 0, 0], [-0.3, -0.3, 0, 1, 0, 0]]])[:, :n_epm]
    goal = start.copy()
    goal[:, [0, 1]] = start[:, [1, 0]]
    way = ways(System(n_epm=n_epm), start, goal, 600)
    assert np.abs(way[-1] - goal).max() < 2e-9


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e3, "1"])
@pytest.mark.parametrize("name", ["epm_speed_mps", "epm_turn_radps"])
def test_speeds_must_be_positive_and_moderate(name: str, value: object) -> None:
    """Of one alone without limit, or so fast that halfway is nowhere near, no plant can be made."""
    with pytest.raises(ValueError, match="must be a number above 0 and at most"):
        dataclasses.replace(PLANT, **{name: value})


def test_a_batch_equals_its_copies_and_single_episodes() -> None:
    arguments: dict[str, Any] = {"scenario": "approach-60", "plant": "moving", "control_hz": 20.0}
    batch, single = TwoRobotsVector(6, **arguments), TwoRobots(**arguments)
    batch.reset(seed=0)
    single.reset(seed=3)
    size, twin = single.action_space.shape or (0,), None
    for step in range(3):
        actions = np.random.default_rng(step).uniform(-0.3, 0.3, (6, *size)).astype(np.float32)
        if step == 1:
            twin = pickle.loads(pickle.dumps(batch))
        told = batch.step(actions)
        assert told[0][3].tobytes() == single.step(actions[3])[0].tobytes()
        if twin is not None:
            assert told[0].tobytes() == twin.step(actions)[0].tobytes()
        assert not told[2][3]
