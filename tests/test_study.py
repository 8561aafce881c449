"""The study's trainings and records: commands, files, what is refused."""

from __future__ import annotations

import dataclasses
import json
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from messages import refusal
from studied import an_entry

from agents import catalogue
from agents.configs import STEPS, PPOConfig, SACConfig, TrainConfig, command_of
from agents.study import entries
from agents.study.trainings import TRAININGS, Training, as_told, check_told, names, told_of, training
from magenv.command import parse

CONFIGS = {one.name: one.of_seed(one.seeds[-1]) for one in TRAININGS} | {
    "nested": TrainConfig(ppo=PPOConfig(gamma=0.95, net=(64, 32)), scenario="approach-30", n_epm=3),
    "plant": TrainConfig(algo="sac", plant="arm:latency_s=0.05", sac=SACConfig(n_envs=8), steps=1000),
    "residual": TrainConfig(residual="steered", residual_scale=0.05),
    "folder": TrainConfig(out=Path("a folder/it's"), ppo=PPOConfig(net=(64,), learning_rate=1e-5, log_std_init=-1e-5)),
}


@pytest.mark.parametrize("name", CONFIGS)
def test_a_command_trains_as_configured(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    python, script, *options = shlex.split(command_of(CONFIGS[name]))
    assert [python, script] == ["python", "train.py"]
    monkeypatch.setattr(sys, "argv", [script, *options])
    assert parse(TrainConfig) == CONFIGS[name]


def test_a_command_tells_what_is_not_the_default_alone() -> None:
    assert command_of(TrainConfig()) == "python train.py"
    assert command_of(TrainConfig(ppo=PPOConfig(net=(64, 32)))) == "python train.py --ppo.net 64 32"


def test_trainings_have_names_of_their_own() -> None:
    assert len(set(names())) == len(names())
    assert not set(names()) & set(catalogue.names()), "records of agents and controllers lie in folders side by side"
    assert all(set(one.compared_with) <= set(names()) - {one.name} for one in TRAININGS)
    assert all(len(set(one.seeds)) == len(one.seeds) > 0 for one in TRAININGS)


def test_an_unknown_training_is_refused_with_the_known_ones() -> None:
    message = refusal(lambda: training("nobody"))
    assert all(name in message for name in names())


def test_configurations_are_compared_by_what_counts() -> None:
    config = TrainConfig(seed=3)
    card = json.loads(json.dumps(dataclasses.asdict(config.resolved)))
    for told in (as_told(config), told_of(card), told_of(card | {"steps": STEPS["ppo"], "out": "x", "sac": {}})):
        check_told(told, config, "record")
    without = {name: value for name, value in as_told(config).items() if name != "frame"}
    check_told(without, config, "record")  # as if the option had come later
    check_told(without | {"ppo": {"gamma": 0.9}}, config, "record")
    other = dataclasses.replace(config, frame="global")
    assert "frame 'global'" in refusal(lambda: check_told(without, other, "record"))
    for changed in ({"seed": 4}, {"ppo": {"gamma": 0.5}}, {"steps": 5}, {"colour": "red"}):
        assert next(iter(changed)) in refusal(lambda told=changed: check_told(as_told(config) | told, config, "record"))


@pytest.mark.parametrize("seed", [None, 0, 12])
def test_a_record_is_read_as_it_was_written(seed: int | None, tmp_path: Path) -> None:
    entry = an_entry("baseline" if seed is None else "ppo-home", seed, hold=0.5)
    path = entries.save(entry, tmp_path)
    assert path == tmp_path / ("baseline/controller.json" if seed is None else f"ppo-home/seed-{seed}.json")
    assert entries.load(path) == entry
    assert entries.load_all(tmp_path) == [entry]


def test_a_record_of_a_hundred_episodes_is_small(tmp_path: Path) -> None:
    path = entries.save(an_entry("ppo-home", 0, episodes=100, hold=0.0), tmp_path)
    assert path.stat().st_size < 60_000


def change(*keys: str, to: Any) -> Callable[[str], str]:
    def changed(text: str) -> str:
        raw = json.loads(text)
        inner = raw
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = to
        return json.dumps(raw)

    return changed


OUTCOMES = ("outcomes", "approach-30")
DAMAGES = {
    "cut off": lambda text: text[:-40],
    "no JSON": lambda _: "success",
    "a list": lambda _: "[]",
    "deep": lambda _: 100_000 * "[",
    "other format": change("format", to="magenv study 0"),
    "no scenarios": change("outcomes", to={}),
    "other name": change("name", to="ppo-pose"),
    "other seed": change("training", "seed", to=1),
    "a further field": change("colour", to="red"),
    "text for a number": change("control_hz", to="2"),
    "bool for a number": change("n_epm", to=True),
    "number for a bool": change(*OUTCOMES, "success", to=[1] * 12),
    "too few": change(*OUTCOMES, "position_error_mm", to=[1.0]),
    "infinite": change(*OUTCOMES, "heading_error_deg", to=[float("inf")] * 12),
    "no episodes": change(*OUTCOMES, to={"seed": 0, "success": [], "position_error_mm": []}),
    "no training": change("training", to=None),
    "curve": change("training", "curve", "steps", to=[1]),
    "versions": change("versions", to={"numpy": 2}),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_record_is_refused(damage: str, tmp_path: Path) -> None:
    path = entries.save(an_entry("ppo-home", 0), tmp_path)
    path.write_text(DAMAGES[damage](path.read_text()))
    assert str(path) in refusal(lambda: entries.load(path))


def test_an_empty_store_is_refused(tmp_path: Path) -> None:
    assert str(tmp_path) in refusal(lambda: entries.load_all(tmp_path))


def test_a_further_training_is_one_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    further = Training("ppo-arm", "arms", TrainConfig(plant="arm"))
    monkeypatch.setattr("agents.study.trainings.TRAININGS", (*TRAININGS, further))
    assert training("ppo-arm") is further
    assert command_of(further.of_seed(2)) == "python train.py --plant arm --seed 2"
