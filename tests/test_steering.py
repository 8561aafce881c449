"""Steering: robots arrive where the action mode ``velocity`` sends them, by the plant's own equations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from agents.steered import Steered
from magenv.actions import Actions
from magenv.calm_holds import CalmHolds
from magenv.episodes import Episodes, Settings
from magenv.forecast import STATE
from magenv.linear_hold import (
    ALONE,
    BESIDE,
    FORCE,
    GROWN,
    HOLD_SIZE,
    MOVED,
    RATES,
    SCALED,
    STIFFNESS,
    LinearHold,
    foresee,
    growth,
    log_growth,
)
from magenv.local import shift
from magenv.outcome import CONVERGED, FELL_BACK
from magenv.params import Body, Plant, System
from magenv.poses import POSE_SIZE, from_cartesian, robots_frame
from magenv.sensitivity import COORDINATES
from magenv.steering_cost import Steering, differentiate_cost, locate, look, weigh, workspace
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


WIDTHS = (ALONE, BESIDE)


def lanes_of(side_by_side: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Lanes of holds, as kernels and as tests see them."""
    lanes = np.zeros((HOLD_SIZE, len(side_by_side)))
    return lanes.reshape(-1), lanes


def symmetric(rng: np.random.Generator, n: int) -> Floats:
    a = rng.normal(size=(n, COORDINATES, COORDINATES))
    return np.asarray(0.5 * (a + a.swapaxes(1, 2)))


@pytest.mark.parametrize("side_by_side", WIDTHS)
def test_growth_is_the_norm_of_the_exponential(rng: np.random.Generator, side_by_side: tuple[int, ...]) -> None:
    """Of small and of great matrices side by side, which take none and many squarings."""
    for size in (1e-3, 1.0, 60.0):
        flat, lanes = lanes_of(side_by_side)
        sizes = size * 10.0 ** rng.uniform(-1.0, 0.0, lanes.shape[1])
        a = symmetric(rng, lanes.shape[1]) * sizes[:, None, None]
        lanes[SCALED : SCALED + 36] = a.reshape(-1, 36).T
        log_growth(PERIOD_S, flat, side_by_side)
        exact = [math.log(np.linalg.norm(expm(matrix * PERIOD_S))) for matrix in a]
        np.testing.assert_allclose(lanes[GROWN], exact, rtol=1e-6, atol=1e-6)


def test_holds_side_by_side_are_those_alone_bit_for_bit(rng: np.random.Generator) -> None:
    """A matrix that is nothing, one that is not finite and ones that grow differently change nothing beside them."""
    hold, rates = LinearHold.of(Plant().body, PERIOD_S), rng.normal(size=COORDINATES) * 0.01
    flat, lanes = lanes_of(BESIDE)
    lanes[FORCE : FORCE + COORDINATES] = rng.normal(size=(COORDINATES, 16)) * 1e-3
    stiffness = symmetric(rng, 16) / hold.root / hold.root[:, None] * 10.0 ** rng.uniform(-2.0, 1.5, (16, 1, 1))
    stiffness[3], stiffness[5, 1, 2] = 0.0, math.nan
    lanes[STIFFNESS : STIFFNESS + 36] = stiffness.reshape(16, 36).T
    given = lanes.copy()
    foresee(hold, hold.substeps, rates, flat, BESIDE)
    growth(hold, flat, BESIDE)
    for v in range(16):
        own, alone = lanes_of(ALONE)
        alone[:, 0] = given[:, v]
        foresee(hold, hold.substeps, rates, own, ALONE)
        growth(hold, own, ALONE)
        written = slice(MOVED, GROWN + 1)
        assert alone[written, 0].tobytes() == np.ascontiguousarray(lanes[written, v]).tobytes()
    assert np.isnan(lanes[GROWN, 5])
    assert np.isfinite(np.delete(lanes[GROWN], 5)).all()


