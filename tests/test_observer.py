"""The filter of state, push and moments against filters written otherwise, and against what is truly so."""

from __future__ import annotations

import math

import numpy as np
import pytest
from foreseen import NATURAL, PAPER, UNMOVED, Floats, at_home, end_of, held, on_the_way, paper_model, uneven_model

from magenv.forecast import STATE, Course
from magenv.observer import MOMENTS, Noise, correct, forecast
from magenv.sensitivity import Model, believe

SUBSTEPS = 10
"""Of 5 ms: 20 measurements a second."""
SECONDS = SUBSTEPS * PAPER.substep_s
PUSH = np.array([2e-4, -1e-4, 1e-6, -3e-4, 2e-4, -2e-6])
POSE, PUSHING = NATURAL[:6], np.abs(PUSH)
SIZES = np.concatenate([NATURAL, PUSHING, np.full(4, 0.1)])
KNOWN = len(SIZES)
NOISE = Noise((0.1 * POSE) ** 2, (0.3 * PUSHING) ** 2, (0.3 * NATURAL[6:]) ** 2)
EXACT = Noise((1e-3 * POSE) ** 2, np.zeros(6), np.zeros(6))


def apart(known: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Copies: the filter works in place."""
    return known.copy(), covariance.copy()


def an_estimate(rng: np.random.Generator, n_epm: int = 2) -> tuple[Floats, Floats]:
    """Estimate (20 + N,) on an approach, and a covariance in which all hangs together."""
    n, sizes = MOMENTS + n_epm + 2, np.concatenate([SIZES[:MOMENTS], np.full(n_epm + 2, 0.1)])
    known = np.concatenate([on_the_way(0.06, 40.0), PUSH, np.zeros(n_epm + 2)]) + 0.1 * sizes * rng.normal(size=n)
    root = rng.normal(0.0, 0.3, (n, n)) + np.eye(n)
    return known, 0.01 * sizes[:, None] * (root @ root.T) * sizes


def without_magnets() -> tuple[Model, Course]:
    """A plant whose motion is linear: drag and push alone."""
    model = uneven_model(2)
    model.nominal[:] = 0.0
    return model, held(at_home(on_the_way(0.06, 40.0)), SUBSTEPS)


def kalman(transition: Floats, noise: Noise, known: Floats, covariance: Floats, poses: Floats) -> tuple[Floats, Floats]:
    """One turn of the textbook's filter: gain by a matrix inverse, covariance by (I - K H) P."""
    n = len(known)
    q = np.diag(np.concatenate([np.zeros(6), noise.unsteady, noise.drift, np.zeros(n - MOMENTS)]) * SECONDS)
    predicted = transition @ covariance @ transition.T + q
    look = np.eye(6, n)
    gain = predicted @ look.T @ np.linalg.inv(look @ predicted @ look.T + np.diag(noise.measured))
    return known + gain @ (poses - known[:6]), (np.eye(n) - gain @ look) @ predicted


def assert_close(one: tuple[Floats, Floats], two: tuple[Floats, Floats], tolerance: float) -> None:
    """Compare estimates and covariances in the units of the estimate's own deviations."""
    deviation = np.sqrt(np.diag(two[1]))
    np.testing.assert_allclose((one[0] - two[0]) / deviation, 0.0, atol=tolerance)
    np.testing.assert_allclose((one[1] - two[1]) / np.outer(deviation, deviation), 0.0, atol=tolerance)


def test_where_the_motion_is_linear_it_is_kalmans_filter(rng: np.random.Generator) -> None:
    """The transition is worked out from masses and drags: half a drift, a kick m v' = u - c v, half a drift."""
    model, motion = without_magnets()
    body, h = PAPER.body, PAPER.substep_s
    substep = np.eye(KNOWN)
    for i in range(6):
        inertia, drag = body.mass_kg, body.drag_linear_nspm
        if i % 3 == 2:
            inertia, drag = body.inertia_kgm2, body.drag_rotational_nmsprad
        if i // 3 == 1:  # see uneven_model
            inertia, drag = (0.8 * inertia, 1.4 * drag) if i % 3 == 2 else (1.3 * inertia, 1.7 * drag)
        decay = math.exp(-drag * h / inertia)
        substep[6 + i, 6 + i], substep[6 + i, 12 + i] = decay, (1 - decay) / drag
        substep[i, 6 + i], substep[i, 12 + i] = 0.5 * h * (1 + decay), 0.5 * h * (1 - decay) / drag
    transition = np.linalg.matrix_power(substep, SUBSTEPS)
    one = an_estimate(rng)
    two = apart(*one)
    for _ in range(30):
        poses = (transition @ two[0])[:6] + 0.3 * POSE * rng.normal(size=6)
        two = kalman(transition, NOISE, transition @ two[0], two[1], poses)
        forecast(model, motion, 0, SUBSTEPS, NOISE, *one)
        correct(poses, NOISE, *one)
        assert_close(one, two, 1e-9)


@pytest.mark.parametrize("n_epm", [2, 3])
def test_among_magnets_it_is_the_extended_filter(rng: np.random.Generator, n_epm: int) -> None:
    """The transition by differences of the predicted motion."""
    model = uneven_model(n_epm)
    one = an_estimate(rng, n_epm)
    motion, sizes = held(at_home(one[0], n_epm), SUBSTEPS), np.concatenate([SIZES, np.full(n_epm - 2, 0.1)])

    def carried(known: Floats) -> Floats:
        believe(model, known[MOMENTS:])
        return np.concatenate([end_of(model, known[:STATE], known[STATE:MOMENTS], motion), known[STATE:]])

    for _ in range(4):
        before = apart(*one)
        steps = 1e-3 * np.diag(sizes)
        columns = [(carried(before[0] + e) - carried(before[0] - e)) / (2 * e.sum()) for e in steps]
        forecast(model, motion, 0, SUBSTEPS, NOISE, *one)
        np.testing.assert_array_equal(one[0], carried(before[0]))
        poses = one[0][:6] + 0.3 * POSE * rng.normal(size=6)
        two = kalman(np.stack(columns, axis=1), NOISE, one[0], before[1], poses)
        correct(poses, NOISE, *one)
        assert_close(one, two, 1e-5)


def test_a_forecast_in_parts_is_one_of_the_whole(rng: np.random.Generator) -> None:
    model, one = uneven_model(2), an_estimate(rng)
    motion, two = held(at_home(one[0]), SUBSTEPS), apart(*one)
    forecast(model, motion, 0, SUBSTEPS, EXACT, *one)
    forecast(model, motion, 0, 3, EXACT, *two)
    forecast(model, motion, 3, SUBSTEPS, EXACT, *two)
    np.testing.assert_array_equal(one[0], two[0])
    assert_close(one, two, 1e-12)


def ignorant(state: Floats, rates: Floats, pushing: Floats, noise: Noise) -> tuple[Floats, Floats]:
    """Estimate at rest and unpushed, with these standard deviations of rates and push."""
    variances = np.concatenate([noise.measured, rates**2, pushing**2, np.zeros(4)])
    return np.concatenate([state[:6], np.zeros(KNOWN - 6)]), np.diag(variances)


def test_rates_are_found_from_poses_alone(rng: np.random.Generator) -> None:
    """Robots at 30 mm/s and 1 rad/s taken to be at rest: three poses 10 ms apart tell the rates within 0.2 %.

    Poses are exact to 0.1 um and 3 urad. Drag alone would leave over half of the error.
    """
    noise = Noise(np.array([1e-7, 1e-7, 3e-6] * 2) ** 2, np.zeros(6), np.zeros(6))
    model, state = paper_model(), on_the_way(0.06, 40.0)
    fast = np.array([0.03, -0.03, 1.0, -0.03, 0.03, -1.0])
    state[6:], motion = fast, held(at_home(state), 2)
    known, covariance = ignorant(state, 3 * np.abs(fast), UNMOVED, noise)
    untold = known[:STATE].copy()
    for _ in range(3):
        state, untold = (end_of(model, each, UNMOVED, motion) for each in (state, untold))
        forecast(model, motion, 0, 2, noise, known, covariance)
        correct(state[:6] + rng.normal(size=6) * np.sqrt(noise.measured), noise, known, covariance)
    moving = [0, 1, 3, 4]  # in 30 ms rotational drag makes an end of the turning
    assert (np.abs(untold - state)[6:][moving] > 0.5 * 0.03).all()
    assert (np.abs(known[:STATE] - state)[6:] < 2e-3 * np.abs(fast)).all()


def test_moments_are_found_from_the_motion() -> None:
    """EPMs and robots 10 to 15 % off: their products, by which EPMs act on robots, are found within half a per cent."""
    truth, model = paper_model(), paper_model()
    amiss, noise = np.array([0.15, -0.1, 0.1, -0.12]), EXACT
    believe(truth, amiss)
    state = on_the_way(0.03, 30.0)
    known, covariance = ignorant(state, 0.1 * NATURAL[6:], UNMOVED, noise)
    covariance[MOMENTS:, MOMENTS:] = 0.01 * np.eye(4)
    for turn in range(40):  # placed anew, as nobody holds them
        state = known[:STATE] = on_the_way(0.03, 30.0 + turn)
        covariance[:STATE], covariance[:, :STATE] = 0.0, 0.0
        motion = held(at_home(state), SUBSTEPS)
        state = end_of(truth, state, UNMOVED, motion)
        forecast(model, motion, 0, SUBSTEPS, noise, known, covariance)
        correct(state[:6], noise, known, covariance)
    found, true = (np.outer(1 + x[:2], 1 + x[2:]) for x in (known[MOMENTS:], amiss))
    np.testing.assert_allclose(found, true, rtol=5e-3)
    assert np.abs(true - 1.0).max() > 0.2


@pytest.mark.parametrize("scenario_m", [0.06, 0.03])
def test_a_constant_push_is_found_and_its_error_goes(scenario_m: float) -> None:
    """Told of no push, the filter expects poses beside the true ones for ever; else the error falls a thousandfold."""
    model, late = paper_model(), {}
    for told in (False, True):
        pushing = 3 * PUSHING if told else UNMOVED
        state = on_the_way(scenario_m, 50.0)
        known, covariance = ignorant(state, 0.1 * NATURAL[6:], pushing, EXACT)
        errors = []
        for _ in range(8):
            motion = held(at_home(state), SUBSTEPS)
            state = end_of(model, state, PUSH, motion)
            forecast(model, motion, 0, SUBSTEPS, EXACT, known, covariance)
            errors.append(np.abs((known[:6] - state[:6]) / POSE).max())
            correct(state[:6], EXACT, known, covariance)
        late[told] = max(errors[-3:])
        if told:
            np.testing.assert_allclose(known[STATE:MOMENTS], PUSH, rtol=2e-3)
    assert late[True] < 1e-3 * late[False]
    assert late[False] > 0.1, "0.1 mm or 3 mrad in each period"


def test_a_covariance_stays_symmetric_and_positive(rng: np.random.Generator) -> None:
    """Over 300 corrections, from measurements far more exact than the prediction to such as tell nothing."""
    model, (known, covariance) = uneven_model(2), an_estimate(rng)
    for turn in range(300):
        noise = NOISE._replace(measured=NOISE.measured * 10.0 ** rng.uniform(-10, 6, 6))
        if turn % 10 == 0:  # the robots are led back, so that they never meet
            known[:STATE] = on_the_way(0.06, rng.uniform(0.0, 100.0))
        forecast(model, held(at_home(known), 2), 0, 2, noise, known, covariance)
        correct(known[:6] + 1e-3 * POSE * rng.normal(size=6), noise, known, covariance)
        deviation = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(deviation, deviation)
        np.testing.assert_allclose(correlation, correlation.T, atol=1e-12)
        assert np.linalg.eigvalsh(0.5 * (correlation + correlation.T))[0] > -1e-12
        assert np.isfinite(known).all()


def test_a_correction_makes_nothing_less_certain(rng: np.random.Generator) -> None:
    known, covariance = an_estimate(rng)
    before = covariance.copy()
    correct(known[:6], NOISE, known, covariance)
    assert np.linalg.eigvalsh((before - covariance) / np.outer(SIZES, SIZES))[0] > -1e-12
    assert (np.diag(covariance)[:6] < NOISE.measured).all(), "no pose is less certain than its measurement"


def test_where_the_noise_is_as_reckoned_surprises_are_six_in_the_mean(rng: np.random.Generator) -> None:
    """Squared innovations over their variance: chi squared of six degrees of freedom, variance twelve."""
    noise = Noise((0.02 * POSE) ** 2, (0.1 * PUSHING) ** 2, (0.1 * NATURAL[6:]) ** 2)
    model, surprises = uneven_model(2), []
    for _ in range(40):
        state = on_the_way(0.06, rng.uniform(20.0, 80.0))
        known, covariance = ignorant(state, 0.1 * NATURAL[6:], PUSHING, noise)
        motion, truth = held(at_home(state), SUBSTEPS), known + rng.normal(size=KNOWN) * np.sqrt(np.diag(covariance))
        for _ in range(6):
            truth[:STATE] = end_of(model, truth[:STATE], truth[STATE:MOMENTS], motion)
            truth[6:STATE] += rng.normal(size=6) * np.sqrt(SECONDS * noise.unsteady)
            truth[STATE:MOMENTS] += rng.normal(size=6) * np.sqrt(SECONDS * noise.drift)
            poses = truth[:6] + rng.normal(size=6) * np.sqrt(noise.measured)
            forecast(model, motion, 0, SUBSTEPS, noise, known, covariance)
            surprises.append(correct(poses, noise, known, covariance))
    n = len(surprises)
    assert abs(np.mean(surprises) - 6.0) < 3.0 * math.sqrt(12.0 / n)
    assert np.var(surprises) == pytest.approx(12.0, rel=0.4)


@pytest.mark.parametrize("turns", [1, -3])
def test_a_heading_told_otherwise_is_the_same_heading(rng: np.random.Generator, turns: int) -> None:
    one = an_estimate(rng)
    two = apart(*one)
    poses = one[0][:6] + POSE
    poses[2], poses[5] = 3.1, -3.1
    one[0][[2, 5]] = two[0][[2, 5]] = -3.13, 3.13  # less than a tenth of a radian from there, across the cut
    surprise = correct(poses, NOISE, *one)
    poses[[2, 5]] += 2 * np.pi * turns
    assert correct(poses, NOISE, *two) == pytest.approx(surprise, rel=1e-9)
    assert_close(one, two, 1e-9)
    assert np.abs(np.abs(one[0][[2, 5]]) - np.pi).max() < 0.06


def test_what_cannot_be_corrected_is_left_as_it_is(rng: np.random.Generator) -> None:
    known, covariance = an_estimate(rng)
    covariance[0, 0] = np.nan
    one = apart(known, covariance)
    assert correct(known[:6], NOISE, *one) == math.inf
    np.testing.assert_array_equal(one[0], known)
    np.testing.assert_array_equal(one[1], covariance)
