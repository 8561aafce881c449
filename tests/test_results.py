"""The claims of the README: who holds what, and that the substep does not decide it."""

from __future__ import annotations

import dataclasses

import pytest

from agents.catalogue import controller
from agents.metrics import Summary, summarise
from agents.rollout import run
from magenv.params import PLANTS

EPISODES = 20
"""As many as ``evaluate.py`` runs."""

SETTINGS = {"steered-ppo-three": (3, 2.0), "steered-ppo-10hz": (2, 10.0)}
"""EPMs and control rate of agents that are not made for two at 2 Hz."""


def summary(name: str, scenario: str, episodes: int) -> Summary:
    n_epm, control_hz = SETTINGS.get(name, (2, 2.0))
    agent = controller(name, n_epm, control_hz)
    (row,) = summarise(run(agent, scenario, n_epm=n_epm, control_hz=control_hz, episodes=episodes))
    return row


@pytest.mark.parametrize(
    ("name", "scenario", "position_mm", "heading_deg"),
    [
        ("ppo", "approach-60", 0.5, 2),
        ("ppo", "approach-30", 1.2, 4),
        ("ppo", "eight-30", 1.2, 4),
        ("cloned-ppo", "approach-60", 0.25, 0.5),
        ("cloned-ppo", "approach-30", 0.6, 1.5),
        ("cloned-ppo", "eight-30", 0.6, 1.5),
        ("full-ppo", "approach-22.5", 1.2, 4),
        ("home-ppo", "approach-60", 1.5, 16.7),
        ("home-ppo", "approach-30", 4, 30),
        ("steered-ppo", "approach-60", 0.25, 0.5),
        ("steered-ppo", "approach-30", 0.6, 1.5),
        ("steered-ppo-three", "approach-60", 0.25, 0.5),
        ("steered-ppo-three", "approach-30", 0.6, 1.5),
        ("steered-ppo-10hz", "approach-30", 0.6, 1.5),
        ("steered-ppo-10hz", "approach-22.5", 0.6, 1.5),
    ],
)
def test_the_shipped_agents_hold_what_they_are_shipped_for(
    name: str, scenario: str, position_mm: float, heading_deg: float
) -> None:
    row = summary(name, scenario, EPISODES)
    assert row.success_rate >= 0.95
    assert row.position_error_mm is not None
    assert row.position_error_mm <= position_mm
    assert row.heading_error_deg is not None
    assert row.heading_error_deg <= heading_deg


def test_the_papers_controller_shows_the_papers_outcome() -> None:
    """The bands to which plant and gains were calibrated, about the paper's 8.7 mm, 16.7 deg, 51 s and 33 mm."""
    held = summary("baseline", "approach-60", EPISODES)
    assert held.success_rate >= 0.95
    assert held.position_error_mm is not None
    assert 7 <= held.position_error_mm <= 10.5
    assert held.heading_error_deg is not None
    assert 13 <= held.heading_error_deg <= 20
    lost = summary("baseline", "approach-30", EPISODES)
    assert lost.success_rate <= 0.1
    assert lost.loss_of_control_s is not None
    assert 45 <= lost.loss_of_control_s <= 57
    assert lost.separation_before_loss_mm is not None
    assert 30 <= lost.separation_before_loss_mm <= 40


@pytest.mark.parametrize("scenario", ["approach-60", "approach-30"])
def test_halving_the_substep_changes_no_error_by_over_2_percent(scenario: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an agent whose poses follow from what it sees. Where they are searched for, the last digit may find others."""
    whole = summary("home-ppo", scenario, 2)
    half = dataclasses.replace(PLANTS["paper"], substep_s=PLANTS["paper"].substep_s / 2)
    monkeypatch.setitem(PLANTS, "paper", half)
    halved = summary("home-ppo", scenario, 2)
    assert halved.position_error_mm == pytest.approx(whole.position_error_mm, rel=0.02)
    assert halved.heading_error_deg == pytest.approx(whole.heading_error_deg, rel=0.02)
    assert halved.position_error_mm != whole.position_error_mm  # the substep did change


def test_the_best_gains_hold_60_mm_far_better_and_lose_30_too() -> None:
    held = summary("tuned", "approach-60", 5)
    assert held.success_rate == 1.0
    assert held.position_error_mm is not None
    assert held.position_error_mm < 1.0
    assert summary("tuned", "approach-30", 5).success_rate == 0.0


@pytest.mark.parametrize("name", ["idle", "random"])
def test_without_control_nothing_is_held(name: str) -> None:
    for scenario in ("approach-60", "approach-30"):
        assert summary(name, scenario, EPISODES).success_rate == 0.0
