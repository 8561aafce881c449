"""Holding two robots still: how close it can be done, how stable it is, stiffness."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from magenv.allocation import component_scales
from magenv.crosstalk import (
    IN_PLANE,
    Pair,
    growth_rates,
    hold,
    holdable_separation,
    most_stable_hold,
    slowest_control_hz,
)
from magenv.params import PLANTS, Body, System, TaskParams
from magenv.poses import to_cartesian
from magenv.stiffness import planar_stiffness
from magenv.trajectories import shaped
from magenv.world import World
from magenv.wrench import planar_moments, robot_wrench

Floats = NDArray[np.float64]

SCALE = component_scales()
TWO, THREE = System(n_epm=2), System(n_epm=3)
BODY = PLANTS["paper"].body


@pytest.mark.parametrize(
    ("system", "first", "angle", "separation"),
    [(TWO, 90.0, 0.0, 0.019), (TWO, 90.0, 180.0, 0.0128), (TWO, 0.0, 0.0, 0.019), (THREE, 90.0, 0.0, 0.019)],
)
def test_holdable_separation_is_the_static_limit(system: System, first: float, angle: float, separation: float) -> None:
    found = holdable_separation(Pair(0.03, angle, first), system, starts=30)
    assert found == pytest.approx(separation, abs=6e-4)


def test_a_hold_leaves_no_wrench() -> None:
    pair = Pair(0.03, 0.0, 60.0)
    found = hold(pair, TWO)
    assert found is not None
    u = robot_wrench(pair.positions, pair.moments(TWO), found.pose, TWO.epm_moment_am2) / SCALE
    far = np.array([0.0, 0.0, 1e9, 0.0, 0.0])
    mutual = robot_wrench(pair.positions, pair.moments(TWO), far, TWO.epm_moment_am2) / SCALE
    assert np.linalg.norm(u) < 1e-6 * np.linalg.norm(mutual)
    assert hold(replace(pair, distance_m=0.011), TWO) is None
    assert math.isnan(holdable_separation(replace(pair, distance_m=0.012), TWO, nearest_m=0.0115, starts=5))


def test_what_the_plane_bears_need_not_vanish() -> None:
    """Two EPMs leave orthogonal robots out-of-plane torques or forces: in the plane alone they can be held."""
    pair = Pair(0.04, 90.0)
    assert hold(pair, TWO, starts=100) is None
    found = hold(pair, TWO, components=IN_PLANE)
    assert found is not None
    u = robot_wrench(pair.positions, pair.moments(TWO), found.pose, TWO.epm_moment_am2) / SCALE
    out_of_plane = [i for i in range(10) if i not in IN_PLANE]
    assert np.abs(u[list(IN_PLANE)]).max() < 1e-6 * np.abs(u[out_of_plane]).max()
    assert holdable_separation(pair, TWO, components=IN_PLANE) == pytest.approx(0.0208, abs=6e-4)
    assert hold(pair, THREE) is not None


def test_pairs_that_can_be_held_near_but_not_far_are_found() -> None:
    pair = Pair(0.06, 75.0)
    assert hold(pair, TWO, starts=100) is None
    assert holdable_separation(pair, TWO, starts=50) == pytest.approx(0.0242, abs=6e-4)


def global_wrench(q: Floats, pose: Floats, system: System) -> Floats:
    """F_x, F_y, tau_z of both robots in the global frame at x, y, heading of both (6)."""
    q = q.reshape(2, 3)
    positions = np.column_stack([q[:, :2], np.zeros(2)])
    u = robot_wrench(positions, planar_moments(q[:, 2], system.ipm_moment_am2), pose, system.epm_moment_am2)
    out = []
    for robot in range(2):
        _, torque, along, across, _ = u[5 * robot : 5 * robot + 5]
        c, s = np.cos(q[robot, 2]), np.sin(q[robot, 2])
        out += [c * along - s * across, s * along + c * across, torque]
    return np.array(out)


@pytest.mark.parametrize("system", [TWO, THREE])
def test_stiffness_is_the_derivative_of_the_wrench(rng: np.random.Generator, system: System) -> None:
    for _ in range(5):
        q = np.concatenate([rng.uniform(-0.04, 0.04, (2, 2)), rng.uniform(-3, 3, (2, 1))], axis=1).ravel()
        pose = np.tile([0.0, 0.0, 0.2, 0.0, 0.0], system.n_epm) + rng.uniform(-0.05, 0.05, 5 * system.n_epm) * 20
        pose[2::5] = rng.uniform(0.15, 0.4, system.n_epm)
        positions = np.column_stack([q.reshape(2, 3)[:, :2], np.zeros(2)])
        moments = planar_moments(q.reshape(2, 3)[:, 2], system.ipm_moment_am2)
        exact = planar_stiffness(positions, moments, pose, system.epm_moment_am2)
        h = 1e-6
        steps = [
            (global_wrench(q + h * e, pose, system) - global_wrench(q - h * e, pose, system)) / (2 * h)
            for e in np.eye(6)
        ]
        np.testing.assert_allclose(exact, np.array(steps).T, rtol=1e-5, atol=1e-7 * np.abs(exact).max())


def test_stiffness_refuses_what_is_not_in_the_plane() -> None:
    pair = Pair(0.05)
    tilted = pair.moments(TWO) + np.array([[0.0, 0.0, 0.01], [0.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="moments must be in the plane"):
        planar_stiffness(pair.positions, tilted, np.zeros(10), 1.0)
    with pytest.raises(ValueError, match=r"pose must be an array of shape \(5 N,\)"):
        planar_stiffness(pair.positions, pair.moments(TWO), np.zeros(4), 1.0)


def test_growth_is_that_of_the_plant() -> None:
    """A hold left alone in the plant: a deviation along the fastest motion grows at the rate that was computed."""
    pair = Pair(0.06, 0.0, 90.0)
    found = hold(pair, TWO)
    assert found is not None
    rate = growth_rates(pair, TWO, found.pose, BODY)[0]
    assert rate.imag == 0
    plant = replace(PLANTS["paper"], substep_s=0.0005)
    task = TaskParams(control_hz=20.0, loss_distance_m=10.0)
    world, centres = World(1, TWO, plant, task), to_cartesian(found.pose)
    epms = np.concatenate(centres, axis=-1)[None]
    robots = np.zeros((2, 6))
    robots[:, 0], robots[:, 2] = pair.positions[:, 0], math.radians(90.0)
    rng = np.random.default_rng(0)
    robots[:, :3] += rng.normal(size=(2, 3)) * [1e-9, 1e-9, 1e-8]
    world.start(0, shaped("approach", 0.06), robots, epms[0])
    still, sizes = robots[:, :3].copy(), []
    still[:, 0], still[:, 1], still[:, 2] = pair.positions[:, 0], 0.0, math.radians(90.0)
    for _ in range(int(12.0 / rate.real / 0.05)):
        world.step(epms, np.ones(1, np.bool_))
        sizes.append(np.linalg.norm(world.robots[0, :, :2] - still[:, :2]))
    late = np.log(sizes)[len(sizes) // 2 :]
    assert np.polyfit(0.05 * np.arange(len(late)), late, 1)[0] == pytest.approx(rate.real, rel=0.03)


def test_near_robots_are_held_unstably_and_drag_slows_their_fall() -> None:
    pair = Pair(0.03, 0.0, 90.0)
    found = hold(pair, TWO)
    assert found is not None
    thin, thick = (growth_rates(pair, TWO, found.pose, Body(drag_linear_nspm=drag))[0].real for drag in (0.15, 0.4))
    assert 0.0 < thick < thin
    assert slowest_control_hz(thin) == pytest.approx(thin / math.log(10.0))
    assert slowest_control_hz(-1.0) == 0.0
    with pytest.raises(ValueError, match="growth must be a number above 1"):
        slowest_control_hz(1.0, growth=1.0)


def test_some_holds_are_stable_in_the_plane_though_none_is_in_space() -> None:
    """Earnshaw: the force's divergence is zero, so that what is stable in the plane is not across it."""
    pair = Pair(0.03, 0.0, 90.0)
    found = most_stable_hold(pair, TWO, BODY, components=IN_PLANE, holds=20, moves=200)
    assert found is not None
    pose, rates = found
    assert rates[-1] < -1.0 < 1.0 < min(rates[:-1])
    assert growth_rates(pair, TWO, pose, BODY)[0].real == rates[-1]
    stiffness = planar_stiffness(pair.positions, pair.moments(TWO), pose, TWO.epm_moment_am2)
    assert np.trace(stiffness[:2, :2]) < 0.0
    assert np.trace(stiffness[3:5, 3:5]) < 0.0
    assert most_stable_hold(Pair(0.011, 0.0, 90.0), TWO, BODY, holds=3, moves=1) is None


def test_a_stable_hold_needs_no_controller() -> None:
    """EPMs that stand still bring robots 30 mm apart back from half a millimetre and three degrees."""
    pair = Pair(0.03, 0.0, 90.0)
    found = most_stable_hold(pair, TWO, BODY, components=IN_PLANE, holds=20, moves=200)
    assert found is not None
    world = World(1, TWO, PLANTS["paper"], TaskParams(loss_distance_m=10.0))
    epms = np.concatenate(to_cartesian(found[0]), axis=-1)
    robots = np.zeros((2, 6))
    robots[:, 0], robots[:, 2] = pair.positions[:, 0], math.radians(90.0)
    still = robots.copy()
    robots[0, :3] += [3e-4, -4e-4, math.radians(3.0)]
    world.start(0, shaped("approach", 0.06), robots, epms)
    for _ in range(20):  # 10 s
        world.step(epms[None], np.ones(1, np.bool_))
    assert np.abs(world.robots[0] - still).max() < 1e-6
