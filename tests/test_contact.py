"""Contact: bodies that touch each other or the wall."""

from __future__ import annotations

import math

import numpy as np
import pytest
from lane import SYSTEM, one_lane

from magenv.dynamics import TOUCH, WALL, Physics, advance, may_touch, resolve_contact
from magenv.params import PLANTS, Body, Plant

DIAMETER = Body().diameter_m
LIMIT = Plant().workspace_radius_m - 0.5 * DIAMETER
"""Greatest distance of a body's centre from the middle."""


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
            advance(lane, 0, 0, None, h, False)
            near = may_touch(lane, 0, DIAMETER, plant.workspace_radius_m)
            state = lane[:12, 0].reshape(6, 2).T.copy()
            contact = resolve_contact(state, physics.mass[0], DIAMETER, plant.workspace_radius_m)
            assert near or not contact
            lane[:12, 0] = state.T.reshape(-1)
            flags |= contact
            assert state[1, 0] - state[0, 0] >= DIAMETER - 1e-12
        assert flags == TOUCH
