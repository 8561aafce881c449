"""The predictive controller that is drawn home: its commands hang on the present alone, and they serve."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from messages import refusal

from agents.homing import Homing
from agents.rollout import run
from magenv.episodes import Episodes, Settings
from magenv.poses import to_cartesian


def test_it_holds_both_approaches() -> None:
    for scenario, worst_mm in (("approach-60", 0.4), ("approach-30", 1.0)):
        (record,) = run(Homing(), scenario, episodes=1)
        assert record.success
        assert 1e3 * np.mean(record.position_error_m) < worst_mm
        assert np.degrees(np.mean(record.heading_error_rad)) < 1.0


@pytest.mark.parametrize("n_epm", [2, 3])
def test_its_commands_hang_on_no_earlier_ones(n_epm: int) -> None:
    episodes = Episodes(2, Settings("approach-60", n_epm=n_epm, action="pose"))
    for row in range(2):
        episodes.seed(row, np.random.default_rng(row))
    active = np.ones(2, np.bool_)
    one, state = Homing(n_epm), None
    observations = episodes.start(active)
    for _ in range(3):
        actions, state = one.predict(observations, state)
        observations = episodes.step(actions.astype(np.float64), active)
    other, changed, rng = Homing(n_epm), copy.deepcopy(state), np.random.default_rng(7)
    other.seed(99)
    assert changed is not None
    for memory in changed.rows:
        assert memory is not None
        memory.commands = memory.commands + rng.normal(scale=0.1, size=memory.commands.shape)
    wanted, _ = one.predict(observations, state)
    found, _ = other.predict(observations, changed)
    np.testing.assert_array_equal(found, wanted)


def test_epms_that_travel_are_refused() -> None:
    told = refusal(lambda: Homing(2, 2.0, "arm"))
    assert told == "Input plant must be one whose EPMs jump, for predictive-home; instead received 'arm'."


def test_its_home_is_the_plants() -> None:
    """With another home, other poses serve: those near to that."""
    centres = []
    for plant in ("paper", "paper:home_turn_rad=0.977"):
        (record,) = run(Homing(plant=plant), "approach-60", plant, episodes=1)
        assert record.success
        centres.append(to_cartesian(record.epm_pose)[0])
    tilt = [float(np.median(np.abs(np.arcsin(one[..., 2] / np.linalg.norm(one, axis=-1))))) for one in centres]
    assert tilt[1] > tilt[0] + 0.15
