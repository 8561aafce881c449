"""The four action modes: what is commanded, its limits, its symmetry."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from magenv.actions import (
    STEP_ANGLE_RAD,
    STEP_RADIUS_M,
    WRENCH_FORCE_N,
    WRENCH_TORQUE_NM,
    ActionMode,
    Actions,
    planar_target,
    pose_to_action,
)
from magenv.allocation import allocate
from magenv.home import HOME_ANGLE_RAD, HOME_RADIUS_OUT_M
from magenv.params import System
from magenv.poses import from_cartesian, home_pose, pose_bounds, project, robots_frame, to_cartesian
from magenv.wrench import planar_moments, robot_wrench

Floats = NDArray[np.float64]

MODES: tuple[ActionMode, ...] = get_args(ActionMode)


def measured(rng: np.random.Generator, n: int) -> Floats:
    """Poses (n, 2, 3) of robots in the workspace, over 30 mm apart."""
    robots = np.empty((n, 2, 3))
    robots[..., :2] = rng.uniform(-0.02, 0.02, (n, 2, 2)) + np.array([[-0.035, 0.0], [0.035, 0.0]])
    robots[..., 2] = rng.uniform(-math.pi, math.pi, (n, 2))
    return robots


def assert_allowed(epms: Floats, system: System) -> None:
    """Radii, gaps and unit moments of EPMs (n, N, 6)."""
    radii = np.linalg.norm(epms[..., :3], axis=-1)
    assert radii.min() >= system.r_min_m - 1e-9
    assert radii.max() <= system.r_max_m + 1e-9
    np.testing.assert_allclose(np.linalg.norm(epms[..., 3:], axis=-1), 1.0, rtol=1e-12)
    for i, j in itertools.combinations(range(system.n_epm), 2):
        assert np.linalg.norm(epms[:, i, :3] - epms[:, j, :3], axis=-1).min() >= system.gap_min_m - 1e-9


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("mode", MODES)
def test_commands_are_allowed(rng: np.random.Generator, mode: ActionMode, n_epm: int) -> None:
    """Random and extreme actions, one after the other from where the last left the EPMs."""
    system = System(n_epm=n_epm)
    actions = Actions(mode, system)
    robots = measured(rng, 64)
    epms = actions.home(robots)
    for trial in range(6):
        action = rng.uniform(-1, 1, (64, actions.size))
        epms, projected = actions.to_epms(np.sign(action) if trial % 2 else action, robots, epms)
        assert projected.shape == (64,)
        assert_allowed(epms, system)


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("mode", ["home", "pose", "step"])
def test_every_corner_and_centre_of_the_radii_is_allowed(mode: ActionMode, n_epm: int) -> None:
    """All angles at one value, radii at their ends and middle: EPMs on one ray are among these."""
    system = System(n_epm=n_epm)
    actions = Actions(mode, system)
    rows = []
    for angle in (-1.0, 0.0, 1.0):
        for radii in itertools.product((-1.0, 0.0, 1.0), repeat=n_epm):
            action = np.full((n_epm, 5), angle)
            action[:, 2] = radii
            rows.append(action.reshape(-1))
    robots = np.zeros((len(rows), 2, 3))
    robots[:, 1, 0] = 0.05
    epms, _ = actions.to_epms(np.array(rows), robots, actions.home(robots))
    assert_allowed(epms, system)


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("mode", MODES)
def test_batch_gives_the_bits_of_the_single_call(rng: np.random.Generator, mode: ActionMode, n_epm: int) -> None:
    actions = Actions(mode, System(n_epm=n_epm))
    robots, action = measured(rng, 8), rng.uniform(-1, 1, (8, actions.size))
    epms = actions.home(robots)
    together, flags = actions.to_epms(action, robots, epms)
    for i in range(8):
        one, flag = actions.to_epms(action[i : i + 1], robots[i : i + 1], epms[i : i + 1])
        np.testing.assert_array_equal(one[0], together[i])
        assert flag[0] == flags[i]


def test_present_epms_are_left_alone(rng: np.random.Generator) -> None:
    for mode in MODES:
        actions = Actions(mode, System())
        robots = measured(rng, 2)
        epms = actions.home(robots)
        before = epms.copy(), robots.copy()
        actions.to_epms(rng.uniform(-1, 1, (2, actions.size)), robots, epms)
        np.testing.assert_array_equal(epms, before[0])
        np.testing.assert_array_equal(robots, before[1])


# home


@pytest.mark.parametrize("n_epm", [2, 3])
def test_no_offset_is_home(rng: np.random.Generator, n_epm: int) -> None:
    actions = Actions("home", System(n_epm=n_epm))
    robots = measured(rng, 10)
    epms, projected = actions.to_epms(np.zeros((10, actions.size)), robots, np.zeros((10, n_epm, 6)))
    np.testing.assert_array_equal(epms, actions.home(robots))
    assert not projected.any()


def test_home_offsets_are_angles_and_radii_in_the_robots_frame() -> None:
    actions = Actions("home", System())
    robots = np.array([[[0.03, 0.0, 0.4], [-0.03, 0.0, 1.1]]])
    action = np.array([[0.3, -0.2, 0.5, 0.4, -0.6, 0.1, 0.2, -0.5, -0.3, 0.7]])
    epms, projected = actions.to_epms(action, robots, np.zeros((1, 2, 6)))
    expected = home_pose(2).reshape(2, 5) + HOME_ANGLE_RAD * action.reshape(2, 5)
    expected[:, 2] = 0.2 + 0.5 * HOME_RADIUS_OUT_M, 0.2 - 0.5 * (0.2 - 0.15)
    expected[:, [0, 3]] += robots_frame(0.4, 1.1)
    centres, directions = to_cartesian(expected.reshape(-1))
    assert not projected[0]
    np.testing.assert_allclose(epms[0], np.concatenate([centres, directions], axis=-1), atol=1e-14)


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("angle", [0.6, -2.2, math.pi])
def test_home_turns_with_the_robots(
    rng: np.random.Generator, n_epm: int, angle: float, turn_about_z: Callable[[float], Floats]
) -> None:
    actions, q = Actions("home", System(n_epm=n_epm)), turn_about_z(angle)
    robots, action = measured(rng, 30), rng.uniform(-1, 1, (30, actions.size))
    turned = robots.copy()
    turned[..., :2] = robots[..., :2] @ q[:2, :2].T
    turned[..., 2] += angle
    none = np.zeros((30, n_epm, 6))
    epms, projected = actions.to_epms(action, robots, none)
    turned_epms, turned_projected = actions.to_epms(action, turned, none)
    expected = np.concatenate([epms[..., :3] @ q.T, epms[..., 3:] @ q.T], axis=-1)
    np.testing.assert_allclose(turned_epms, expected, atol=1e-9)
    np.testing.assert_array_equal(projected, turned_projected)
    assert projected.any()
    assert not projected.all()


# pose


@pytest.mark.parametrize("n_epm", [2, 3])
def test_pose_action_commands_the_pose(rng: np.random.Generator, n_epm: int) -> None:
    system = System(n_epm=n_epm)
    actions = Actions("pose", system)
    for _ in range(20):
        pose, _ = project(rng.uniform(*pose_bounds(system)), system)
        pose[2::5] = np.clip(pose[2::5], 0.16, 0.49)
        pose, _ = project(pose, system)
        action = pose_to_action(pose, system)
        assert action.dtype == np.float32
        assert np.abs(action).max() <= 1
        epms, _ = actions.to_epms(action[None].astype(float), np.zeros((1, 2, 3)), np.zeros((1, n_epm, 6)))
        centres, directions = to_cartesian(pose)
        np.testing.assert_allclose(epms[0], np.concatenate([centres, directions], axis=-1), atol=2e-6)


def test_pose_action_spans_the_bounds() -> None:
    system = System()
    actions = Actions("pose", system)
    low, high = pose_bounds(system)
    for action, pose in ((-1.0, low), (1.0, high)):
        row = np.full((1, 10), action)
        row[0, 5] += -action  # the second EPM opposite, or the two would coincide
        pose = pose.copy()
        pose[5] = 0.0
        epms, projected = actions.to_epms(row, np.zeros((1, 2, 3)), np.zeros((1, 2, 6)))
        expected, moved = project(pose, system)
        assert projected[0] == moved
        np.testing.assert_allclose(epms[0, :, :3], to_cartesian(expected)[0], atol=1e-9)


# step


@pytest.mark.parametrize("n_epm", [2, 3])
def test_no_step_keeps_the_epms(rng: np.random.Generator, n_epm: int) -> None:
    actions = Actions("step", System(n_epm=n_epm))
    robots = measured(rng, 10)
    epms = actions.home(robots)
    after, projected = actions.to_epms(np.zeros((10, actions.size)), robots, epms)
    np.testing.assert_allclose(after, epms, atol=1e-15)
    assert not projected.any()


def test_step_is_a_bounded_change_of_each_number(rng: np.random.Generator) -> None:
    actions, robots = Actions("step", System()), np.zeros((1, 2, 3))
    pose = np.array([0.5, 0.2, 0.3, -1.0, 0.4, -2.0, -0.3, 0.25, 2.0, -0.1])
    epms = np.concatenate(to_cartesian(pose), axis=-1)[None]
    action = rng.uniform(-1, 1, (1, 10))
    after, _ = actions.to_epms(action, robots, epms)
    change = from_cartesian(after[0, :, :3], after[0, :, 3:]) - pose
    scale = np.tile([STEP_ANGLE_RAD, STEP_ANGLE_RAD, STEP_RADIUS_M, STEP_ANGLE_RAD, STEP_ANGLE_RAD], 2)
    np.testing.assert_allclose(change, scale * action[0], atol=1e-12)


# wrench


def test_planar_target_is_the_wrench_in_the_magnet_frames(rng: np.random.Generator) -> None:
    for _ in range(20):
        wrench, (one, two), target = rng.normal(size=6), rng.uniform(-4, 4, 2), np.empty(10)
        planar_target(wrench, one, two, target)
        for part, w, heading in zip(target.reshape(2, 5), wrench.reshape(2, 3), (one, two), strict=True):
            c, s = math.cos(heading), math.sin(heading)
            np.testing.assert_allclose(part, [0, w[2], c * w[0] + s * w[1], c * w[1] - s * w[0], 0], atol=1e-15)


def test_wrench_action_gives_what_allocation_can_give(rng: np.random.Generator) -> None:
    """Where ten random starts reach the wrench asked for, the action nearly always does, too."""
    system = System()
    actions = Actions("wrench", system)
    robots = measured(rng, 40)
    action = rng.uniform(-0.3, 0.3, (40, 6))
    epms, projected = actions.to_epms(action, robots, actions.home(robots))
    assert_allowed(epms, system)
    assert not projected.any()
    positions = np.concatenate([robots[..., :2], np.zeros((40, 2, 1))], axis=-1)
    moments = planar_moments(robots[..., 2], system.ipm_moment_am2)
    pose = from_cartesian(epms[..., :3], epms[..., 3:])
    u = robot_wrench(positions, moments, pose, system.epm_moment_am2)
    met = reached = 0
    for row in range(40):
        target = np.empty(10)
        wrench = action[row] * np.tile([WRENCH_FORCE_N, WRENCH_FORCE_N, WRENCH_TORQUE_NM], 2)
        planar_target(wrench, robots[row, 0, 2], robots[row, 1, 2], target)
        if allocate(target, positions[row], moments[row], system).status == "converged":
            reached += 1
            met += np.abs(u[row] - target).max() < 1e-6
    assert reached > 20
    assert met >= 0.9 * reached


def test_wrench_action_has_no_memory_but_the_epms(rng: np.random.Generator) -> None:
    actions = Actions("wrench", System())
    robots, action = measured(rng, 3), rng.uniform(-1, 1, (3, 6))
    epms = actions.home(robots)
    first = actions.to_epms(action, robots, epms)[0]
    actions.to_epms(rng.uniform(-1, 1, (3, 6)), measured(rng, 3), epms)
    np.testing.assert_array_equal(actions.to_epms(action, robots, epms)[0], first)
