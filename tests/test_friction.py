"""What acts on a robot on a rough plant besides the magnets: a constant push, and dry friction."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from foreseen import PAPER, UNMOVED, Floats, at_home, end_of, held, on_the_way
from lane import magnets, one_lane

from magenv.dynamics import Physics, advance
from magenv.lanes import FRICTION, PUSH_TURN1, PUSH_X1, PUSH_Y2, TURN_FRICTION
from magenv.params import Body, Plant, System
from magenv.sensitivity import Model

MASS, INERTIA, H = np.array([0.010, 0.020]), np.array([1e-6, 3e-6]), 0.005
"""kg and kg m^2 of the two robots; s."""
SLIPPERY = Plant(body=Body(drag_linear_nspm=0.0, drag_rotational_nmsprad=0.0))
NO_EPMS = np.zeros((0, 6))
F, TAU = 2e-4, 1e-7
"""Dry friction, N and N m."""


def alone(velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Floats:
    """Lane (fields, 1) with both robots at the same velocity, free of drag, too far apart to feel each other."""
    robots = np.zeros((2, 6))
    robots[:, 0], robots[:, 3:] = [-1e3, 1e3], velocity
    physics = Physics.of(System(), SLIPPERY, 1)
    physics.mass[:], physics.inertia[:] = MASS, INERTIA
    return one_lane(robots, NO_EPMS, physics, H)


def states(lane: Floats) -> Floats:
    """States (2, 6) of the robots in a lane."""
    return lane[:12, 0].reshape(6, 2).T.copy()


def path(lane: Floats, steps: int) -> Floats:
    """States (steps + 1, 2, 6) on a rough plant."""
    found = [states(lane)]
    for _ in range(steps):
        advance(lane, 0, 0, None, H, True)
        found.append(states(lane))
    return np.array(found)


def test_friction_takes_its_force_over_the_mass_from_the_speed_and_then_brings_to_rest() -> None:
    """At 0.05 m/s robots are at rest after 2.5 s and 5 s; the way is v^2 / 2a, and straight. 4 rad/s last longer."""
    lane = alone((0.03, -0.04, -4.0))
    lane[FRICTION], lane[TURN_FRICTION] = F, TAU
    found = path(lane, 1100)
    speed, rate, time = np.hypot(*found[..., 3:5].T), found[..., 5].T, H * np.arange(1101)
    np.testing.assert_allclose(speed, np.maximum(0.05 - F / MASS[:, None] * time, 0.0), atol=1e-15)
    np.testing.assert_allclose(rate, -4.0 + TAU / INERTIA[:, None] * time, rtol=1e-12)
    for robot, rest in ((0, 501), (1, 1001)):
        moving = speed[robot] > 1e-12
        np.testing.assert_allclose(found[moving, robot, 3] / speed[robot, moving], 0.6, rtol=1e-12)
        assert (found[rest:, robot, 3:5] == 0.0).all(), "at rest, and not merely slow"
        np.testing.assert_array_equal(found[-1, robot, :2], found[rest, robot, :2])
        way = found[-1, robot, :2] - found[0, robot, :2]
        np.testing.assert_allclose(way, 0.5 * 0.05**2 / (F / MASS[robot]) * np.array([0.6, -0.8]), atol=1e-9)


@pytest.mark.parametrize("share", [0.5, 0.999])
def test_at_rest_a_robot_stays_at_rest_below_the_limit(share: float) -> None:
    """Force along a diagonal: the friction is that of the whole force, not of each axis."""
    lane = alone()
    lane[FRICTION], lane[TURN_FRICTION] = F, TAU
    lane[PUSH_X1 : PUSH_X1 + 2] = 0.6 * share * F
    lane[PUSH_Y2 - 1 : PUSH_Y2 + 1] = 0.8 * share * F
    lane[PUSH_TURN1 : PUSH_TURN1 + 2] = -share * TAU
    found = path(lane, 50)
    np.testing.assert_array_equal(found, np.broadcast_to(found[0], found.shape))


def test_above_the_limit_the_rest_of_the_force_accelerates() -> None:
    lane = alone()
    lane[FRICTION], lane[TURN_FRICTION] = F, TAU
    lane[PUSH_X1], lane[PUSH_TURN1] = 3 * F, -1.5 * TAU  # on robot 1 alone
    found, time = path(lane, 50), H * np.arange(51)
    np.testing.assert_allclose(found[:, 0, 3], 2 * F / MASS[0] * time, rtol=1e-12)
    np.testing.assert_allclose(found[:, 0, 5], -0.5 * TAU / INERTIA[0] * time, rtol=1e-12)
    assert np.abs(found[:, 0, 4]).max() < 1e-20  # the other robot is two kilometres away
    assert (found[:, 1, 3:] == 0.0).all()


def test_a_push_accelerates_its_own_robot() -> None:
    pushes = np.array([[1e-4, -2e-4, 3e-8], [-3e-4, 4e-4, -5e-8]])
    lane = alone()
    lane[PUSH_X1 : PUSH_X1 + 6, 0] = pushes.T.ravel()
    np.testing.assert_allclose(
        path(lane, 10)[-1, :, 3:], pushes / np.stack([MASS, MASS, INERTIA], axis=1) * 10 * H, rtol=1e-12
    )


def test_friction_never_turns_a_motion_round_nor_speeds_it_up(rng: np.random.Generator) -> None:
    """Whatever the friction: the new speed is between zero and the one without it."""
    for _ in range(200):
        velocity = rng.normal(0.0, [0.02, 0.02, 2.0])
        free, rubbed = alone(tuple(velocity)), alone(tuple(velocity))
        rubbed[FRICTION], rubbed[TURN_FRICTION] = 10 ** rng.uniform(-6, 0), 10 ** rng.uniform(-9, -3)
        for lane in (free, rubbed):
            lane[PUSH_X1 : PUSH_X1 + 6, 0] = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-6, 1e-6]) * velocity[0]
        without, found = path(free, 1)[1], path(rubbed, 1)[1]
        left = np.hypot(*found[:, 3:5].T) / np.hypot(*without[:, 3:5].T)
        assert ((left >= 0.0) & (left < 1.0)).all()
        np.testing.assert_allclose(found[:, 3:5], left[:, None] * without[:, 3:5], rtol=1e-12)
        share = found[:, 5] / without[:, 5]
        assert ((share >= 0.0) & (share < 1.0)).all()


@pytest.mark.parametrize("n_epm", [2, 3])
def test_without_friction_and_push_a_rough_plant_is_the_same_to_the_last_bit(
    rng: np.random.Generator, n_epm: int
) -> None:
    system = System(n_epm=n_epm)
    for _ in range(20):
        robots = rng.normal(0.0, [0.02, 0.02, 1.0, 0.02, 0.02, 1.0], (2, 6))
        smooth = one_lane(robots, magnets(rng, system), Physics.of(system, PAPER, 1), H)
        rough = smooth.copy()
        for _ in range(20):
            advance(smooth, 0, n_epm, None, H, False)
            advance(rough, 0, n_epm, None, H, True)
        np.testing.assert_array_equal(rough, smooth)
        assert math.isfinite(smooth.sum())


def test_a_model_rubs_as_its_plant_does() -> None:
    """Robots at rest beside magnets set off; with a friction above all that acts on them they do not."""
    state = on_the_way(0.06, 50.0)
    still = state * np.repeat([1.0, 0.0], 6)
    motion = held(at_home(state), 40)
    for friction, moves in ((0.0, True), (10.0, False)):
        model = Model.of(System(), replace(PAPER, dry_friction_n=friction, dry_friction_nm=friction), H)
        end = end_of(model, still, UNMOVED, motion)
        assert (np.abs(end - still).max() > 1e-3) == moves
        if not moves:
            np.testing.assert_array_equal(end, still)