@pytest.mark.parametrize("n_epm", [2, 3])
def test_slopes_side_by_side_are_those_of_one_after_the_other(rng: np.random.Generator, n_epm: int) -> None:
    """Bit for bit: what one EPM moved a little changes is put together with what the others do as it is for all."""
    system = System(n_epm=n_epm)
    steering = Steering.of(system, Plant(), PERIOD_S)
    w, (robots,) = workspace(steering), apart(rng, 1, 0.04)
    state = np.concatenate([robots.reshape(-1), rng.normal(size=COORDINATES) * 0.01])
    epms = Actions("velocity", system).home(robots[None])[0]
    locate(w, state, rng.normal(size=COORDINATES) * 0.003)
    substeps = look(steering, w, state, 0.0)
    weigh(steering, w, state, substeps, epms, w.residuals)
    differentiate_cost(steering, w, state, substeps, epms)
    slopes, normal, beside = w.jacobian.copy(), w.normal.copy(), np.empty_like(w.residuals)
    for at in range(POSE_SIZE * n_epm):
        moved, step = epms.copy(), np.zeros(POSE_SIZE)
        step[at % POSE_SIZE] = 1e-6
        shift(moved[at // POSE_SIZE], w.bases[at // POSE_SIZE], step, 0.0, math.inf)
        weigh(steering, w, state, substeps, moved, beside)
        assert (slopes[:, at] == (beside - w.residuals) / 1e-6).all()
    np.testing.assert_allclose(np.tril(normal), np.tril(slopes.T @ slopes), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(w.downhill, -slopes.T @ w.residuals, rtol=1e-12, atol=1e-9)


def test_more_epms_than_there_is_room_for_are_refused() -> None:
    none = CalmHolds(np.zeros((1, 3)), np.zeros((1, 4, 6)))
    with pytest.raises(ValueError, match=r"Input n_epm must be at most 3 to steer by; instead received 4"):
        Steering.of(System(n_epm=4), Plant(), PERIOD_S, none)


@pytest.mark.parametrize("period", [0.02, 0.1, 0.5, 2.0])
def test_what_is_foreseen_solves_the_equation_of_motion(rng: np.random.Generator, period: float) -> None:
    """M q'' + D q' = F + K q from rest and from a velocity, against the exponential of the whole linear system."""
    body = Plant().body
    hold = LinearHold.of(body, period)
    inertia = np.tile([body.mass_kg, body.mass_kg, body.inertia_kgm2], 2)
    half = 0.5 * rng.normal(size=(COORDINATES, COORDINATES)) / hold.root / hold.root[:, None]  # a few per second
    stiffness, force = half + half.T, rng.normal(size=COORDINATES) * hold.drag * 0.01
    flat, lanes = lanes_of(ALONE)
    lanes[FORCE : FORCE + COORDINATES, 0], lanes[STIFFNESS : STIFFNESS + 36, 0] = force, stiffness.reshape(-1)
    moved, then = lanes[MOVED : MOVED + COORDINATES, 0], lanes[RATES : RATES + COORDINATES, 0]
    for rates in (np.zeros(COORDINATES), rng.normal(size=COORDINATES) * 0.01):
        motion = np.zeros((13, 13))
        motion[:6, 6:12] = np.eye(6)
        motion[6:12, :6] = stiffness / inertia[:, None]
        motion[6:12, 6:12] = np.diag(-hold.drag / inertia)
        motion[6:12, 12] = force / inertia
        exact = expm(motion * period) @ np.concatenate([np.zeros(6), rates, [1.0]])
        foresee(hold, hold.substeps, rates, flat, ALONE)
        np.testing.assert_allclose(moved, exact[:6], rtol=0.03, atol=0.05 * np.abs(exact[:6]).max())
        np.testing.assert_allclose(then, exact[6:12], rtol=0.05, atol=0.02 * np.abs(exact[6:12]).max())


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
    hold = LinearHold.of(Plant().body, PERIOD_S)
    flat, lanes = lanes_of(ALONE)
    grown = []
    for robot, epm in zip(robots, epms, strict=True):
        positions = np.concatenate([robot[:, :2], np.zeros((2, 1))], axis=1)
        moments = np.zeros((2, 3))
        moments[:, 0], moments[:, 1] = np.cos(robot[:, 2]), np.sin(robot[:, 2])
        pose = from_cartesian(epm[:, :3], epm[:, 3:])
        k = planar_stiffness(positions, system.ipm_moment_am2 * moments, pose, system.epm_moment_am2)
        grown.append(np.linalg.norm(expm(k * hold.root * hold.root[:, None] * PERIOD_S)))
        lanes[STIFFNESS : STIFFNESS + 36, 0] = k.reshape(-1)
        growth(hold, flat, ALONE)
        assert lanes[GROWN, 0] == pytest.approx(math.log(grown[-1]), rel=1e-6)
    assert np.median(grown) < 3.0


def test_where_nothing_can_be_foreseen_the_last_command_is_held() -> None:
    actions, robots = Actions("velocity", System()), np.zeros((1, 2, 3))  # both in one place
    epms = actions.home(np.array([[[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]]]))
    held, solver, expected = 2.0 * epms, np.zeros(1, np.int64), np.full((1, STATE), 0.1)
    last = held.copy()
    actions.command(
        np.zeros((1, COORDINATES)), robots, expected, epms, np.ones(1, np.bool_), held, np.zeros(1, np.bool_), solver
    )
    assert solver[0] == FELL_BACK
    np.testing.assert_array_equal(held, last)
    np.testing.assert_array_equal(expected, np.zeros((1, STATE)))


@pytest.mark.parametrize("distance_m", [1e-7, 1e-4, 2e-3, 0.008, 0.011, 0.013, 0.015])
def test_robots_that_nearly_touch_are_no_trouble(rng: np.random.Generator, distance_m: float) -> None:
    """Errors that grow beyond all numbers: the search ends, and what it finds is within reach."""
    actions, robots = Actions("velocity", System()), apart(rng, 8, distance_m)
    with np.errstate(all="raise"):
        epms, _ = actions.to_epms(rng.uniform(-1.0, 1.0, (8, COORDINATES)), robots, actions.home(robots))
    radii = np.linalg.norm(epms[..., :3], axis=-1)
    assert np.isfinite(epms).all()
    assert radii.min() > System().r_min_m - 1e-6
    assert radii.max() < System().r_max_m + 1e-6


@pytest.mark.parametrize("control_hz", [2.0, 10.0, 50.0])
def test_the_state_expected_is_the_one_that_comes(rng: np.random.Generator, control_hz: float) -> None:
    """Rates among it, to rounding, since the plant is the nominal one: robots 30 mm apart, sent here and there."""
    episodes, everyone = (
        Episodes(4, Settings("still-30", action="velocity", control_hz=control_hz)),
        np.ones(4, np.bool_),
    )
    for row in range(4):
        episodes.seed(row, np.random.default_rng(row))
    episodes.start(everyone)
    moved = 0.0
    for _ in range(10):
        episodes.step(rng.uniform(-0.3, 0.3, (4, COORDINATES)), everyone)
        there = episodes.state.robots.reshape(4, 2, 2, 3).transpose(0, 2, 1, 3).reshape(4, STATE)
        np.testing.assert_allclose(episodes.state.expected, there, rtol=1e-9, atol=1e-10)
        moved = max(moved, float(np.abs(there[:, COORDINATES:]).max()))
    assert moved > 1e-3


def test_more_than_was_expected_counts_as_speed() -> None:
    """Robots a millimetre farther along than expected half a second after are taken to go 2 mm/s faster."""
    actions = Actions("velocity", System())
    robots = np.array([[[-0.03, 0.0, 0.0], [0.03, 0.0, 0.0]]])
    still = np.concatenate([robots.reshape(1, COORDINATES), np.zeros((1, COORDINATES))], axis=1)
    behind, going = still.copy(), still.copy()
    behind[0, 1] -= 1e-3
    going[0, COORDINATES + 1] = 2e-3
    epms = actions.home(robots)
    first, _ = actions.to_epms(np.zeros((1, COORDINATES)), robots, epms, expected=behind)
    second, _ = actions.to_epms(np.zeros((1, COORDINATES)), robots, epms, expected=going)
    np.testing.assert_allclose(first, second, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(behind, going, rtol=1e-9, atol=1e-12)
    rest, _ = actions.to_epms(np.zeros((1, COORDINATES)), robots, epms, expected=still)
    assert np.abs(rest - first).max() > 1e-4


@pytest.mark.parametrize("scenario", ["eight-30", "approach-20"])
def test_robots_are_held_where_errors_grow_a_hundredfold(scenario: str) -> None:
    """In holds of half a second the calmest grow by some e^6 in ``eight-30``; at 10 Hz 20 mm can be held."""
    hz = 2.0 if scenario == "eight-30" else 10.0
    controller = Steered(control_hz=hz)
    episodes = Episodes(2, Settings(scenario, action="velocity", observation="errors", control_hz=hz))
    for row in range(2):
        episodes.seed(row, np.random.default_rng(row))
    active = np.ones(2, np.bool_)
    observed = episodes.start(active)
    for _ in range(round(50.0 * hz)):
        action, _ = controller.predict(observed)
        observed = episodes.step(action.astype(np.float64), active)
        assert not episodes.state.ended[0].any(), episodes.state.time


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
    episodes.state.expected[:, :COORDINATES] = robots.reshape(16, COORDINATES)
    episodes.step(np.zeros((16, COORDINATES)), everyone)
    moved = episodes.state.robots[..., :3] - robots
    missed = np.sqrt((moved[..., :2] ** 2).sum(axis=(1, 2))) / 1e-4, np.sqrt((moved[..., 2] ** 2).sum(axis=1)) / 3e-3
    told = episodes.state.solver == CONVERGED
    assert told.any()
    assert np.hypot(*missed)[told].max() < 2.0 + 1e-6
    assert told.all() or np.hypot(*missed)[~told].min() > 2.0 - 1e-6


def test_velocities_need_drag() -> None:
    """Other modes act on a plant without any as before."""
    bare = Plant(body=Body(drag_rotational_nmsprad=0.0))
    Actions("home", System(), plant=bare)
    with pytest.raises(ValueError, match="plant must be one with linear and rotational drag in velocity"):
        Actions("velocity", System(), plant=bare)
