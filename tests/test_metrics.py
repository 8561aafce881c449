"""Statistics over records: arithmetic by hand, intervals against theory, and what is null where."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, fields, replace

import numpy as np
import pytest
from recorded import STEPS, a_record

from agents.metrics import Summary, mean_interval, measure, rate_interval, summarise, typical


def test_an_episodes_mean_weighs_holds_by_their_substeps() -> None:
    record = a_record(
        held_steps=2,
        position_error_m=np.array([0.001, 0.011]),
        heading_error_rad=np.array([0.1, 1.1]),
        substeps=np.array([100, 25]),
    )
    episode = measure(record)
    assert episode.position_error_mm == pytest.approx((100 * 1 + 25 * 11) / 125)
    assert episode.heading_error_deg == pytest.approx(math.degrees((100 * 0.1 + 25 * 1.1) / 125))


def test_errors_at_the_control_instants_stand_beside_those_over_time() -> None:
    record = a_record(
        held_steps=2, position_error_end_m=np.array([0.002, 0.004]), heading_error_end_rad=np.array([0.2, 0.4])
    )
    episode = measure(record)
    assert episode.position_error_instant_mm == pytest.approx(3.0)
    assert episode.heading_error_instant_deg == pytest.approx(math.degrees(0.3))
    assert episode.position_error_mm == pytest.approx(0.5)


def test_a_summary_has_the_agreed_keys_and_goes_into_strict_json() -> None:
    keys = {field.name for field in fields(Summary)}
    agreed = (
        "controller scenario plant n_epm control_hz action seed episodes success_rate position_error_mm "
        "heading_error_deg position_error_mm_ci heading_error_deg_ci position_error_until_end_mm min_separation_mm "
        "loss_of_control_s separation_before_loss_mm lost_first control_step_ms_p50 control_step_ms_p99"
    )
    assert keys >= set(agreed.split())
    for held_steps in (STEPS, 10):
        (row,) = summarise([a_record(held_steps)])
        text = json.dumps(asdict(row), allow_nan=False)
        assert json.loads(text)["controller"] == "baseline"


def test_errors_are_over_successes_and_until_the_end_over_all() -> None:
    kept = [a_record(error_m=error, seed=seed) for seed, error in enumerate((0.002, 0.004))]
    lost = a_record(held_steps=10, error_m=0.012, seed=2)
    (row,) = summarise([*kept, lost])
    assert row.success_rate == pytest.approx(2 / 3)
    assert row.position_error_mm == pytest.approx((1 + 2) / 2)
    assert row.position_error_instant_mm == pytest.approx((1 + 2) / 2)
    assert row.heading_error_deg == pytest.approx(math.degrees((0.004 + 0.008) / 2))
    assert row.position_error_until_end_mm == pytest.approx((1 + 2 + 6) / 3)


def test_loss_is_told_in_medians_of_the_lost_episodes_alone() -> None:
    lost = [
        a_record(held_steps=steps, seed=seed, separation_tracked_m=apart)
        for seed, (steps, apart) in enumerate(((10, 0.04), (14, 0.03), (30, 0.05)))
    ]
    (row,) = summarise([a_record(seed=3, separation_tracked_m=0.2), *lost])
    assert row.loss_of_control_s == pytest.approx(7.0)
    assert row.separation_before_loss_mm == pytest.approx(40.0)
    smallest = [1e3 * record.separation_min_m.min() for record in [a_record(seed=3), *lost]]
    assert row.min_separation_mm == pytest.approx(np.median(smallest))


def test_what_does_not_exist_is_null() -> None:
    (kept,) = summarise([a_record()])
    assert kept.loss_of_control_s is None
    assert kept.separation_before_loss_mm is None
    (lost,) = summarise([a_record(held_steps=5, separation_tracked_m=None)])
    for name in ("position_error_mm", "position_error_mm_ci", "heading_error_deg", "heading_error_deg_ci"):
        assert getattr(lost, name) is None
    assert lost.position_error_instant_mm is None
    assert lost.heading_error_instant_deg is None
    assert lost.separation_before_loss_mm is None
    assert lost.loss_of_control_s == pytest.approx(2.5)


def test_step_times_are_percentiles_over_all_calls() -> None:
    quick = a_record(step_ms=np.full(STEPS, 1.0))
    slow = a_record(seed=1, step_ms=np.concatenate([np.full(STEPS - 2, 1.0), [101.0, 101.0]]))
    (row,) = summarise([quick, slow])
    assert row.control_step_ms_p50 == 1.0
    assert row.control_step_ms_p99 == 101.0


def test_there_is_a_row_per_scenario_and_controller_in_order_of_appearance() -> None:
    records = [
        a_record(controller=controller, scenario=scenario, seed=seed)
        for seed in (5, 4)
        for scenario in ("approach-60", "approach-30")
        for controller in ("tuned", "baseline")
    ]
    rows = summarise(records)
    assert [(row.scenario, row.controller) for row in rows] == [
        ("approach-60", "tuned"),
        ("approach-60", "baseline"),
        ("approach-30", "tuned"),
        ("approach-30", "baseline"),
    ]
    assert all((row.seed, row.episodes) == (4, 2) for row in rows)


def test_an_episode_counts_once() -> None:
    with pytest.raises(ValueError, match="Input records must be one per controller, scenario and seed; instead"):
        summarise([a_record(), a_record()])


def test_the_bootstrap_interval_agrees_with_theory(rng: np.random.Generator) -> None:
    values = list(rng.normal(8.7, 2.0, 400))
    low, high = mean_interval(values)
    half = 1.96 * np.std(values) / math.sqrt(len(values))
    assert low == pytest.approx(np.mean(values) - half, abs=0.1 * half)
    assert high == pytest.approx(np.mean(values) + half, abs=0.1 * half)
    assert mean_interval(values) == (low, high)


@pytest.mark.parametrize("values", [[3.25], [3.25, 3.25, 3.25]])
def test_the_interval_of_equal_values_is_that_value(values: list[float]) -> None:
    assert mean_interval(values) == (3.25, 3.25)


@pytest.mark.parametrize(("successes", "episodes"), [(0, 20), (20, 20), (7, 20), (1, 1)])
def test_the_rate_interval_is_wilsons(successes: int, episodes: int) -> None:
    z, p = 1.959963985, successes / episodes
    centre = (p + z**2 / (2 * episodes)) / (1 + z**2 / episodes)
    half = z / (1 + z**2 / episodes) * math.sqrt(p * (1 - p) / episodes + z**2 / (4 * episodes**2))
    assert rate_interval(successes, episodes) == pytest.approx((centre - half, centre + half), abs=1e-9)


def test_the_typical_episode_is_the_one_in_the_middle() -> None:
    kept = [a_record(error_m=error) for error in (0.001, 0.005, 0.003)]
    assert typical(kept) is kept[2]
    lost = [a_record(held_steps=steps) for steps in (10, 30, 20)]
    assert typical(lost) is lost[2]
    assert typical([*lost[:2], kept[0]]) is lost[1]
    alone = replace(kept[0])
    assert typical([alone]) is alone
