"""The laws of motion: forces, order of the integrator, energy, drag, symmetry."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from lane import SYSTEM, magnets, run, wrenches
from numpy.typing import NDArray

from magenv.dipole import field
from magenv.dynamics import Physics
from magenv.params import Body, Plant, System
from magenv.poses import from_cartesian
from magenv.wrench import planar_moments, robot_wrench

Floats = NDArray[np.float64]

FREE = Plant(body=Body(drag_linear_nspm=0.0, drag_rotational_nmsprad=0.0), workspace_radius_m=10.0)
WIDE = Plant(workspace_radius_m=10.0)


def states(rng: np.random.Generator, n: int = 1) -> Floats:
    """States (n, 2, 6) of moving robots 60 to 100 mm apart."""
    robots = np.zeros((n, 2, 6))
    robots[:, 0, 0], robots[:, 1, 0] = -0.04, 0.04
    robots[..., :2] += rng.uniform(-0.01, 0.01, (n, 2, 2))
    robots[..., 2] = rng.uniform(-math.pi, math.pi, (n, 2))
    robots[..., 3:5] = rng.normal(0.0, 0.02, (n, 2, 2))
    robots[..., 5] = rng.normal(0.0, 1.0, (n, 2))
    return robots


def energy(robots: Floats, epms: Floats, body: Body) -> float:
    """Kinetic energy and that of both moments in the field of the EPMs and of each other, in J."""
    positions = np.concatenate([robots[:, :2], np.zeros((2, 1))], axis=-1)
    moments = planar_moments(robots[:, 2], SYSTEM.ipm_moment_am2)
    kinetic = 0.5 * body.mass_kg * np.sum(robots[:, 3:5] ** 2) + 0.5 * body.inertia_kgm2 * np.sum(robots[:, 5] ** 2)
    external = field(SYSTEM.epm_moment_am2 * epms[:, None, 3:], epms[:, None, :3], positions).sum(axis=0)
    mutual = field(moments[0], positions[0], positions[1])
    return float(kinetic - np.sum(moments * external) - moments[1] @ mutual)


@pytest.mark.parametrize("n_epm", [2, 3])
def test_planar_wrench_is_the_planar_part_of_u(rng: np.random.Generator, n_epm: int) -> None:
    system = System(n_epm=n_epm)
    for robots in states(rng, 20):
        epms = magnets(rng, system)
        out = wrenches(robots, epms, Physics.of(system, WIDE, 1))
        positions = np.concatenate([robots[:, :2], np.zeros((2, 1))], axis=-1)
        pose = from_cartesian(epms[:, :3], epms[:, 3:])
        moments = planar_moments(robots[:, 2], system.ipm_moment_am2)
        u = robot_wrench(positions, moments, pose, system.epm_moment_am2).reshape(2, 5)
        c, s = np.cos(robots[:, 2]), np.sin(robots[:, 2])
        expected = np.stack([c * u[:, 2] - s * u[:, 3], s * u[:, 2] + c * u[:, 3], u[:, 1]], axis=-1)
        np.testing.assert_allclose(out, expected, atol=1e-12 * np.abs(expected).max())


def test_force_between_robots_cancels_to_the_last_bit(rng: np.random.Generator) -> None:
    """Third law in the plant; there are no EPMs here."""
    physics = Physics.of(SYSTEM, WIDE, 1)
    physics.ipm_moment[0] = 0.1, 0.2
    for robots in states(rng, 20):
        out = wrenches(robots, np.zeros((0, 6)), physics)
        np.testing.assert_array_equal(out[0, :2], -out[1, :2])
        dx, dy = robots[1, :2] - robots[0, :2]
        total = out[0, 2] + out[1, 2] + dx * out[1, 1] - dy * out[1, 0]
        assert abs(total) < 1e-12 * np.abs(out).max()


@pytest.mark.parametrize("plant", [WIDE, FREE], ids=["drag", "free"])
def test_integrator_is_of_second_order(rng: np.random.Generator, plant: Plant) -> None:
    """Errors in position, heading and rates fall fourfold with half the step."""
    robots, epms, time = states(rng)[0], magnets(rng), 0.08
    fine = run(robots, epms, plant, time / 10240, 10240)[-1]
    coarse = [run(robots, epms, plant, time / n, n)[-1] for n in (40, 80, 160)]
    for part in (slice(0, 2), slice(2, 3), slice(3, 5), slice(5, 6)):
        errors = [np.linalg.norm(state[:, part] - fine[:, part]) for state in coarse]
        orders = np.log2(np.array(errors[:-1]) / errors[1:])
        np.testing.assert_allclose(orders, 2.0, atol=0.15)


def test_energy_never_grows_without_input(rng: np.random.Generator) -> None:
    """With the EPMs held still drag can only take: at the plant's own substep, from rest, from many starts."""
    plant = WIDE
    for robots in states(rng, 20):
        robots[:, 3:] = 0.0
        epms = magnets(rng)
        path = run(robots, epms, plant, plant.substep_s, 60)
        energies = np.array([energy(state, epms, plant.body) for state in path])
        spent = energies[0] - energies.min()
        assert spent > 0
        assert np.diff(energies).max() < 1e-3 * spent


