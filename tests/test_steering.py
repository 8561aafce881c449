"""Steering: robots arrive where the action mode ``velocity`` sends them, by the plant's own equations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from magenv.actions import Actions
from magenv.episodes import Episodes, Settings
from magenv.outcome import CONVERGED, FELL_BACK
from magenv.params import Body, Plant, System
from magenv.poses import from_cartesian, robots_frame
from magenv.sensitivity import COORDINATES
from magenv.steering import Steering, foresee, log_growth, workspace
from magenv.stiffness import planar_stiffness
from magenv.velocity import VELOCITY_MPS, VELOCITY_RADPS

Floats = NDArray[np.float64]

PERIOD_S = 0.5
SPEEDS = np.array([VELOCITY_MPS, VELOCITY_MPS, VELOCITY_RADPS] * 2)


def apart(rng: np.random.Generator, n: int, distance_m: float) -> Floats:
    """Poses (n, 2, 3) of robots so far apart, headings within half a radian of each other."""
    line, heading = rng.uniform(-math.pi, math.pi, (2, n))
    robots = np.empty((n, 2, 3))
    for robot, side in enumerate((-0.5, 0.5)):
        robots[:, robot, 0] = side * distance_m * np.cos(line)
        robots[:, robot, 1] = side * distance_m * np.sin(line)
        robots[:, robot, 2] = heading + side * rng.uniform(-0.5, 0.5, n)
    return robots


def turned(points: Floats, angle: float) -> Floats:
    """Vectors (..., 3) turned about the vertical."""
    c, s = math.cos(angle), math.sin(angle)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("size", [1e-3, 1.0, 60.0])
def test_growth_is_the_norm_of_the_exponential(rng: np.random.Generator, size: float) -> None:
    a = rng.normal(size=(COORDINATES, COORDINATES)) * size
    a = 0.5 * (a + a.T)
    scratch = np.empty((2, COORDINATES, COORDINATES))
    grown = log_growth(a, PERIOD_S, scratch[0], scratch[1])
    assert grown == pytest.approx(math.log(np.linalg.norm(expm(a * PERIOD_S))), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("period", [0.1, 0.5])
def test_what_is_foreseen_solves_the_equation_of_motion(rng: np.random.Generator, period: float) -> None:
    """M q'' + D q' = F + K q from rest and from a velocity, against the exponential of the whole linear system."""
    plant = Plant()
    s = Steering.of(System(), plant, period)
    w, body = workspace(s), plant.body
    inertia = np.tile([body.mass_kg, body.mass_kg, body.inertia_kgm2], 2)
    half = 0.5 * rng.normal(size=(COORDINATES, COORDINATES)) / s.root / s.root[:, None]  # rates of a few per second
    w.model.stiffness[:] = half + half.T
    w.force[:] = rng.normal(size=COORDINATES) * s.drag * 0.01
    for rates in (np.zeros(COORDINATES), rng.normal(size=COORDINATES) * 0.01):
        motion = np.zeros((13, 13))
        motion[:6, 6:12] = np.eye(6)
        motion[6:12, :6] = w.model.stiffness / inertia[:, None]
        motion[6:12, 6:12] = np.diag(-s.drag / inertia)
        motion[6:12, 12] = w.force / inertia
        exact = (expm(motion * period) @ np.concatenate([np.zeros(6), rates, [1.0]]))[:6]
        foresee(s, w, rates)
        np.testing.assert_allclose(w.moved, exact, rtol=0.02, atol=0.01 * np.abs(exact).max())


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("control_hz", [2.0, 10.0])
def test_robots_arrive_where_they_are_sent(rng: np.random.Generator, n_epm: int, control_hz: float) -> None:
    """After a first hold, robots 60 mm apart come within 0.2 mm and half a degree of where they are told to go."""
    episodes = Episodes(8, Settings("approach-60", n_epm=n_epm, action="velocity", control_hz=control_hz))
    everyone = np.ones(8, np.bool_)
    for row in range(8):
        episodes.seed(row, np.random.default_rng(row))
    episodes.start(everyone)
    episodes.step(np.zeros((8, COORDINATES)), everyone)
    for _ in range(6):
        action = rng.uniform(-0.2, 0.2, (8, COORDINATES))
        before = episodes.state.robots[..., :3].copy()
        episodes.step(action, everyone)
        moved = (episodes.state.robots[..., :3] - before).reshape(8, COORDINATES)
        for i in range(8):
            frame = robots_frame(before[i, 0, 2], before[i, 1, 2])
            wanted = (action[i] * SPEEDS / control_hz).reshape(2, 3)
            wanted[:, :2] = turned(np.concatenate([wanted[:, :2], np.zeros((2, 1))], axis=1), frame)[:, :2]
            missed = moved[i].reshape(2, 3) - wanted
            assert episodes.state.solver[i] == CONVERGED
            assert np.abs(missed[:, :2]).max() < 2e-4
            assert np.abs(missed[:, 2]).max() < math.radians(0.5)


