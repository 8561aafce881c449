"""The PID against numbers worked out by hand."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from agents.pid import Gains, PIDState, pid_wrench

Floats = NDArray[np.float64]

GAINS = Gains(force_p=2.0, force_i=0.5, force_d=0.1, torque_p=1e-3, torque_i=2e-4, torque_d=5e-5)
PERIOD_S = 0.5


def errors(n: int, steps: int, seed: int) -> Floats:
    """Return errors (steps, n, 2, 3) of the size of a real episode's."""
    return np.random.default_rng(seed).normal(0.0, [0.01, 0.01, 0.3], (steps, n, 2, 3))


def answers(sequence: Floats, state: PIDState) -> Floats:
    """Return the PID's wrenches (steps, n, 2, 3) for a sequence of errors."""
    return np.stack([pid_wrench(error, state, GAINS, PERIOD_S) for error in sequence])


def test_a_sequence_worked_out_by_hand() -> None:
    state = PIDState.start(1)
    # Robot 1 errs in x alone, robot 2 in its heading alone. Integral of x: 0.005, 0.015, 0.0225 m s; its change: none
    # yet, 0.01, -0.005 m. Integral of the heading: 0.1, 0.05, 0.2 rad s; its change: none yet, -0.3, 0.4 rad.
    x, heading = [0.010, 0.020, 0.015], [0.2, -0.1, 0.3]
    force = [
        2.0 * 0.010 + 0.5 * 0.0050,
        2.0 * 0.020 + 0.5 * 0.0150 + 0.1 * 0.010 / 0.5,
        2.0 * 0.015 + 0.5 * 0.0225 - 0.1 * 0.005 / 0.5,
    ]
    torque = [
        1e-3 * 0.2 + 2e-4 * 0.10,
        1e-3 * -0.1 + 2e-4 * 0.05 - 5e-5 * 0.3 / 0.5,
        1e-3 * 0.3 + 2e-4 * 0.20 + 5e-5 * 0.4 / 0.5,
    ]
    assert force == pytest.approx([0.0225, 0.0495, 0.04025])  # what a pocket calculator says
    assert torque == pytest.approx([2.2e-4, -1.2e-4, 3.8e-4])
    for step in range(3):
        error = np.array([[[x[step], 0.0, 0.0], [0.0, 0.0, heading[step]]]])
        expected = np.array([[[force[step], 0.0, 0.0], [0.0, 0.0, torque[step]]]])
        np.testing.assert_allclose(pid_wrench(error, state, GAINS, PERIOD_S), expected, rtol=1e-12, atol=1e-18)


def test_x_and_y_and_both_robots_are_treated_alike() -> None:
    sequence = errors(3, 6, seed=1)
    wrenches = answers(sequence, PIDState.start(3))
    swapped = answers(sequence[:, :, ::-1][..., [1, 0, 2]], PIDState.start(3))
    np.testing.assert_array_equal(swapped, wrenches[:, :, ::-1][..., [1, 0, 2]])


@pytest.mark.parametrize(("before", "after", "change"), [(3.1, -3.1, 2 * math.pi - 6.2), (-3.0, 3.0, 6 - 2 * math.pi)])
def test_a_heading_error_that_wraps_has_a_small_derivative(before: float, after: float, change: float) -> None:
    derivative = Gains(force_p=0.0, force_i=0.0, force_d=0.1, torque_p=0.0, torque_d=5e-5)
    state = PIDState.start(1)
    pid_wrench(np.array([[[0.0, 0.0, before]] * 2]), state, derivative, PERIOD_S)
    torque = pid_wrench(np.array([[[0.0, 0.0, after]] * 2]), state, derivative, PERIOD_S)[0, :, 2]
    assert abs(change) < 0.3
    np.testing.assert_allclose(torque, 5e-5 * change / PERIOD_S, rtol=1e-12)


def test_a_position_error_does_not_wrap() -> None:
    derivative = Gains(force_p=0.0, force_i=0.0, force_d=1.0, torque_p=0.0)
    state = PIDState.start(1)
    pid_wrench(np.full((1, 2, 3), 5.0), state, derivative, PERIOD_S)
    force = pid_wrench(np.full((1, 2, 3), -5.0), state, derivative, PERIOD_S)[..., :2]
    np.testing.assert_allclose(force, -10.0 / PERIOD_S)


def test_a_restarted_row_is_as_new_and_the_others_go_on() -> None:
    past, future = errors(3, 4, seed=2), errors(3, 3, seed=3)
    mask = np.array([False, True, False])
    state, undisturbed = PIDState.start(3), PIDState.start(3)
    answers(past, state)
    answers(past, undisturbed)
    state.restart(mask)
    seen, going_on, new = (answers(future, s) for s in (state, undisturbed, PIDState.start(3)))
    np.testing.assert_array_equal(seen[:, mask], new[:, mask])
    np.testing.assert_array_equal(seen[:, ~mask], going_on[:, ~mask])
    assert not np.isclose(seen[:, mask], going_on[:, mask]).any()


def test_rows_do_not_know_of_each_other() -> None:
    sequence = errors(5, 6, seed=4)
    together = answers(sequence, PIDState.start(5))
    for row in range(5):
        alone = answers(sequence[:, row : row + 1], PIDState.start(1))
        np.testing.assert_array_equal(alone, together[:, row : row + 1])


def test_the_errors_are_neither_changed_nor_kept_by_reference() -> None:
    first, second = errors(2, 2, seed=5)
    kept, state, fresh = first.copy(), PIDState.start(2), PIDState.start(2)
    pid_wrench(first, state, GAINS, PERIOD_S)
    np.testing.assert_array_equal(first, kept)
    pid_wrench(kept, fresh, GAINS, PERIOD_S)
    first[:] = 99.0  # the caller goes on using its array
    np.testing.assert_array_equal(
        pid_wrench(second, state, GAINS, PERIOD_S), pid_wrench(second, fresh, GAINS, PERIOD_S)
    )


def test_a_state_can_be_copied_and_replayed() -> None:
    past, future = errors(2, 3, seed=6), errors(2, 3, seed=7)
    state = PIDState.start(2)
    answers(past, state)
    copied = copy.deepcopy(state)
    np.testing.assert_array_equal(answers(future, state), answers(future, copied))


@pytest.mark.parametrize("name", ["force_p", "force_i", "force_d", "torque_p", "torque_i", "torque_d"])
@pytest.mark.parametrize("value", [-1e-9, math.nan, math.inf])
def test_impossible_gains_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"Input {name} must be a finite number of at least 0; instead received"):
        Gains(**(vars(GAINS) | {name: value}))
