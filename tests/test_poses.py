"""Poses of the EPMs: forms, moments, least gap, projection, home configuration."""

from __future__ import annotations

import itertools
import math

import magpylib
import numpy as np
import pytest
from messages import refusal
from numpy.typing import NDArray

from magenv.actions import Actions
from magenv.dipole import field
from magenv.params import System, plant_named
from magenv.poses import (
    HOME_RADIUS_M,
    HOME_TILT_RAD,
    from_cartesian,
    home_pose,
    pose_bounds,
    project,
    robots_frame,
    to_cartesian,
)

Floats = NDArray[np.float64]


def gaps(pose: Floats) -> Floats:
    """Distances of all pairs of EPM centres in m."""
    centres, _ = to_cartesian(pose)
    return np.array([np.linalg.norm(a - b) for a, b in itertools.combinations(centres, 2)])


def assert_feasible(pose: Floats, system: System) -> None:
    assert np.isfinite(pose).all()
    radii = pose[2::5]
    assert radii.min() >= system.r_min_m - 1e-9
    assert radii.max() <= system.r_max_m + 1e-9
    assert gaps(pose).min(initial=np.inf) >= system.gap_min_m - 1e-9


def on_one_ray(radii: list[float], azimuth: float = 0.0, elevation: float = 0.0) -> Floats:
    return np.array([[azimuth, elevation, r, 0.3, -0.2] for r in radii]).reshape(-1)


# Moments and gap


@pytest.mark.parametrize(("n_epm", "moment"), [(2, 925.0), (3, 616.7)])
def test_moments(n_epm: int, moment: float) -> None:
    system = System(n_epm=n_epm)
    assert system.ipm_moment_am2 == pytest.approx(0.1156, rel=1e-3)
    assert system.epm_moment_am2 == pytest.approx(moment, rel=1e-4)
    assert n_epm * system.epm_moment_am2 == pytest.approx(2 * system.reference_epm.moment_am2, rel=1e-12)


@pytest.mark.parametrize(("n_epm", "gap"), [(2, 0.269), (3, 0.2196)])
def test_attraction_at_the_gap_is_ten_kilograms(n_epm: int, gap: float) -> None:
    """The 98.1 N by magpylib's force of one dipole on the other, coaxial; turned in any other way they pull less."""
    system = System(n_epm=n_epm)
    assert system.gap_min_m == pytest.approx(gap, abs=5e-4)
    first = magpylib.misc.Dipole(moment=(system.epm_moment_am2, 0, 0))
    second = magpylib.misc.Dipole(moment=(system.epm_moment_am2, 0, 0), position=(system.gap_min_m, 0, 0))
    force, _ = magpylib.getFT(first, second)
    np.testing.assert_allclose(force, [-98.1, 0, 0], rtol=1e-6, atol=1e-4)
    directions = np.random.default_rng(0).normal(size=(50, 2, 3))
    directions *= system.epm_moment_am2 / np.linalg.norm(directions, axis=-1, keepdims=True)
    for a, b in directions:
        first.moment, second.moment = a, b
        assert np.linalg.norm(magpylib.getFT(first, second)[0]) <= 98.1 * (1 + 1e-6)


# Forms


