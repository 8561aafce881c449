"""The robustness score: which plants, what a score is, what is kept of a sweep and drawn of it."""

from __future__ import annotations

import json
import runpy
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from recorded import STEPS, a_record

from agents import catalogue, robustness_figures, sharing
from agents.controller import Controller, Idle, Random
from agents.metrics import rate_interval
from agents.records import Record
from agents.robustness import BASE, CRITERIA, TABLE, Row, Sweep, scores, sweep_over
from agents.robustness_run import run_robustness
from magenv.params import PLANTS, Plant, plant_named

ROOT = Path(__file__).parents[1]


class Told:
    """Stands for ``rollout.run``: of 4 episodes as many succeed as told by plant, all where nothing is told."""

    def __init__(self) -> None:
        self.successes: dict[str, int] = {}
        self.calls: list[tuple[str, str, str]] = []
        self.break_at: int | None = None
        self.episodes = {steps: a_record(steps, action="home") for steps in (10, STEPS)}

    def __call__(
        self,
        who: Controller,
        scenario: str,
        plant: str,
        n_epm: int,
        control_hz: float,
        episodes: int,
        seed: int,
        progress: Any = None,
    ) -> list[Record]:
        if len(self.calls) == self.break_at:
            raise KeyboardInterrupt
        self.calls.append((who.name, scenario, plant))
        steps = [STEPS if k < self.successes.get(plant, episodes) else 10 for k in range(episodes)]
        setting = {"controller": who.name, "scenario": scenario, "plant": plant}
        return [replace(self.episodes[s], seed=seed + k, **setting) for k, s in enumerate(steps)]


@pytest.fixture
def rollout(monkeypatch: pytest.MonkeyPatch) -> Told:
    """Let episodes end as told instead of running them."""
    instead = Told()
    monkeypatch.setattr(sharing, "run", instead)
    return instead


def criterion(name: str) -> Any:
    (found,) = (one for one in CRITERIA if one.name == name)
    return found


# Plants.


@pytest.mark.parametrize(
    ("name", "value", "changed"),
    [
        ("noise", 2.0, {"noise_position_m": 2.6e-3, "noise_heading_rad": np.radians(2.2)}),
        ("latency", 0.02, {"latency_s": 0.02}),
        ("mismatch", 0.4, {"mismatch": 0.4}),
        ("disturbance", 3.0, {"disturbance_n": 3e-3}),
        ("EPM speed", 0.5, {"epm_speed_mps": 0.5, "epm_turn_radps": np.pi / 2}),
    ],
)
@pytest.mark.parametrize("base", ["paper", "arm", "moving:latency_s=0.05,mismatch=0.3,noise_position_m=1e-3"])
def test_a_value_changes_one_thing_about_the_plant(
    name: str, value: float, changed: dict[str, float], base: str
) -> None:
    plant, before = plant_named(criterion(name).plant(base, value)), plant_named(base)
    for field in fields(Plant):
        assert getattr(plant, field.name) == changed.get(field.name, getattr(before, field.name))


def test_each_value_is_worse_than_the_one_before_and_none_is_that_of_the_base() -> None:
    points = Sweep().points()
    assert points[0] == (BASE, None, "paper")
    assert len(points) == 1 + sum(len(one.values) for one in CRITERIA) == 21
    for one in CRITERIA:
        order = [-value for value in one.values] if one.name == "EPM speed" else list(one.values)
        assert order == sorted(set(order))
    arm = {(name, value) for name, value, _ in Sweep("arm").points()}
    left_out = {(name, value) for name, value, _ in points} - arm
    assert left_out == {("noise", 1.0), ("latency", 0.1), ("mismatch", 0.2), ("EPM speed", 1.0)}
    assert all(plant_named(plant) != PLANTS["arm"] for _, _, plant in Sweep("arm").points()[1:])


# Scores.


def test_a_score_is_the_mean_of_the_criterias_means(rollout: Told) -> None:
    sweep, noise, speed = Sweep(episodes=4), criterion("noise"), criterion("EPM speed")
    rollout.successes = {noise.plant("paper", value): k for k, value in enumerate(noise.values)}
    rollout.successes |= {speed.plant("paper", 0.25): 2, "paper": 3}
    rows = sweep_over(Idle(), sweep)
    assert [(row.criterion, row.value, row.plant) for row in rows] == sweep.points()
    assert [row.success_rate for row in rows[:5]] == [0.75, 0.0, 0.25, 0.5, 0.75]
    assert rows[1].success_rate_ci == rate_interval(0, 4)
    assert (rows[1].loss_of_control_s, rows[1].position_error_mm) == (5.0, None)
    (score,) = scores(rows, sweep)
    assert score.base == 75.0
    assert score.criteria == {
        **{"noise": 37.5, "latency": 100.0, "mismatch": 100.0, "disturbance": 100.0, "EPM speed": 87.5}
    }
    assert score.overall == pytest.approx((37.5 + 300.0 + 87.5) / 5)


def test_what_is_not_whole_has_no_score(rollout: Told) -> None:
    sweep = Sweep(episodes=1)
    rows = sweep_over(Idle(), sweep)
    (score,) = scores(rows[:6], sweep)
    assert score.criteria == {**dict.fromkeys(score.criteria), "noise": 100.0}
    assert (score.base, score.overall) == (100.0, None)


