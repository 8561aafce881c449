"""Derivatives of the motion against differences of the same motion; the model's motion against the plant's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from foreseen import (
    NATURAL,
    PAPER,
    UNMOVED,
    Floats,
    at_home,
    bases_of,
    end_of,
    foreseen,
    goal_of,
    held,
    on_the_way,
    paper_model,
    shifted,
    travelling,
    uneven_model,
)
from lane import magnets

from magenv.forecast import STATE
from magenv.params import PLANTS, System, TaskParams
from magenv.poses import from_cartesian
from magenv.sensitivity import Model
from magenv.stiffness import planar_kernel
from magenv.trajectories import shaped
from magenv.world import World
from magenv.wrench import planar_moments, robot_wrench

PUSH = np.array([1e-3, -2e-3, 3e-6, 2e-3, 1e-3, -4e-6])
"""N and N m: as much as the EPMs do."""
SUBSTEPS, MARKS = 40, (15, 40)


def difference(function: Callable[[float], Floats], size: float) -> Floats:
    """Derivative of a function of one number at zero: central differences of two widths, extrapolated."""
    wide, narrow = ((function(h) - function(-h)) / (2 * h) for h in (1e-3 * size, 5e-4 * size))
    return (4 * narrow - wide) / 3


def assert_derivatives(exact: Floats, expected: Floats, sizes: Floats, tolerance: float) -> None:
    """Compare column by column, each row in units of what is common of it; no column is empty."""
    rows = np.tile(1.0 / NATURAL, len(exact) // STATE)[:, None]
    error, least = np.abs(rows * (exact - expected) * sizes), np.abs(rows * expected * sizes).max(axis=0)
    assert least.min() > 1e-6
    assert (error / least).max() < tolerance


def a_motion(n_epm: int, rng: np.random.Generator) -> tuple[Model, Floats, Floats]:
    """Model, state and EPMs of robots 45 mm apart that move and turn."""
    state = on_the_way(0.03, 40.0) + rng.normal(size=STATE) * NATURAL
    return uneven_model(n_epm), state, shifted(at_home(state, n_epm), rng.normal(0.0, 0.03, 5 * n_epm))


@pytest.mark.parametrize("pushing", [UNMOVED, PUSH], ids=["free", "pushed"])
@pytest.mark.parametrize("n_epm", [2, 3])
def test_derivatives_by_state_and_command_are_those_of_the_motion(
    rng: np.random.Generator, n_epm: int, pushing: Floats
) -> None:
    model, state, epms = a_motion(n_epm, rng)
    near = np.stack([end_of(model, state, pushing, held(epms, mark)) for mark in MARKS])
    goal = goal_of(near + NATURAL, MARKS)
    sizes = np.concatenate([NATURAL, np.full(5 * n_epm, 0.03)])

    def residuals(column: int, h: float) -> Floats:
        moved = state + h * np.eye(STATE)[column] if column < STATE else state
        step = h * np.eye(len(sizes))[column][STATE:]
        return foreseen(model, moved, pushing, held(shifted(epms, step), SUBSTEPS), goal)[1]

    by = np.eye(STATE, len(sizes))
    end, errors, jacobian = foreseen(model, state, pushing, held(epms, SUBSTEPS), goal, by)
    np.testing.assert_array_equal(end, near[1])
    np.testing.assert_allclose(errors, np.tile(-NATURAL, 2), rtol=1e-9)
    expected = np.stack([difference(lambda h, c=c: residuals(c, h), sizes[c]) for c in range(len(sizes))], axis=1)
    assert_derivatives(jacobian, expected, sizes, 1e-7)
    np.testing.assert_array_equal(by, jacobian[STATE:])


@pytest.mark.parametrize("n_epm", [2, 3])
def test_derivatives_by_the_command_before_where_the_epms_travel(rng: np.random.Generator, n_epm: int) -> None:
    """Columns: the command before, the state, the command."""
    model, state, epms = a_motion(n_epm, rng)
    u = 5 * n_epm
    before = shifted(epms, rng.normal(0.0, 0.1, u))
    sizes = np.concatenate([np.full(u, 0.03), NATURAL, np.full(u, 0.03)])
    goal = goal_of(np.stack([end_of(model, state, PUSH, travelling(before, epms, SUBSTEPS))] * 2), MARKS)
    bases = bases_of(before), bases_of(epms)

    def residuals(z: Floats) -> Floats:
        old, new = z[:u].reshape(-1, 5, 1), z[u + STATE :].reshape(-1, 5, 1)
        motion = travelling(before + (bases[0] @ old)[..., 0], epms + (bases[1] @ new)[..., 0], SUBSTEPS)
        return foreseen(model, state + z[u : u + STATE], PUSH, motion, goal)[1]

    by = np.eye(STATE, len(sizes), u)
    jacobian = foreseen(model, state, PUSH, travelling(before, epms, SUBSTEPS), goal, by)[2]
    axes = np.eye(len(sizes))
    columns = [difference(lambda h, k=k: residuals(h * axes[k]), sizes[k]) for k in range(len(sizes))]
    assert_derivatives(jacobian, np.stack(columns, axis=1), sizes, 1e-7)


def test_derivatives_are_carried_from_motion_to_motion(rng: np.random.Generator) -> None:
    """Two motions one after the other, the derivatives of the first handed to the second, are one."""
    model, state, epms = a_motion(2, rng)
    whole, parts, goal = np.eye(STATE, 22), np.eye(STATE, 22), goal_of(np.zeros((1, STATE)), (SUBSTEPS,))
    end, _, jacobian = foreseen(model, state, PUSH, held(epms, SUBSTEPS), goal, whole)
    middle = foreseen(model, state, PUSH, held(epms, 15), goal_of(np.zeros((1, STATE)), (15,)), parts)[0]
    rest = held(epms, SUBSTEPS - 15)
    later, _, by = foreseen(model, middle, PUSH, rest, goal_of(np.zeros((1, STATE)), (SUBSTEPS - 15,)), parts)
    np.testing.assert_array_equal(later, end)
    np.testing.assert_array_equal(by, jacobian)
    np.testing.assert_array_equal(parts, whole)


def test_errors_are_weighted_and_headings_wrapped(rng: np.random.Generator) -> None:
    """A reference turns told otherwise changes no error; weights scale errors and their derivatives."""
    model, state, epms = a_motion(2, rng)
    turns, weights = np.zeros(STATE), rng.uniform(0.5, 2.0, STATE)
    turns[[2, 5]] = [2 * np.pi, -4 * np.pi]
    end = end_of(model, state, UNMOVED, held(epms, SUBSTEPS))
    _, errors, jacobian = foreseen(
        model, state, UNMOVED, held(epms, SUBSTEPS), goal_of(end[None], (SUBSTEPS,)), np.eye(STATE, 22)
    )
    np.testing.assert_array_equal(errors, np.zeros(STATE))
    goal = goal_of((end + turns + 0.1)[None], (SUBSTEPS,), weights)
    _, errors, by = foreseen(model, state, UNMOVED, held(epms, SUBSTEPS), goal, np.eye(STATE, 22))
    np.testing.assert_allclose(errors, -0.1 * weights, rtol=1e-12)
    np.testing.assert_allclose(by, weights[:, None] * jacobian, rtol=1e-14)


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("control_hz", [2.0, 7.0])
def test_the_models_motion_is_the_plants_bit_for_bit(rng: np.random.Generator, n_epm: int, control_hz: float) -> None:
    system, task = System(n_epm=n_epm), TaskParams(control_hz=control_hz, loss_distance_m=10.0)
    world, state = World(1, system, PAPER, task), on_the_way(0.06, 50.0)
    epms = at_home(state, n_epm) * [2.2, 2.2, 2.2, 1.0, 1.0, 1.0]  # far away, so that the robots do not soon meet
    robots = np.concatenate([state[:6].reshape(2, 3), state[6:].reshape(2, 3)], axis=1)
    world.start(0, shaped("approach", 0.06), robots, epms)
    model = Model.of(system, PAPER, task.period_s / world.substeps)
    for _ in range(3):
        epms = shifted(epms, rng.normal(0.0, 0.05, 5 * n_epm))
        world.step(epms[None], np.ones(1, np.bool_))
        assert world.measurements.loss[0] == 0
        state = end_of(model, state, UNMOVED, held(epms, world.substeps))
        np.testing.assert_array_equal(state[:6], world.robots[0, :, :3].ravel())
        np.testing.assert_array_equal(state[6:], world.robots[0, :, 3:].ravel())


def one_epms_wrench(q: Floats, epm: Floats, moment: float, ipm: float) -> Floats:
    """F_x, F_y, tau_z of both robots (6,) at x, y, heading of both (6,) under one EPM, by the laws of ``wrench``."""
    positions, headings = np.zeros((2, 3)), q[2::3]
    positions[:, :2] = q.reshape(2, 3)[:, :2]
    pose = from_cartesian(epm[None, :3], epm[None, 3:])
    u = robot_wrench(positions, planar_moments(headings, ipm), pose, moment).reshape(2, 5)
    c, s = np.cos(headings), np.sin(headings)
    return np.stack([c * u[:, 2] - s * u[:, 3], s * u[:, 2] + c * u[:, 3], u[:, 1]], axis=-1).ravel()


@pytest.mark.parametrize("n_epm", [1, 2, 3])
def test_gradients_of_the_planar_wrench_are_those_of_the_wrench(rng: np.random.Generator, n_epm: int) -> None:
    """By the robots and the EPMs' centres: differences. By the moments, which act linearly: what unit moments do."""
    ipm = System().ipm_moment_am2
    moments, far = rng.uniform(500.0, 1000.0, n_epm), np.array([0.0, 0.0, 1e6, 0.0, 0.0, 1.0])
    for _ in range(5):
        epms, q = magnets(rng, System(n_epm=n_epm)), rng.uniform(-0.04, 0.04, 6) * [1, 1, 60, 1, 1, 60]
        positions, stiffness, gradients = np.zeros((2, 3)), np.empty((6, 6)), np.empty((6, 6 * n_epm))
        positions[:, :2] = q.reshape(2, 3)[:, :2]
        planar_kernel(positions, planar_moments(q[2::3], ipm), epms, moments, True, stiffness, gradients)

        def wrench(step: Floats, q: Floats = q, epms: Floats = epms) -> Floats:
            """Wrench after a step of the robots (6,), then of the EPMs (6 N,)."""
            moved, places = q + step[:6], epms + step[6:].reshape(-1, 6)
            mutual = one_epms_wrench(moved, far, 1.0, ipm)
            each = [one_epms_wrench(moved, epm, m, ipm) - mutual for epm, m in zip(places, moments, strict=True)]
            return np.asarray(mutual + np.sum(each, axis=0))

        unit = np.eye(6 + 6 * n_epm)
        by_robots = np.stack([difference(lambda h, e=e, f=wrench: f(h * e), 1e-3) for e in unit[:6]], axis=1)
        scale = np.abs(stiffness).max(axis=1, keepdims=True)
        np.testing.assert_allclose(stiffness / scale, by_robots / scale, atol=1e-8)
        mutual, scale = one_epms_wrench(q, far, 1.0, ipm), np.abs(gradients).max(axis=1, keepdims=True)
        for k in range(n_epm):
            columns = slice(6 + 6 * k, 9 + 6 * k)
            by_centre = [difference(lambda h, e=e, f=wrench: f(h * e), 1e-2) for e in unit[columns]]
            ends = [np.concatenate([epms[k, :3], axis]) for axis in np.eye(3)]
            by_moment = [one_epms_wrench(q, end, moments[k], ipm) - mutual for end in ends]
            expected = np.stack(by_centre + by_moment, axis=1)
            np.testing.assert_allclose(gradients[:, 6 * k : 6 * k + 6] / scale, expected / scale, atol=1e-8)


