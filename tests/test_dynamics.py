"""The plant: order of the integrator, energy, drag, contact, symmetry, and what a world measures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from magenv.actions import WRENCH_FORCE_N, WRENCH_TORQUE_NM, Actions
from magenv.dipole import field
from magenv.dynamics import TOUCH, WALL, Physics, advance, constants, may_touch, planar_wrench, resolve_contact
from magenv.lanes import CONSTANTS, CONSTANTS_SIZE, EPMS, fields
from magenv.params import PLANTS, Body, Plant, System, TaskParams
from magenv.poses import from_cartesian, pose_bounds, project, to_cartesian
from magenv.trajectories import approach, draw
from magenv.world import LOSSES, World
from magenv.wrench import planar_moments, robot_wrench

Floats = NDArray[np.float64]

SYSTEM = System()
DIAMETER = Body().diameter_m
LIMIT = Plant().workspace_radius_m - 0.5 * DIAMETER
"""Greatest distance of a body's centre from the middle."""
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


def magnets(rng: np.random.Generator, system: System = SYSTEM) -> Floats:
    """Allowed EPMs (N, 6)."""
    pose, _ = project(rng.uniform(*pose_bounds(system)), system)
    return np.concatenate(to_cartesian(pose), axis=-1)


def one_lane(robots: Floats, epms: Floats, physics: Physics, h: float) -> Floats:
    """A single lane (fields, 1) with these robots (2, 6) and EPMs (N, 6)."""
    lane, row = np.zeros((fields(len(epms)), 1)), np.empty((1, CONSTANTS_SIZE))
    constants(physics, h, row)
    lane[:12, 0] = robots.reshape(-1)
    lane[CONSTANTS : CONSTANTS + CONSTANTS_SIZE, 0] = row
    lane[EPMS:, 0] = (epms * ([1.0] * 3 + [physics.epm_moment[0]] * 3)).reshape(-1)
    return lane


def wrenches(robots: Floats, epms: Floats, system: System, ipm_moment: Floats | None = None) -> Floats:
    """F_x, F_y, tau_z (2, 3) on the robots."""
    physics = Physics.of(system, WIDE, 1)
    if ipm_moment is not None:
        physics.ipm_moment[0] = ipm_moment
    lane = one_lane(robots, epms, physics, 0.005)
    return np.array(planar_wrench(lane, 0, len(epms), *robots[0, :3], *robots[1, :3])).reshape(2, 3)


def run(robots: Floats, epms: Floats, plant: Plant, h: float, steps: int, system: System = SYSTEM) -> Floats:
    """Return the states (steps + 1, 2, 6) of a run without contact."""
    lane = one_lane(robots, epms, Physics.of(system, plant, 1), h)
    path = [robots.copy()]
    for _ in range(steps):
        advance(lane, 0, len(epms), h)
        assert not may_touch(lane, 0, plant.body.diameter_m, plant.workspace_radius_m)
        path.append(lane[:12, 0].reshape(2, 6).copy())
    return np.array(path)


def energy(robots: Floats, epms: Floats, body: Body) -> float:
    """Kinetic energy and that of both moments in the field of the EPMs and of each other, in J."""
    positions = np.concatenate([robots[:, :2], np.zeros((2, 1))], axis=-1)
    moments = planar_moments(robots[:, 2], SYSTEM.ipm_moment_am2)
    kinetic = 0.5 * body.mass_kg * np.sum(robots[:, 3:5] ** 2) + 0.5 * body.inertia_kgm2 * np.sum(robots[:, 5] ** 2)
    external = field(SYSTEM.epm_moment_am2 * epms[:, None, 3:], epms[:, None, :3], positions).sum(axis=0)
    mutual = field(moments[0], positions[0], positions[1])
    return float(kinetic - np.sum(moments * external) - moments[1] @ mutual)


# Laws of motion


