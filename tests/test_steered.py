"""The controller that asks for the velocity to the reference."""

from __future__ import annotations

import numpy as np
import pytest

from agents.catalogue import controller
from agents.metrics import summarise
from agents.rollout import run
from agents.steered import Steered
from magenv.episodes import Episodes, Settings
from magenv.velocity import VELOCITY_MPS, VELOCITY_RADPS


@pytest.mark.parametrize("control_hz", [2.0, 10.0])
def test_it_asks_for_the_way_to_the_reference_in_one_hold(control_hz: float) -> None:
    """In the robots' frame, from the errors that an observation begins with."""
    episodes = Episodes(4, Settings("random", action="velocity", observation="errors", control_hz=control_hz))
    for row in range(4):
        episodes.seed(row, np.random.default_rng(row))
    observation = episodes.start(np.ones(4, np.bool_))
    action, state = Steered(control_hz).predict(observation)
    assert state is None
    errors = observation.reshape(4, 2, 4).astype(np.float64)
    way = action.reshape(4, 2, 3) * np.array([VELOCITY_MPS, VELOCITY_MPS, VELOCITY_RADPS]) / control_hz
    slow = np.abs(action.reshape(4, 2, 3)) < 1.0
    assert slow.any()
    expected = np.concatenate([0.03 * errors[..., :2], np.arctan2(errors[..., 2:3], errors[..., 3:])], axis=-1)
    np.testing.assert_allclose(way[slow], expected[slow], rtol=1e-5, atol=1e-9)
    np.testing.assert_array_equal(Steered(control_hz).predict(observation[0])[0], action[0])


def test_it_holds_the_papers_scenario_better_than_the_paper() -> None:
    row = summarise(run(controller("steered"), "approach-60", episodes=2))[0]
    assert row.success_rate == 1.0
    assert row.position_error_mm is not None
    assert row.position_error_mm < 0.2
    assert row.heading_error_deg is not None
    assert row.heading_error_deg < 0.5
