"""The claims of the README, on few episodes: who holds what, and that the substep does not decide it."""

from __future__ import annotations

import dataclasses

import pytest

from agents.catalogue import controller
from agents.metrics import Summary, summarise
from agents.rollout import run
from magenv.params import PLANTS


def summary(name: str, scenario: str, episodes: int) -> Summary:
    (row,) = summarise(run(controller(name), scenario, episodes=episodes))
    return row


@pytest.mark.parametrize(
    ("scenario", "position_mm", "heading_deg"), [("approach-60", 1.5, 16.7), ("approach-30", 4, 30)]
)
def test_the_shipped_agent_holds_both_scenarios(scenario: str, position_mm: float, heading_deg: float) -> None:
    row = summary("ppo", scenario, 5)
    assert row.success_rate == 1.0
    assert row.position_error_mm is not None
    assert row.position_error_mm <= position_mm
    assert row.heading_error_deg is not None
    assert row.heading_error_deg <= heading_deg


@pytest.mark.parametrize("scenario", ["approach-60", "approach-30"])
def test_halving_the_substep_changes_no_error_by_over_2_percent(scenario: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = summary("ppo", scenario, 2)
    half = dataclasses.replace(PLANTS["paper"], substep_s=PLANTS["paper"].substep_s / 2)
    monkeypatch.setitem(PLANTS, "paper", half)
    halved = summary("ppo", scenario, 2)
    assert halved.position_error_mm == pytest.approx(whole.position_error_mm, rel=0.02)
    assert halved.heading_error_deg == pytest.approx(whole.heading_error_deg, rel=0.02)
    assert halved.position_error_mm != whole.position_error_mm  # the substep did change


@pytest.mark.parametrize("name", ["baseline", "tuned"])
def test_the_pids_hold_60_mm_and_lose_30(name: str) -> None:
    assert summary(name, "approach-60", 2).success_rate == 1.0
    lost = summary(name, "approach-30", 2)
    assert lost.success_rate == 0.0
    assert lost.loss_of_control_s is not None
    assert 30 < lost.loss_of_control_s < 70


@pytest.mark.parametrize("name", ["idle", "random"])
def test_without_control_nothing_is_held(name: str) -> None:
    assert summary(name, "approach-60", 3).success_rate == 0.0
