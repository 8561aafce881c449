"""Held-out episodes: what they tell is what the comparison of controllers would, and the order of scores."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from messages import refusal
from numpy.typing import NDArray

from agents import evaluation
from agents.evaluation import HeldOut, Score
from agents.metrics import measure
from agents.rollout import run
from magenv.actions import ActionMode
from magenv.episodes import Episodes, Settings
from magenv.params import PLANTS, Body, Plant
from magenv.task import Frame, ObservationMode, unpack

WRENCH = Settings(plant="sticky", action="wrench", frame="global", control_hz=0.5)
"""A plant and an action with which a law of one line can hold the robots."""
SPAN = 3
"""Held-out episodes that are compared with others."""


@pytest.fixture(autouse=True)
def sticky(monkeypatch: pytest.MonkeyPatch) -> None:
    body = Body(drag_linear_nspm=1.0, drag_rotational_nmsprad=5e-4)
    monkeypatch.setitem(PLANTS, "sticky", Plant(body=body))


class Pull:
    """Pulls the robots to their references, ``strength`` times as strongly as holds them well."""

    name = "pull"
    action: ActionMode = "wrench"
    observation: ObservationMode = "full"
    frame: Frame = "global"

    def __init__(self, strength: float) -> None:
        self._gains = strength * np.array([10.0, 10.0, 0.1])
        self._layout = Episodes(1, WRENCH).layout

    def seed(self, seed: int) -> None:
        """Do nothing."""

    def predict(
        self, observation: NDArray[np.float32], state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], None]:
        pull = self._gains * unpack(observation, self._layout).error
        return np.clip(pull.reshape(*observation.shape[:-1], 6), -1.0, 1.0).astype(np.float32), None


@pytest.mark.parametrize(("scenario", "strength"), [("random", 1.0), ("random", -1.0), ("approach-60", 1.0)])
def test_it_equals_the_comparison_of_controllers(scenario: str, strength: float) -> None:
    settings, pull = Settings(**(vars(WRENCH) | {"scenario": scenario})), Pull(strength)
    score = HeldOut(settings, SPAN).score(lambda observations: pull.predict(observations)[0])
    records = run(pull, scenario, "sticky", control_hz=0.5, episodes=SPAN, seed=evaluation.SEED)
    episodes = [measure(record) for record in records]
    assert score.success_rate == np.mean([episode.success for episode in episodes])
    assert (score.success_rate == 1.0) == (strength > 0)
    assert score.position_error_mm == pytest.approx(np.mean([one.position_error_mm for one in episodes]), rel=1e-9)
    assert score.heading_error_deg == pytest.approx(np.mean([one.heading_error_deg for one in episodes]), rel=1e-9)
    ends = [100.0 if one.loss_of_control_s is None else one.loss_of_control_s for one in episodes]
    assert score.held == pytest.approx(np.mean(ends) / 100.0, rel=1e-9)


def test_the_episodes_are_the_same_whenever_and_wherever_they_are_run() -> None:
    held_out, good, bad = HeldOut(WRENCH, SPAN), Pull(1.0), Pull(-1.0)
    first = held_out.score(lambda observations: good.predict(observations)[0])
    other = held_out.score(lambda observations: bad.predict(observations)[0])
    assert first.merit > other.merit
    assert held_out.score(lambda observations: good.predict(observations)[0]) == first
    assert HeldOut(WRENCH, SPAN).score(lambda observations: good.predict(observations)[0]) == first


def test_random_numbers_of_others_are_left_alone() -> None:
    before = np.random.get_state()[1].copy()  # type: ignore[index,union-attr]  # noqa: NPY002 (SB3 draws from it)
    HeldOut(WRENCH, SPAN).score(lambda observations: Pull(-1.0).predict(observations)[0])
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # type: ignore[index]  # noqa: NPY002


def test_no_training_draws_the_held_out_episodes() -> None:
    """Its rows have seeds from its own (below 2^32) on, one each (at most 2^16)."""
    assert evaluation.SEED > 2**32 + 2**16


def test_actions_that_are_not_finite_are_refused() -> None:
    assert "finite" in refusal(lambda: HeldOut(WRENCH, SPAN).score(lambda _: np.full((SPAN, 6), np.nan, np.float32)))


def test_scores_are_ordered_by_success_then_by_errors_and_control() -> None:
    rising = [
        Score(0.0, math.nan, 1.0, 0.0),
        Score(0.0, 1.0, 1.0, 0.0),  # lost at once, before errors could grow
        Score(0.0, 15.0, 40.0, 0.5),
        Score(0.5, 9.0, 90.0, 0.6),
        Score(0.5 + 1 / evaluation.EPISODES, 15.0, 90.0, 0.6),
        Score(1.0, 2.0, 10.0, 1.0),
        Score(1.0, 1.0, 14.9, 1.0),
        Score(1.0, 1.0, 5.0, 1.0),
        Score(1.0, 0.0, 0.0, 1.0),
    ]
    merits = [score.merit for score in rising]
    assert merits == sorted(merits)
    assert len(set(merits)) == len(merits)


@pytest.mark.parametrize("bad", [(1.1, 0.0, 0.0, 1.0), (-0.1, 0.0, 0.0, 0.0), ("1", 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 2)])
def test_impossible_scores_are_refused(bad: Any) -> None:
    refusal(lambda: Score(*bad))