def test_scenarios_have_scores_of_their_own(rollout: Told) -> None:
    sweep = Sweep(episodes=1, scenarios=("approach-60", "approach-30"))
    rows = [row for who in (Idle(), Random()) for row in sweep_over(who, sweep)]
    assert [(score.controller, score.scenario) for score in scores(rows, sweep)] == [
        (name, scenario) for name in ("idle", "random") for scenario in sweep.scenarios
    ]


def test_a_controller_in_another_process_is_made_for_the_plant_in_the_middle(
    rollout: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[tuple[Any, ...]] = []
    monkeypatch.setattr(catalogue, "controller", lambda *asked: made.append(asked) or Idle())
    sharing._controller.cache_clear()
    record = sharing._episode("predictive", "arm", "approach-60", "arm:mismatch=0.4", 2, 10.0, 7)
    sharing._controller.cache_clear()
    assert made == [("predictive", 2, 10.0, "arm")]
    assert (record.plant, record.seed) == ("arm:mismatch=0.4", 7)


# Files.


def test_a_sweep_broken_off_goes_on(rollout: Told, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    both, sweep = [Idle(), Random()], Sweep(episodes=2, seed=3)
    run_robustness(both, sweep, 1, tmp_path / "whole", "python evaluate.py --robustness")
    whole, rollout.calls, rollout.break_at = rollout.calls, [], 30
    assert len(whole) == 42
    with pytest.raises(KeyboardInterrupt):
        run_robustness(both, sweep, 1, tmp_path / "broken", "python evaluate.py --robustness")
    assert "idle" in capfd.readouterr().out
    rollout.break_at = None
    for _ in range(2):  # what is whole is not run again
        run_robustness(both, sweep, 1, tmp_path / "broken", "python evaluate.py --robustness")
        assert rollout.calls == whole
        for name in ("robustness.json", "episodes.csv"):
            assert (tmp_path / "broken" / name).read_text() == (tmp_path / "whole" / name).read_text()
    assert "holds 30 rows of this robustness" in capfd.readouterr().err
    file, rows = TABLE.load(tmp_path / "whole" / "robustness.json")
    assert rows == [row for who in both for row in sweep_over(who, sweep)]
    assert [score["overall"] for score in file["scores"]] == [100.0, 100.0]
    assert len((tmp_path / "whole" / "episodes.csv").read_text().splitlines()) == 1 + 2 * 42


def test_another_sweep_is_run_anew(rollout: Told, tmp_path: Path) -> None:
    for sweep in (Sweep(episodes=1), Sweep(episodes=1, scenarios=("approach-30",))):
        rollout.calls = []
        run_robustness([Idle()], sweep, 1, tmp_path, "")
        assert len(rollout.calls) == 21
        assert {scenario for _, scenario, _ in rollout.calls} == set(sweep.scenarios)


# The command, the table, the figure.


def test_evaluate_scores(
    rollout: Told, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    rollout.successes = {criterion("latency").plant("paper", 0.2): 0}
    monkeypatch.setattr(
        sys, "argv", ["evaluate.py", "--robustness", "--controllers", "idle", "random", "--episodes", "2"]
    )
    runpy.run_path(str(ROOT / "evaluate.py"), run_name="__main__")
    folder = tmp_path / "runs" / "robustness"
    assert {path.name for path in folder.iterdir()} == {
        *("robustness.json", "robustness-approach-60.png", "episodes.csv")
    }
    with Image.open(folder / "robustness-approach-60.png") as picture:
        picture.load()
    lines = capfd.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    (idle,) = (line.split() for line in lines if line.strip().startswith("idle"))
    assert idle == ["idle", "100", "100", "75", "100", "100", "100", "95"]
    assert json.loads((folder / "robustness.json").read_text())["settings"]["scenarios"] == ["approach-60"]


def a_row(**changes: Any) -> Row:
    row = Row("tuned", "approach-60", BASE, None, "paper", 20, 0.5, rate_interval(10, 20), None, None, 5.0)
    return replace(row, **changes)


def test_panels_show_success_over_value_from_the_base_on() -> None:
    sweep, latency = Sweep(), criterion("latency")
    rows = [a_row()] + [
        a_row(criterion="latency", value=value, success_rate=rate, success_rate_ci=rate_interval(int(20 * rate), 20))
        for value, rate in zip(latency.values, (0.4, 0.3, 0.2, 0.1), strict=True)
    ]
    panels = robustness_figures.draw(rows, sweep, "approach-60").axes
    assert [axes.get_title() for axes in panels] == [*(one.name for one in CRITERIA), "overall score"]
    (axes,) = (axes for axes in panels if axes.get_title() == "latency")
    assert [label.get_text() for label in axes.get_xticklabels()] == ["base", "0.02", "0.05", "0.1", "0.2"]
    (line,) = axes.lines
    np.testing.assert_allclose(line.get_xydata(), [[0, 50], [1, 40], [2, 30], [3, 20], [4, 10]])
    assert not panels[-1].patches, "no score of what is not whole"