def test_turning_everything_turns_the_answer(rng: np.random.Generator) -> None:
    robots, angle = apart(rng, 12, 0.05), 1.1
    actions, action = Actions("velocity", System()), rng.uniform(-0.2, 0.2, (12, COORDINATES))
    epms, _ = actions.to_epms(action, robots, actions.home(robots))
    other = robots.copy()
    other[..., :2] = turned(np.concatenate([robots[..., :2], np.zeros((12, 2, 1))], axis=-1), angle)[..., :2]
    other[..., 2] += angle
    there, _ = actions.to_epms(action, other, actions.home(other))
    expected = np.concatenate([turned(epms[..., :3], angle), turned(epms[..., 3:], angle)], axis=-1)
    alike = np.abs(there - expected).max(axis=(1, 2)) < 1e-4
    assert alike.mean() >= 0.75  # descents are long, and rounding may send one elsewhere


def test_a_hold_is_sought_in_which_errors_grow_little(rng: np.random.Generator) -> None:
    """Robots 45 mm apart: in most holds found errors grow little (where none grows at all, this norm is 2.4)."""
    robots, system = apart(rng, 32, 0.045), System()
    actions = Actions("velocity", system)
    epms, _ = actions.to_epms(np.zeros((32, COORDINATES)), robots, actions.home(robots))
    s = Steering.of(system, Plant(), PERIOD_S)

    grown = []
    for robot, epm in zip(robots, epms, strict=True):
        positions = np.concatenate([robot[:, :2], np.zeros((2, 1))], axis=1)
        moments = np.zeros((2, 3))
        moments[:, 0], moments[:, 1] = np.cos(robot[:, 2]), np.sin(robot[:, 2])
        pose = from_cartesian(epm[:, :3], epm[:, 3:])
        k = planar_stiffness(positions, system.ipm_moment_am2 * moments, pose, system.epm_moment_am2)
        grown.append(np.linalg.norm(expm(k * s.root * s.root[:, None] * PERIOD_S)))
    assert np.median(grown) < 3.0


def test_where_nothing_can_be_foreseen_the_last_command_is_held() -> None:
    actions, robots = Actions("velocity", System()), np.zeros((1, 2, 3))  # both in one place
    epms = actions.home(np.array([[[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]]]))
    held, solver = epms.copy(), np.zeros(1, np.int64)
    actions.command(
        np.zeros((1, COORDINATES)), robots, robots, epms, np.ones(1, np.bool_), held, np.zeros(1, np.bool_), solver
    )
    assert solver[0] == FELL_BACK
    np.testing.assert_array_equal(held, epms)


def test_the_miss_told_is_the_plants(rng: np.random.Generator) -> None:
    """At 30 mm, where some holds cannot be met: what ``solver`` tells is what happens."""
    episodes, everyone = Episodes(16, Settings("approach-30", action="velocity")), np.ones(16, np.bool_)
    for row in range(16):
        episodes.seed(row, np.random.default_rng(row))
    episodes.start(everyone)
    robots = apart(rng, 16, 0.032)
    episodes.state.robots[..., :3] = robots
    episodes.state.measured[:] = robots
    episodes.state.before[:] = robots
    episodes.step(np.zeros((16, COORDINATES)), everyone)
    moved = episodes.state.robots[..., :3] - robots
    missed = np.sqrt((moved[..., :2] ** 2).sum(axis=(1, 2))) / 1e-4, np.sqrt((moved[..., 2] ** 2).sum(axis=1)) / 3e-3
    told = episodes.state.solver == CONVERGED
    assert told.any()
    assert np.hypot(*missed)[told].max() < 2.5, "two units, and what substeps of other lengths make of it"


def test_velocities_need_drag() -> None:
    """Other modes act on a plant without any as before."""
    bare = Plant(body=Body(drag_rotational_nmsprad=0.0))
    Actions("home", System(), plant=bare)
    with pytest.raises(ValueError, match="plant must be one with linear and rotational drag in velocity"):
        Actions("velocity", System(), plant=bare)


def test_of_a_hold_far_longer_than_rates_last_nothing_is_left() -> None:
    """Ten seconds, 200 per second: beyond what exponentials can tell."""
    plant = Plant(body=Body(drag_rotational_nmsprad=2e-4))
    assert Steering.of(System(), plant, 10.0).left[2] == 0.0
    short = Steering.of(System(), plant, PERIOD_S)
    rates = PERIOD_S / short.lag
    np.testing.assert_allclose(short.left, rates / np.expm1(rates), rtol=1e-13)