@pytest.mark.parametrize("n_epm", [2, 3])
def test_planar_wrench_is_the_planar_part_of_u(rng: np.random.Generator, n_epm: int) -> None:
    system = System(n_epm=n_epm)
    for robots in states(rng, 20):
        epms = magnets(rng, system)
        out = wrenches(robots, epms, system)
        positions = np.concatenate([robots[:, :2], np.zeros((2, 1))], axis=-1)
        pose = from_cartesian(epms[:, :3], epms[:, 3:])
        moments = planar_moments(robots[:, 2], system.ipm_moment_am2)
        u = robot_wrench(positions, moments, pose, system.epm_moment_am2).reshape(2, 5)
        c, s = np.cos(robots[:, 2]), np.sin(robots[:, 2])
        expected = np.stack([c * u[:, 2] - s * u[:, 3], s * u[:, 2] + c * u[:, 3], u[:, 1]], axis=-1)
        np.testing.assert_allclose(out, expected, atol=1e-12 * np.abs(expected).max())


def test_force_between_robots_cancels_to_the_last_bit(rng: np.random.Generator) -> None:
    """Third law in the plant; there are no EPMs here."""
    for robots in states(rng, 20):
        out = wrenches(robots, np.zeros((0, 6)), SYSTEM, np.array([0.1, 0.2]))
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
    force = wrenches(before, epms, SYSTEM)
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


# Contact


def test_touching_keeps_momentum_and_takes_the_approach(rng: np.random.Generator) -> None:
    for _ in range(100):
        robots, mass = np.zeros((2, 6)), rng.uniform(0.005, 0.02, 2)
        angle, distance = rng.uniform(-math.pi, math.pi), rng.uniform(0.1, 1.0) * DIAMETER
        normal = np.array([math.cos(angle), math.sin(angle)])
        robots[1, :2] = distance * normal
        robots[:, 3:5] = rng.normal(0.0, 0.1, (2, 2))
        before = robots.copy()
        assert resolve_contact(robots, mass, DIAMETER, 0.1) == TOUCH
        np.testing.assert_allclose(mass @ robots[:, 3:5], mass @ before[:, 3:5], atol=1e-17)
        np.testing.assert_allclose(mass @ robots[:, :2], mass @ before[:, :2], atol=1e-17)
        np.testing.assert_allclose(robots[1, :2] - robots[0, :2], DIAMETER * normal, atol=1e-15)
        along, was = (state[1, 3:5] - state[0, 3:5] for state in (robots, before))
        assert along @ normal == pytest.approx(max(was @ normal, 0.0), abs=1e-15)  # stops; parting bodies go on
        across = np.array([-normal[1], normal[0]])
        np.testing.assert_allclose(robots[:, 3:5] @ across, before[:, 3:5] @ across, atol=1e-15)
        np.testing.assert_array_equal(robots[:, [2, 5]], before[:, [2, 5]])


def test_coincident_bodies_are_parted() -> None:
    robots = np.zeros((2, 6))
    assert resolve_contact(robots, np.full(2, 0.01), DIAMETER, 0.1) == TOUCH
    assert np.linalg.norm(robots[1, :2] - robots[0, :2]) == pytest.approx(DIAMETER)


def test_wall_holds(rng: np.random.Generator) -> None:
    for _ in range(100):
        robots = np.zeros((2, 6))
        angle = rng.uniform(-math.pi, math.pi)
        normal = np.array([math.cos(angle), math.sin(angle)])
        robots[1, :2] = rng.uniform(LIMIT, 0.2) * normal
        robots[:, 3:5] = rng.normal(0.0, 0.1, (2, 2))
        before = robots.copy()
        assert resolve_contact(robots, np.full(2, 0.01), DIAMETER, 0.1) == WALL
        np.testing.assert_allclose(robots[1, :2], LIMIT * normal, atol=1e-15)
        assert robots[1, 3:5] @ normal <= 1e-15
        across = np.array([-normal[1], normal[0]])
        assert robots[1, 3:5] @ across == pytest.approx(before[1, 3:5] @ across, abs=1e-15)
        np.testing.assert_array_equal(robots[0], before[0])


def test_no_contact_changes_nothing() -> None:
    robots = np.array([[0.0, 0.0, 1.0, 0.1, 0.0, 2.0], [DIAMETER, 0.0, 2.0, -0.1, 0.0, 1.0]])
    before = robots.copy()
    assert resolve_contact(robots, np.full(2, 0.01), DIAMETER, 0.1) == 0
    np.testing.assert_array_equal(robots, before)


