"""Folders of runs: one run in each, no other's taken, locked while it trains."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from messages import refusal
from stable_baselines3 import PPO
from tiny_runs import MakeConfig, files_of, going_on, rows_of, steps_of, total_steps

from agents.learning import train
from agents.store import load_card

pytestmark = pytest.mark.usefixtures("elsewhere")


def test_default_folders_are_counted_up(make_config: MakeConfig) -> None:
    folders = [train(make_config(steps=128, out=None))[0] for _ in range(3)]
    assert folders == [Path("runs/train"), Path("runs/train-2"), Path("runs/train-3")]
    assert [load_card(folder / "model").steps for folder in folders] == [128] * 3


def test_two_runs_begun_at_once_have_folders_of_their_own(
    make_config: MakeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner, original = [], PPO.learn

    def learn(model: PPO, *arguments: Any, **options: Any) -> PPO:
        if not inner:
            inner.append(None)
            inner[0] = train(make_config(steps=128, out=None))[0]
        return original(model, *arguments, **options)

    monkeypatch.setattr(PPO, "learn", learn)
    outer, _ = train(make_config(steps=128, out=None, seed=1))
    assert (outer, inner[0]) == (Path("runs/train"), Path("runs/train-2"))
    assert [load_card(folder / "model").config["seed"] for folder in (outer, inner[0])] == [1, 0]


def test_a_new_run_never_takes_the_folder_of_an_old_one(make_config: MakeConfig, tmp_path: Path) -> None:
    train(make_config())
    before = files_of(make_config().out)
    for again in (make_config(seed=1), going_on(make_config().out, steps=640, out=make_config().out.parent / "other")):
        (tmp_path / "other" / "model").mkdir(parents=True, exist_ok=True)
        with pytest.raises(ValueError, match=r"^Input out must be a folder without a run"):
            train(again)
    assert files_of(make_config().out) == before


def test_a_run_in_training_cannot_be_gone_on_with(make_config: MakeConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    train(make_config())
    original = PPO.learn
    tried = []

    def learn(model: PPO, *arguments: Any, **options: Any) -> PPO:
        if not tried:
            tried.append(True)
            with pytest.raises(ValueError, match=r"^Input resume must be a run at rest; instead received .+"):
                train(going_on(make_config().out, steps=1024))
        return original(model, *arguments, **options)

    monkeypatch.setattr(PPO, "learn", learn)
    train(going_on(make_config().out, steps=640))
    assert tried
    assert steps_of(make_config().out)[-1] == 640


def test_a_run_can_be_gone_on_with_elsewhere(make_config: MakeConfig, tmp_path: Path) -> None:
    train(make_config())
    before = {path.name: path.stat().st_mtime_ns for path in make_config().out.rglob("*")}
    train(going_on(make_config().out, steps=640, out=tmp_path / "elsewhere"))
    assert {path.name: path.stat().st_mtime_ns for path in make_config().out.rglob("*")} == before
    assert load_card(tmp_path / "elsewhere" / "model").steps == 640
    assert total_steps(rows_of(tmp_path / "elsewhere"))[0] == 128


def test_going_on_in_the_same_folder_by_another_name(make_config: MakeConfig) -> None:
    train(make_config())
    (make_config().out.parent / "alias").symlink_to(make_config().out)
    train(going_on(make_config().out, steps=640, out=make_config().out.parent / "alias"))
    assert steps_of(make_config().out)[-1] == 640


@pytest.mark.parametrize("kind", ["file", "foreign model"])
def test_an_out_folder_that_cannot_be_used_is_refused_at_once(
    make_config: MakeConfig, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stable_baselines3.PPO.learn", lambda *_, **__: pytest.fail("training has begun"))
    if kind == "file":
        precious = tmp_path / "run"
    else:
        precious = tmp_path / "run" / "model" / "thesis.txt"
        precious.parent.mkdir(parents=True)
    precious.write_text("ten years")
    assert refusal(lambda: train(make_config())).startswith("Input out must be ")
    assert precious.read_text() == "ten years"
