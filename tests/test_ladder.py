"""The ladder of separations: when a rung is survived, where a climb ends, what is kept of it."""

from __future__ import annotations

import csv
import json
import runpy
import sys
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from climbs import Climbed, Outcomes, Told
from messages import told as message

from agents import ladder
from agents.catalogue import controller
from agents.controller import Idle, Random
from agents.ladder import LADDER_MM, Ladder, Rung, climb, finished, load, survivable
from agents.ladder_run import run_ladder
from agents.metrics import Episode, rate_interval
from agents.records import Record

ROOT = Path(__file__).parents[1]


def separations(rungs: list[Rung]) -> list[float]:
    return [rung.separation_mm for rung in rungs]


# The rule.


@pytest.mark.parametrize(
    ("outcomes", "lowest_mm"),
    [
        ({}, 14.0),
        ({30.0: (19, 1.0)}, 14.0),
        ({30.0: (18, 1.0)}, 35.0),
        ({30.0: (20, 1.09)}, 14.0),
        ({30.0: (20, 1.11)}, 35.0),
        ({60.0: (20, 0.5)}, 14.0),
        ({60.0: (18, 1.0)}, None),
        ({16.0: (0, 1.0)}, 18.0),
    ],
    ids=str,
)
def test_a_rung_is_survived_by_success_and_nearness_on_it_and_all_wider_ones(
    outcomes: Outcomes, lowest_mm: float | None, climbed: Climbed
) -> None:
    rungs = climbed(outcomes)
    assert survivable(rungs) == lowest_mm
    assert separations(rungs) == list(LADDER_MM), "rungs below a gap are run all the same"
    for rung in rungs:
        assert rung.survived == (lowest_mm is not None and rung.separation_mm >= lowest_mm)


@pytest.mark.parametrize(
    ("lost", "last_mm"), [((60.0, 50.0), 50.0), ((45.0, 35.0, 20.0, 19.0), 19.0), ((45.0, 35.0), 14.0), ((), 14.0)]
)
def test_the_second_rung_in_succession_without_success_is_the_last(
    lost: tuple[float, ...], last_mm: float, climbed: Climbed, rollout: Told
) -> None:
    rungs = climbed(dict.fromkeys(lost, (0, 1.0)))
    assert separations(rungs) == [rung for rung in LADDER_MM if rung >= last_mm]
    assert len(rollout.calls) == len(rungs)
    assert finished(rungs)
    assert not any(finished(rungs[:end]) for end in range(len(rungs)))


def test_a_rung_tells_what_the_summary_of_its_episodes_tells(climbed: Climbed) -> None:
    rung = climbed({27.5: (15, 1.0)}, anti=True, plant="moving", control_hz=4.0, n_epm=2, seed=5)[6]
    assert (rung.controller, rung.plant, rung.n_epm, rung.control_hz, rung.anti) == ("tuned", "moving", 2, 4.0, True)
    assert (rung.separation_mm, rung.episodes, rung.success_rate, rung.survived) == (27.5, 20, 0.75, False)
    assert rung.success_rate_ci == rate_interval(15, 20)
    assert rung.position_error_mm == pytest.approx(0.5)
    assert rung.heading_error_deg == pytest.approx(np.degrees(0.002))
    assert rung.min_separation_mm == pytest.approx(27.5)
    assert rung.loss_of_control_s == 5.0
    assert (rung.control_step_ms_p50, rung.control_step_ms_p99) == (2.0, 2.0)


def test_scenarios_are_named_after_separation_and_headings() -> None:
    assert Ladder().scenario(27.5) == "approach-27.5"
    assert Ladder(anti=True).scenario(60.0) == "approach-60-anti"


