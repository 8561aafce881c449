"""What a command makes of the doubt about a state: the direction that grows most, its growth, its derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from foreseen import (
    CERTAIN,
    NATURAL,
    UNMOVED,
    WEIGHTS,
    Floats,
    at_home,
    end_of,
    foreseen,
    goal_of,
    held,
    on_the_way,
    shifted,
    uneven_model,
)

from magenv.forecast import STATE, Goal
from magenv.risk import lean_on, risk
from magenv.sensitivity import Model

SUBSTEPS, MARKS = 40, (20, 40)


class Doubted:
    """A motion from a state that is not known for certain."""

    def __init__(self, rng: np.random.Generator, n_epm: int, size: float) -> None:
        self.model: Model = uneven_model(n_epm)
        self.state = on_the_way(0.04, 45.0) + 0.3 * rng.normal(size=STATE) * NATURAL
        self.epms = shifted(at_home(self.state, n_epm), rng.normal(0.0, 0.03, 5 * n_epm))
        end = end_of(self.model, self.state, UNMOVED, held(self.epms, SUBSTEPS)) + NATURAL * rng.normal(size=STATE)
        self.goal: Goal = goal_of(np.stack([end, end]), MARKS, WEIGHTS)
        self.root = size * NATURAL[:, None] * rng.normal(size=(STATE, STATE))

    def linearised(self, epms: Floats) -> tuple[Floats, Floats, Floats]:
        """Errors (24,), their derivatives by the command (24, 5 N), those of the last state by the first (12, 12)."""
        by = np.eye(STATE, STATE + 5 * len(epms))
        _, errors, jacobian = foreseen(self.model, self.state, UNMOVED, held(epms, SUBSTEPS), self.goal, by)
        return errors, jacobian[:, STATE:].copy(), by[:, :STATE].copy()

    def leant(self, epms: Floats, lean: Floats, scale: float) -> tuple[float, Floats, Floats]:
        """Cost, residuals (12,) and derivatives (12, 5 N) of what is leant on."""
        errors, by, _ = self.linearised(epms)
        residuals, jacobian = np.zeros(3 * STATE), np.zeros((3 * STATE, 3 + by.shape[1]))
        residuals[: 2 * STATE], jacobian[: 2 * STATE, 3:] = errors, by
        motion, seen = held(epms, SUBSTEPS), np.zeros((STATE, by.shape[1]))
        cost = risk(self.model, UNMOVED, motion, self.goal, 0, self.state, lean, scale, seen, residuals, jacobian)
        np.testing.assert_array_equal(residuals[: 2 * STATE], errors)
        assert (jacobian[:, :3] == 0.0).all(), "columns that are not the command's"
        return cost, residuals[2 * STATE :], jacobian[2 * STATE :, 3:]


@pytest.mark.parametrize("size", [1e-9, 1e-3, 10.0])
def test_what_grows_most_is_leant_on(rng: np.random.Generator, size: float) -> None:
    """The first singular vector of the weighted, grown doubt; its size does not matter, it is scaled."""
    for _ in range(10):
        root, by, lean = size * rng.normal(size=(STATE, STATE)), rng.normal(size=(STATE, STATE)), np.empty(STATE)
        by[:, 0] *= 10.0  # one direction that grows more than all others
        scale = lean_on(by, WEIGHTS, root, lean)
        _, values, right = np.linalg.svd(WEIGHTS[:, None] * (by @ root))
        grown = WEIGHTS * (by @ lean)
        assert np.linalg.norm(grown) / scale == pytest.approx(values[0], rel=0.01)
        assert np.linalg.norm(grown) <= scale * values[0] * (1 + 1e-12)
        assert np.linalg.norm(grown) == pytest.approx(1e-3, rel=0.01)
        inside = np.linalg.solve(root, lean) / scale
        assert np.linalg.norm(inside) == pytest.approx(1.0, rel=1e-9), "one standard deviation, scaled"
        assert abs(inside @ right[0]) > 0.9


def test_where_nothing_is_in_doubt_nothing_is_leant_on(rng: np.random.Generator) -> None:
    assert lean_on(rng.normal(size=(STATE, STATE)), WEIGHTS, CERTAIN, np.empty(STATE)) == 0.0
    assert lean_on(CERTAIN, WEIGHTS, np.eye(STATE), np.empty(STATE)) == 0.0
    assert lean_on(np.full((STATE, STATE), np.nan), WEIGHTS, np.eye(STATE), np.empty(STATE)) == 0.0


@pytest.mark.parametrize("n_epm", [2, 3])
@pytest.mark.parametrize("size", [1e-6, 1e-3, 1.0])
def test_the_risk_is_that_of_the_linearised_motion(rng: np.random.Generator, n_epm: int, size: float) -> None:
    """Squared, the growth of one standard deviation of what grows most, in weighted errors at the last mark."""
    case, lean = Doubted(rng, n_epm, size), np.empty(STATE)
    by = case.linearised(case.epms)[2]
    scale = lean_on(by, WEIGHTS, case.root, lean)
    cost, residuals, _ = case.leant(case.epms, lean, scale)
    np.testing.assert_allclose(residuals, WEIGHTS * (by @ lean) / scale, atol=1e-3 * np.abs(residuals).max())
    assert cost == pytest.approx(residuals @ residuals, rel=1e-12)
    largest = np.linalg.svd(WEIGHTS[:, None] * (by @ case.root), compute_uv=False)[0]
    assert 0.8 * largest**2 < cost < 1.001 * largest**2


@pytest.mark.parametrize("n_epm", [2, 3])
def test_its_derivatives_are_those_of_the_growth(rng: np.random.Generator, n_epm: int) -> None:
    case, lean = Doubted(rng, n_epm, 0.1), np.empty(STATE)
    scale = lean_on(case.linearised(case.epms)[2], WEIGHTS, case.root, lean)
    jacobian, h = case.leant(case.epms, lean, scale)[2], 1e-4
    for column, e in enumerate(np.eye(5 * n_epm)):
        up, down = (case.leant(shifted(case.epms, sign * h * e), lean, scale)[1] for sign in (1.0, -1.0))
        expected = (up - down) / (2 * h)
        np.testing.assert_allclose(jacobian[:, column], expected, atol=1e-4 * np.abs(jacobian[:, column]).max())


def test_an_error_of_half_a_turn_is_no_risk(rng: np.random.Generator) -> None:
    """Where a heading is opposite to its reference, its error wraps; the growth of the doubt does not."""
    case, lean = Doubted(rng, 2, 1e-3), np.empty(STATE)
    by = case.linearised(case.epms)[2]
    scale = lean_on(by, WEIGHTS, case.root, lean)
    end = end_of(case.model, case.state, UNMOVED, held(case.epms, SUBSTEPS))
    for beyond in (-1e-9, 1e-9):
        case.goal.references[0, -1] = end
        case.goal.references[0, -1, 2] += np.pi + beyond
        _, residuals, _ = case.leant(case.epms, lean, scale)
        np.testing.assert_allclose(residuals, WEIGHTS * (by @ lean) / scale, atol=1e-3 * np.abs(residuals).max())