def test_stiffness_is_the_same_without_gradients(rng: np.random.Generator) -> None:
    epms, robots = magnets(rng), planar_moments([0.3, -2.0], 0.1)
    positions, moments = np.array([[0.02, 0.01, 0.0], [-0.02, 0.0, 0.0]]), np.array([900.0, 700.0])
    one, two, kept = np.empty((6, 6)), np.empty((6, 6)), np.full((6, 12), 7.0)
    planar_kernel(positions, robots, epms, moments, False, one, kept)
    assert (kept == 7.0).all()
    planar_kernel(positions, robots, epms, moments, True, two, kept)
    np.testing.assert_array_equal(one, two)


def test_a_model_shares_no_memory_with_another() -> None:
    one, two = paper_model(), paper_model()
    one.epm_moment[:] = 0.0
    one.lane[:] = 0.0
    assert two.epm_moment.min() > 0.0
    assert np.abs(two.lane).max() > 0.0


def test_to_a_model_epms_are_dipoles() -> None:
    """Of a plant in which they are cylinders as well."""
    state = on_the_way(0.06, 50.0)
    models = (Model.of(System(), plant, PAPER.substep_s) for plant in (PAPER, PLANTS["cylinders"]))
    one, two = (end_of(model, state, UNMOVED, held(at_home(state), 40)) for model in models)
    np.testing.assert_array_equal(one, two)