def test_bodies_overlap_neither_each_other_nor_the_wall(rng: np.random.Generator) -> None:
    """Anywhere, also where both press against the wall at once."""
    for _ in range(2000):
        robots = np.zeros((2, 6))
        radius, angle = 0.11 * math.sqrt(rng.uniform()), rng.uniform(-math.pi, math.pi)
        robots[:, :2] = [radius * math.cos(angle), radius * math.sin(angle)]
        robots[1, :2] += rng.normal(0.0, 0.5 * DIAMETER, 2)
        resolve_contact(robots, np.full(2, 0.01), DIAMETER, 0.1)
        assert np.linalg.norm(robots[:, :2], axis=-1).max() <= LIMIT + 1e-12
        assert np.linalg.norm(robots[1, :2] - robots[0, :2]) >= DIAMETER - 1e-12


def test_attracted_robots_never_pass_through_each_other(rng: np.random.Generator) -> None:
    """Let go head to tail at 15 to 30 mm they meet, touch and stay a diameter apart."""
    plant = PLANTS["paper"]
    physics, h = Physics.of(SYSTEM, plant, 1), plant.substep_s
    for distance in np.linspace(0.015, 0.030, 16):
        state = np.zeros((2, 6))
        state[1, 0] = distance
        lane, flags = one_lane(state, np.zeros((0, 6)), physics, h), 0
        for _ in range(400):
            advance(lane, 0, 0, h)
            near = may_touch(lane, 0, DIAMETER, plant.workspace_radius_m)
            state = lane[:12, 0].reshape(2, 6).copy()
            contact = resolve_contact(state, physics.mass[0], DIAMETER, plant.workspace_radius_m)
            assert near or not contact
            lane[:12, 0] = state.reshape(-1)
            flags |= contact
            assert state[1, 0] - state[0, 0] >= DIAMETER - 1e-12
        assert flags == TOUCH


# The world


def test_world_measures_the_true_state_at_every_substep(rng: np.random.Generator) -> None:
    """Means over a hold, values at its end and least separation, recomputed from the integrator alone."""
    plant = Plant(body=Body(drag_linear_nspm=3.0))  # slow enough to stay near for three holds of one command
    task, trajectory = TaskParams(), approach(0.060)
    world = World(1, SYSTEM, plant, task)
    robots = np.zeros((2, 6))
    robots[:, :3] = trajectory.at(0.0) + rng.normal(0.0, [1e-3, 1e-3, 0.05], (2, 3))
    epms = Actions("home", SYSTEM).home(robots[None, :, :3])
    world.start(0, trajectory, robots, epms[0])
    tracked = np.linalg.norm(robots[1, :2] - robots[0, :2])
    for hold in range(3):
        substeps = 100
        path = run(world.robots[0], epms[0], plant, task.period_s / substeps, substeps)
        position, heading, separations = [], [], []
        for k, state in enumerate(path[1:], start=1):
            reference = trajectory.at(hold * task.period_s + k * plant.substep_s)
            away = np.linalg.norm(state[:, :2] - reference[:, :2], axis=-1)
            turned = np.abs(np.angle(np.exp(1j * (state[:, 2] - reference[:, 2]))))
            position.append(away.mean())
            heading.append(turned.mean())
            separations.append(np.linalg.norm(state[1, :2] - state[0, :2]))
            assert away.max() < 0.03
            if away.max() <= task.tracking_distance_m:
                tracked = separations[-1]
        m = world.step(epms, np.ones(1, np.bool_))
        np.testing.assert_array_equal(world.robots[0], path[-1])
        assert m.loss[0] == 0
        assert m.substeps[0] == substeps
        assert m.position_error_m[0] == pytest.approx(np.mean(position), rel=1e-10)
        assert m.heading_error_rad[0] == pytest.approx(np.mean(heading), rel=1e-10)
        assert m.position_error_end_m[0] == pytest.approx(position[-1], rel=1e-10)
        assert m.heading_error_end_rad[0] == pytest.approx(heading[-1], rel=1e-10)
        assert m.separation_min_m[0] == pytest.approx(min(separations), rel=1e-12)
        assert m.separation_tracked_m[0] == pytest.approx(tracked, rel=1e-12)


