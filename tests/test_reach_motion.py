"""What the arms reach: ways within it, motion within it, plans within it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from reached import PLANT, SHELL, anywhere, away, beyond, nearest_pair, project

from magenv.actions import Actions, pose_to_action
from magenv.forecast import Course
from magenv.manoeuvre import Arms, allow, move
from magenv.params import System, TaskParams
from magenv.poses import from_cartesian
from magenv.reach import room, shoulder, stays
from magenv.trajectories import shaped
from magenv.ways import way_round
from magenv.world import World

Floats = NDArray[np.float64]

H = PLANT.substep_s
FREE = TaskParams(control_hz=1.0 / H, loss_distance_m=10.0)
"""A hold is one substep, so that every one is seen; the robots may go where they like."""
PASSING = 1e6
"""Attraction (N) that lets EPMs pass each other at 27 mm: each goes as if alone."""


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


# Motion


def travelled(system: System, draws: Floats, substeps: int) -> Floats:
    """EPMs after each substep (K, n, N, 6), from the first of the draws (G, n, N, 6) towards each of the others."""
    world, trajectory = World(draws.shape[1], system, PLANT, FREE), shaped("approach", 0.060)
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
    world, trajectory = World(rows, system, PLANT, FREE), shaped("approach", 0.060)
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