def test_processes_that_share_the_episodes_change_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ladder, "LADDER_MM", (60.0, 20.0))
    kept: dict[int, list[Record]] = {1: [], 2: []}
    rungs, seeds = {}, []
    for jobs, records in kept.items():
        rungs[jobs] = climb(
            controller("tuned"),
            Ladder(episodes=2, seed=3),
            jobs,
            keep=lambda _, some, records=records: records.extend(some),
            progress=lambda record: seeds.append(record.seed),
        )
    assert seeds == 2 * [3, 4, 3, 4]
    assert [rung.success_rate for rung in rungs[1]] == [1.0, 0.0]
    for one, two in zip(rungs[1], rungs[2], strict=True):
        assert one == replace(two, **{name: getattr(one, name) for name in asdict(one) if "_ms_" in name})
    for one, two in zip(kept[1], kept[2], strict=True):
        names = [field.name for field in fields(Record) if field.name != "step_ms"]
        assert all(np.array_equal(getattr(one, name), getattr(two, name)) for name in names)


# Files.


def content(folder: Path) -> tuple[dict[str, Any], list[dict[str, str]]]:
    """Return what a folder holds: the ladder, as strict JSON, and the episodes."""

    def refuse(name: str) -> float:
        raise AssertionError(name)

    with (folder / "episodes.csv").open(newline="") as file:
        episodes = list(csv.DictReader(file, strict=True))
    return json.loads((folder / "ladder.json").read_text(), parse_constant=refuse), episodes


def test_rungs_and_episodes_survive_their_files(rollout: Told, tmp_path: Path) -> None:
    rollout.outcomes = {60.0: (1, 1.0), 50.0: (0, 1.0), 45.0: (0, 1.0)}
    setting = Ladder(anti=True, episodes=2, seed=7)
    run_ladder([Idle(), Random()], setting, 1, tmp_path / "new" / "out", "python evaluate.py --ladder anti")
    file, episodes = content(tmp_path / "new" / "out")
    assert file["command"] == "python evaluate.py --ladder anti"
    assert file["settings"]["seed"] == 7
    assert {"Python", "magenv", "numpy"} < set(file["versions"])
    assert load(tmp_path / "new" / "out" / "ladder.json")[1] == climb(Idle(), setting) + climb(Random(), setting)
    assert [rung["heading_error_deg"] is None for rung in file["rungs"]] == 2 * [False, True, True]
    assert list(episodes[0]) == [field.name for field in fields(Episode)]
    told_of = [(episode["controller"], episode["scenario"], episode["seed"]) for episode in episodes]
    scenarios = ("approach-60-anti", "approach-50-anti", "approach-45-anti")
    assert told_of == [(name, s, seed) for name in ("idle", "random") for s in scenarios for seed in ("7", "8")]