def test_energy_is_kept_to_second_order_without_drag(rng: np.random.Generator) -> None:
    robots, epms, time = states(rng)[0], magnets(rng), 0.1
    drift = []
    for n in (100, 200, 400):
        path = run(robots, epms, FREE, time / n, n)
        energies = np.array([energy(state, epms, FREE.body) for state in path])
        drift.append(np.abs(energies - energies[0]).max())
        exchanged = np.ptp([0.5 * 0.01 * np.sum(s[:, 3:5] ** 2) + 0.5e-6 * np.sum(s[:, 5] ** 2) for s in path])
    np.testing.assert_allclose(np.log2(np.array(drift[:-1]) / drift[1:]), 2.0, atol=0.2)
    assert drift[-1] < 1e-3 * exchanged


def test_terminal_velocity_is_exact_however_strong_the_drag(rng: np.random.Generator) -> None:
    """With drag that takes the speed away within a substep, force over drag remains: no stiffness."""
    body = Body(mass_kg=1e-6, inertia_kgm2=1e-10, drag_linear_nspm=10.0, drag_rotational_nmsprad=1e-3)
    plant, epms = Plant(body=body), magnets(rng)
    before, after = run(states(rng)[0] * [1, 1, 1, 0, 0, 0], epms, plant, 0.005, 1)
    force = wrenches(before, epms, Physics.of(SYSTEM, WIDE, 1))
    np.testing.assert_allclose(after[:, 3:], force / [10.0, 10.0, 1e-3], rtol=1e-13)


def test_free_robot_coasts_and_drag_slows_it_exactly() -> None:
    epms, body = np.zeros((0, 6)), Body()
    robots = np.zeros((2, 6))
    robots[0, 0], robots[1, 0] = -4.0, 4.0  # too far apart to feel each other
    robots[:, 3:] = [0.1, -0.2, 3.0]
    coasting = run(robots, epms, FREE, 0.01, 10)[-1]
    np.testing.assert_allclose(coasting[:, :3] - robots[:, :3], [[0.01, -0.02, 0.3]] * 2, rtol=1e-6)
    slowed = run(robots, epms, WIDE, 0.01, 10)[-1]
    linear = math.exp(-0.1 * body.drag_linear_nspm / body.mass_kg)
    turning = math.exp(-0.1 * body.drag_rotational_nmsprad / body.inertia_kgm2)
    np.testing.assert_allclose(slowed[:, 3:], [[0.1 * linear, -0.2 * linear, 3 * turning]] * 2, rtol=1e-4)


@pytest.mark.parametrize("angle", [0.5, -2.5, math.pi])
def test_motion_turns_with_the_scene(
    rng: np.random.Generator, angle: float, turn_about_z: Callable[[float], Floats]
) -> None:
    q = turn_about_z(angle)

    def turned(robots: Floats) -> Floats:
        out = robots.copy()
        out[..., :2], out[..., 3:5] = robots[..., :2] @ q[:2, :2].T, robots[..., 3:5] @ q[:2, :2].T
        out[..., 2] += angle
        return out

    robots, epms = states(rng)[0], magnets(rng)
    turned_epms = np.concatenate([epms[:, :3] @ q.T, epms[:, 3:] @ q.T], axis=-1)
    end = run(robots, epms, WIDE, 0.005, 20)[-1]
    turned_end = run(turned(robots), turned_epms, WIDE, 0.005, 20)[-1]
    np.testing.assert_allclose(turned_end, turned(end), atol=1e-9)
