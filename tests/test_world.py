"""The world: what it measures hold by hold, when it tells a loss, how fine its substeps are."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from lane import SYSTEM, magnets, run

from magenv.actions import WRENCH_FORCE_N, WRENCH_TORQUE_NM, Actions
from magenv.params import PLANTS, Body, Plant, TaskParams
from magenv.trajectories import draw, shaped
from magenv.world import LOSSES, World


def test_world_measures_the_true_state_at_every_substep(rng: np.random.Generator) -> None:
    """Means over a hold, values at its end and least separation, recomputed from the integrator alone."""
    plant = Plant(body=Body(drag_linear_nspm=3.0))  # slow enough to stay near for three holds of one command
    task, trajectory = TaskParams(), shaped("approach", 0.060)
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
    world, trajectory = World(1, SYSTEM, light, TaskParams()), shaped("approach", 0.100)
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
    world, trajectory = World(3, SYSTEM, PLANTS["paper"], TaskParams()), shaped("approach", 0.060)
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