@pytest.mark.parametrize("n_epm", [1, 2, 3, 4])
def test_pose_and_cartesian_form_are_inverse(rng: np.random.Generator, n_epm: int) -> None:
    low, high = pose_bounds(System(n_epm=n_epm))
    poses = rng.uniform(low, high, (50, 5 * n_epm))
    centres, directions = to_cartesian(poses)
    assert centres.shape == directions.shape == (50, n_epm, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(from_cartesian(centres, directions), poses, atol=1e-12)


def test_pose_is_the_papers_order() -> None:
    """Azimuth, elevation, radius of the centre; azimuth and elevation of the moment."""
    centres, directions = to_cartesian([math.pi / 2, 0.0, 0.2, 0.0, math.pi / 2, 0.0, math.pi / 6, 0.4, math.pi, 0.0])
    np.testing.assert_allclose(centres, [[0, 0.2, 0], [0.4 * math.cos(math.pi / 6), 0, 0.2]], atol=1e-15)
    np.testing.assert_allclose(directions, [[0, 0, 1], [-1, 0, 0]], atol=1e-15)


# Projection


@pytest.mark.parametrize("n_epm", [2, 3])
def test_projection_is_feasible_idempotent_and_keeps_moments(rng: np.random.Generator, n_epm: int) -> None:
    """Random poses far beyond the bounds, many of them with near or coincident centres."""
    system = System(n_epm=n_epm)
    for trial in range(400):
        pose = rng.uniform([-4, -2, 0.01, -4, -2], [4, 2, 0.8, 4, 2], (n_epm, 5))
        if trial % 2:
            pose[:, :3] = pose[0, :3] + rng.normal(0.0, 10.0 ** rng.integers(-12, -1), (n_epm, 3))
        flat = pose.reshape(-1)
        result, _ = project(flat, system)
        assert_feasible(result, system)
        np.testing.assert_allclose(to_cartesian(result)[1], to_cartesian(flat)[1], atol=1e-14)
        again, moved = project(result, system)
        np.testing.assert_allclose(to_cartesian(again)[0], to_cartesian(result)[0], atol=2e-9)
        assert not moved


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("radius", [0.15, 0.3, 0.5, 0.05, 0.9])
@pytest.mark.parametrize("elevation", [0.0, 0.4, math.pi / 2, -math.pi / 2])
def test_projection_parts_coincident_centres(n_epm: int, radius: float, elevation: float) -> None:
    system = System(n_epm=n_epm)
    result, moved = project(on_one_ray([radius] * n_epm, 0.3, elevation), system)
    assert moved
    assert_feasible(result, system)


@pytest.mark.parametrize("radii", [[0.15, 0.2], [0.15, 0.15], [0.5, 0.4], [0.5, 0.15], [0.3, 0.31]])
@pytest.mark.parametrize("azimuth", [0.0, 0.7])
def test_projection_parts_two_epms_on_one_ray(radii: list[float], azimuth: float) -> None:
    assert_feasible(project(on_one_ray(radii, azimuth), System(n_epm=2))[0], System(n_epm=2))


@pytest.mark.parametrize("radii", [[0.15, 0.325, 0.5], [0.15, 0.2, 0.5], [0.2, 0.3, 0.4], [0.5, 0.5, 0.3]])
@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, 0.0), (0.0, math.pi / 2), (0.7, 0.2)])
def test_projection_parts_three_epms_on_one_ray(radii: list[float], azimuth: float, elevation: float) -> None:
    """No room for three on one ray: the projection must leave it."""
    system = System(n_epm=3)
    assert_feasible(project(on_one_ray(radii, azimuth, elevation), system)[0], system)


def test_projection_moves_both_alike_along_their_line() -> None:
    system = System(n_epm=2)
    before = from_cartesian([[0.30, -0.05, 0.02], [0.31, 0.06, 0.0]], [[1, 0, 0], [0, 0, 1]])
    after, moved = project(before, system)
    (a0, b0), (a1, b1) = to_cartesian(before)[0], to_cartesian(after)[0]
    line = (b0 - a0) / np.linalg.norm(b0 - a0)
    assert moved
    np.testing.assert_allclose(a1 - a0, -(b1 - b0), atol=1e-12)
    np.testing.assert_allclose(np.cross(b1 - b0, line), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(b1 - a1), system.gap_min_m, rtol=1e-9)
    assert (b1 - b0) @ line > 0


def test_projection_leaves_allowed_poses_alone() -> None:
    for n_epm in (2, 3):
        pose = home_pose(n_epm)
        result, moved = project(pose, System(n_epm=n_epm))
        assert not moved
        np.testing.assert_allclose(result, pose, atol=1e-14)


def test_projection_flag_means_the_gap_alone() -> None:
    """Clipping a radius is no projection of the gap."""
    pose = home_pose(2)
    pose[2], pose[7] = 0.01, 0.8
    result, moved = project(pose, System())
    assert not moved
    np.testing.assert_allclose(result[[2, 7]], [0.15, 0.5])


def test_projection_of_a_centre_without_direction_is_finite() -> None:
    result, _ = project(np.array([0, 0, 0.0, 0, 0, 1, 0, 0.3, 0, 0]), System())
    assert_feasible(result, System())


# Home configuration


def test_home_for_two_epms_is_broadside_and_opposite() -> None:
    centres, directions = to_cartesian(home_pose(2))
    tilt = math.radians(34)
    expected = HOME_RADIUS_M * np.array([0.0, math.cos(tilt), math.sin(tilt)])
    np.testing.assert_allclose(centres, [expected, -expected], atol=1e-15)
    np.testing.assert_allclose(directions, [[-1, 0, 0]] * 2, atol=1e-15)
    assert pytest.approx(0.2) == HOME_RADIUS_M