def test_loss_is_told_at_its_first_substep() -> None:
    """A robot drifting off at a known speed crosses 30 mm at a known time, and the row stops there."""
    light = Plant(body=Body(mass_kg=1e3, inertia_kgm2=1e3, drag_linear_nspm=0.0, drag_rotational_nmsprad=0.0))
    world, trajectory = World(1, SYSTEM, light, TaskParams()), approach(0.100)
    robots = np.zeros((2, 6))
    robots[:, :3] = trajectory.at(0.0)
    robots[0, 4] = 0.21  # m/s, away from the reference along y; too heavy for the magnets to matter
    epms = Actions("home", SYSTEM).home(robots[None, :, :3])
    world.start(0, trajectory, robots, epms[0])
    m = world.step(epms, np.ones(1, np.bool_))
    assert LOSSES[m.loss[0]] == "deviation"
    h, first = light.substep_s, math.ceil(0.030 / 0.21 / light.substep_s)
    assert m.substeps[0] == first
    away = np.linalg.norm(world.robots[0, 0, :2] - trajectory.at(first * h)[0, :2])
    assert 0.030 < away < 0.030 + 1.1 * 0.21 * h


def test_inactive_rows_stand_still(rng: np.random.Generator) -> None:
    world, trajectory = World(3, SYSTEM, PLANTS["paper"], TaskParams()), approach(0.060)
    for row in range(3):
        robots = np.zeros((2, 6))
        robots[:, :3] = trajectory.at(0.0)
        world.start(row, trajectory, robots, magnets(rng))
    before, epms = world.robots.copy(), world.epms.copy()
    world.step(np.stack([magnets(rng)] * 3), np.array([True, False, True]))
    np.testing.assert_array_equal(world.robots[1], before[1])
    np.testing.assert_array_equal(world.epms[1], epms[1])
    np.testing.assert_array_equal(world.step_count, [1, 0, 1])
    assert not np.array_equal(world.robots[0], before[0])


@pytest.mark.parametrize("control_hz", [0.7, 2.0, 3.0, 10.0, 60.0, 1000.0])
def test_substep_is_the_plants_whatever_the_control_rate(control_hz: float) -> None:
    world = World(1, SYSTEM, PLANTS["paper"], TaskParams(control_hz=control_hz))
    h = world.period_s / world.substeps
    assert h <= PLANTS["paper"].substep_s * (1 + 1e-9)
    assert h >= 0.5 * min(PLANTS["paper"].substep_s, world.period_s)


@pytest.mark.parametrize("scenario", ["approach-60", "approach-30"])
def test_halving_the_substep_changes_no_error_by_over_2_percent(scenario: str, rng: np.random.Generator) -> None:
    """Errors over holds all along the path, each begun near the reference, under the command of a simple controller.

    Hold by hold from the same state and under the same EPMs: what differs is the integrator alone.
    """
    plant, task, trajectory = PLANTS["paper"], TaskParams(), draw(scenario, rng)
    usual = World(1, SYSTEM, plant, task)
    fine = World(1, SYSTEM, dataclasses.replace(plant, substep_s=plant.substep_s / 2), task)
    actions, errors = Actions("wrench", SYSTEM), []
    for hold in range(0, 200, 2):
        time, robots = hold * task.period_s, np.zeros((2, 6))
        reference = trajectory.at(time)
        robots[:, :3] = reference + rng.normal(0.0, [1e-3, 1e-3, 0.05], (2, 3))
        robots[:, 3:] = (trajectory.at(time + 0.1) - reference) / 0.1
        gains = np.array([0.2 / WRENCH_FORCE_N, 0.2 / WRENCH_FORCE_N, 1e-4 / WRENCH_TORQUE_NM])
        action = np.clip((trajectory.at(time + task.period_s) - robots[:, :3]) * gains, -1, 1).reshape(1, 6)
        epms, _ = actions.to_epms(action, robots[None, :, :3], actions.home(robots[None, :, :3]))
        told = []
        for world in (usual, fine):
            world.start(0, trajectory, robots, epms[0])
            world.step_count[0] = hold
            m = world.step(epms, np.ones(1, np.bool_))
            told.append(
                [m.position_error_m, m.heading_error_rad, m.position_error_end_m, m.heading_error_end_rad, m.loss]
            )
        errors.append(np.array(told)[..., 0])
    kept = np.array([pair for pair in errors if not pair[:, -1].any()])[..., :-1]
    assert len(kept) > 60
    assert not np.array_equal(kept[:, 0], kept[:, 1])
    np.testing.assert_allclose(*kept.mean(axis=0), rtol=0.02)