def test_a_climb_broken_off_goes_on(rollout: Told, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    rollout.outcomes = {40.0: (0, 1.0), 35.0: (0, 1.0)}
    setting, both = Ladder(episodes=2), [Idle(), Random()]
    run_ladder(both, setting, 1, tmp_path / "whole", "")
    whole, rollout.calls = rollout.calls, []
    assert len(whole) == 10
    for rollout.break_at, reached in ((3, "45 mm so far"), (7, "50 mm so far")):
        with pytest.raises(KeyboardInterrupt):
            run_ladder(both, setting, 1, tmp_path / "broken", "")
        assert (tmp_path / "broken" / "ladder.png").is_file()
        assert len(content(tmp_path / "broken")[0]["rungs"]) == rollout.break_at
        assert len(content(tmp_path / "broken")[1]) == 2 * rollout.break_at
        assert reached in capfd.readouterr().out
    rollout.break_at = None
    for _ in range(2):  # what is whole is not run again
        run_ladder(both, setting, 1, tmp_path / "broken", "")
        assert rollout.calls == whole
        assert content(tmp_path / "broken") == content(tmp_path / "whole")
    assert "holds 7 rungs of this ladder" in capfd.readouterr().err


def test_rungs_are_kept_for_those_who_come_later(rollout: Told, tmp_path: Path) -> None:
    rollout.outcomes = {50.0: (0, 1.0), 45.0: (0, 1.0)}
    run_ladder([Random()], Ladder(episodes=1), 1, tmp_path, "")
    rollout.break_at = 4
    with pytest.raises(KeyboardInterrupt):
        run_ladder([Idle(), Random()], Ladder(episodes=1), 1, tmp_path, "")
    rungs = load(tmp_path / "ladder.json")[1]
    assert [(rung.controller, rung.separation_mm) for rung in rungs] == [
        *(("idle", 60.0), ("random", 60.0), ("random", 50.0), ("random", 45.0))
    ]


def spoil(path: Path, old: str, new: str) -> None:
    """Put something else into a file."""
    before = path.read_text()
    assert old in before
    path.write_text(before.replace(old, new, 1))


@pytest.mark.parametrize(
    ("kept", "change"),
    [
        (0, lambda folder: spoil(folder / "ladder.json", '"seed": 0', '"seed": 1')),
        (0, lambda folder: spoil(folder / "ladder.json", '"control_hz": 2.0', '"control_hz": 10.0')),
        (0, lambda folder: spoil(folder / "ladder.json", '"sources of agents": "', '"sources of agents": "0')),
        (0, lambda folder: spoil(folder / "ladder.json", '"numpy": "', '"numpy": "0')),
        (0, lambda folder: spoil(folder / "ladder.json", '"idle": ""', '"idle": "a model of that name"')),
        (0, lambda folder: spoil(folder / "ladder.json", '"controller": "idle"', '"controller": 3')),
        (0, lambda folder: (folder / "ladder.json").write_text("{}")),
        (0, lambda folder: (folder / "episodes.csv").unlink()),
        (0, lambda folder: spoil(folder / "episodes.csv", "min_separation_mm", "separation_mm")),
        (2, lambda folder: spoil(folder / "episodes.csv", "approach-50", "approach-51")),
        (2, lambda folder: (folder / "episodes.csv").write_text((folder / "episodes.csv").read_text()[:-20])),
        (3, lambda folder: None),
    ],
)
def test_what_is_of_another_ladder_or_damaged_is_run_anew(
    kept: int, change: Callable[[Path], object], rollout: Told, tmp_path: Path
) -> None:
    rollout.outcomes = {50.0: (0, 1.0), 45.0: (0, 1.0)}
    run_ladder([Idle()], Ladder(episodes=2), 1, tmp_path, "")
    assert len(rollout.calls) == 3
    before = content(tmp_path)
    change(tmp_path)
    run_ladder([Idle()], Ladder(episodes=2), 1, tmp_path, "")
    assert len(rollout.calls) == 6 - kept
    assert content(tmp_path) == before


def test_a_model_trained_on_is_another_controller(
    rollout: Told, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tmp_path / "model"
    model.mkdir()
    agent = Idle()
    monkeypatch.setattr(agent, "name", str(model))
    for weights in ("one", "two", "two"):
        (model / "card.json").write_text(weights)
        run_ladder([agent], Ladder(episodes=1), 1, tmp_path / "out", "")
    assert len(rollout.calls) == 2 * len(LADDER_MM)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"rungs": [{}]}', '{"rungs": 3}', "\x00", None])
def test_a_foreign_file_is_refused_in_one_line(text: str | None, tmp_path: Path) -> None:
    path = tmp_path / "ladder.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(
        ValueError, match=message("ladder", "a folder with a ladder.json of evaluate.py --ladder", str(path))
    ):
        load(path)


# The command.


def test_evaluate_climbs_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ["--ladder", "anti", "--controllers", "idle", "--episodes", "1", "--seed", "4"]
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *arguments])
    runpy.run_path(str(ROOT / "evaluate.py"), run_name="__main__")
    assert {path.name for path in (tmp_path / "runs" / "ladder").iterdir()} == {
        *("ladder.json", "ladder.png", "episodes.csv")
    }
    file, episodes = content(tmp_path / "runs" / "ladder")
    assert file["command"] == "python evaluate.py " + " ".join(arguments)
    assert [rung["separation_mm"] for rung in file["rungs"]] == [60.0, 50.0]
    assert all(rung["anti"] and rung["success_rate"] == 0.0 for rung in file["rungs"])
    assert [episode["scenario"] for episode in episodes] == ["approach-60-anti", "approach-50-anti"]
    assert "| 60 | 0 % / - |" in capfd.readouterr().out