@pytest.mark.parametrize("turn", [0.0, -HOME_TILT_RAD[2], 0.5 * math.pi - HOME_TILT_RAD[2]])
@pytest.mark.parametrize("n_epm", [2, 3])
def test_home_field_points_along_the_heading(n_epm: int, turn: float) -> None:
    centres, directions = to_cartesian(home_pose(n_epm, turn))
    moment = System(n_epm=n_epm).epm_moment_am2
    b = field(moment * directions, centres, [0.0, 0.0, 0.0])
    np.testing.assert_allclose(b[:, 1:], 0.0, atol=1e-12)
    assert (b[:, 0] > 0).all()


def home_centres(actions: Actions, heading_1: Floats, heading_2: Floats) -> Floats:
    """Home EPMs (n, N, 6) of robots with these headings (n,)."""
    measured = np.zeros((len(heading_1), 2, 3))
    measured[:, 0, 2], measured[:, 1, 2] = heading_1, heading_2
    return actions.home(measured)


def test_a_plant_may_turn_home_about_the_heading() -> None:
    """On a level, and one above the other: the first to the left of the robots, and above them."""
    for turn, place in ((-0.593, [0.0, 0.2, 0.0]), (0.977, [0.0, 0.0, 0.2])):
        actions = Actions("home", System(), plant=plant_named(f"paper:home_turn_rad={turn}"))
        epms = actions.home(np.zeros((1, 2, 3)))[0]
        np.testing.assert_allclose(epms[:, :3], [place, [-x for x in place]], atol=2e-4)
        np.testing.assert_array_equal(epms, actions.to_epms(np.zeros((1, 10)), np.zeros((1, 2, 3)), epms[None])[0][0])
    for turn in ("4", "nan"):
        assert "home_turn_rad must be a number from -pi to pi" in refusal(
            lambda turn=turn: plant_named(f"paper:home_turn_rad={turn}")  # type: ignore[misc]
        )


@pytest.mark.parametrize("n_epm", [2, 3])
def test_home_is_feasible_and_continuous_for_every_pair_of_headings(n_epm: int) -> None:
    """No jump between neighbours on a grid that holds parallel, antiparallel and orthogonal pairs."""
    system = System(n_epm=n_epm)
    actions = Actions("home", system)
    step = 2 * math.pi / 720
    one, two = np.meshgrid(np.arange(-360, 361, 6) * step, np.arange(-360, 361) * step, indexing="ij")
    epms = home_centres(actions, one.ravel(), two.ravel()).reshape(*one.shape, n_epm, 6)
    assert np.isfinite(epms).all()
    radii = np.linalg.norm(epms[..., :3], axis=-1)
    np.testing.assert_allclose(radii, HOME_RADIUS_M, rtol=1e-12)
    for i, j in itertools.combinations(range(n_epm), 2):
        assert np.linalg.norm(epms[..., i, :3] - epms[..., j, :3], axis=-1).min() > system.gap_min_m
    # The frame turns by at most 1 / (1 - 0.8) times what a heading does.
    direction = epms[..., 3:]
    assert np.linalg.norm(np.diff(direction, axis=1), axis=-1).max() < 5.1 * step
    assert np.linalg.norm(np.diff(direction, axis=0), axis=-1).max() < 5.1 * 6 * step
    np.testing.assert_allclose(epms[:, 0], epms[:, -1], atol=1e-12)
    np.testing.assert_allclose(epms[0], epms[-1], atol=1e-12)


@pytest.mark.parametrize("heading", [0.0, 1.0, math.pi, -math.pi / 2])
def test_home_is_continuous_at_antiparallel_headings(heading: float) -> None:
    actions = Actions("home", System())
    tiny = np.array([-1e-9, 0.0, 1e-9])
    epms = home_centres(actions, np.full(3, heading), heading + math.pi + tiny)
    np.testing.assert_allclose(epms, epms[[1, 1, 1]], atol=1e-8)
    np.testing.assert_allclose(epms[1, :, 3:], [[-math.cos(heading), -math.sin(heading), 0]] * 2, atol=1e-12)


def test_robots_frame_is_the_mean_heading_of_parallel_robots_and_turns_with_them(rng: np.random.Generator) -> None:
    for heading, other, turn in rng.uniform(-3, 3, (50, 3)):
        assert math.cos(robots_frame(heading, heading) - heading) == pytest.approx(1.0, abs=1e-14)
        turned = robots_frame(heading + turn, other + turn) - robots_frame(heading, other) - turn
        assert math.cos(turned) == pytest.approx(1.0, abs=1e-12)
