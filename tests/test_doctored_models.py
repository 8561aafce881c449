"""A doctored model is refused in one line, and runs nothing."""

from __future__ import annotations

import json
import math
import pickle
import re
import shutil
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from messages import refusal
from safetensors.torch import load_file, save_file

import agents
from agents.catalogue import controller
from agents.checkpoints import stored_config
from agents.learned import Learned
from agents.store import CARD, POLICY, TRAINING, load_training


class Bomb:
    """Makes a file when unpickled."""

    def __init__(self, canary: Path) -> None:
        self._canary = canary

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self._canary,)


def bombs(canary: Path, work: Path) -> dict[str, bytes]:
    """Return files that make the canary when a careless reader opens them."""
    torch.save({"policy.log_std": Bomb(canary)}, work / "bomb.pt")
    np.save(work / "bomb.npy", np.array([Bomb(canary)], dtype=object), allow_pickle=True)
    found = {
        "pickle": pickle.dumps(Bomb(canary)),
        "torch": (work / "bomb.pt").read_bytes(),
        "numpy": (work / "bomb.npy").read_bytes(),
        "python": f"open({str(canary)!r}, 'w')".encode(),
    }
    for name in ("bomb.pt", "bomb.npy"):
        (work / name).unlink()
    return found


def test_the_bombs_are_live(tmp_path: Path) -> None:
    canary = tmp_path / "canary"
    made = bombs(canary, tmp_path)
    assert not canary.exists()
    pickle.loads(made["pickle"])
    assert canary.exists()


@pytest.mark.parametrize("kind", ["pickle", "torch", "numpy", "python", "random", "empty", "header", "truncated"])
@pytest.mark.parametrize("name", [CARD, POLICY, TRAINING])
def test_a_doctored_file_is_refused_and_runs_nothing(checkpoint: Path, tmp_path: Path, name: str, kind: str) -> None:
    canary = tmp_path / "canary"
    sound = (checkpoint / name).read_bytes()
    files = bombs(canary, tmp_path) | {
        "random": np.random.default_rng(0).bytes(5000),
        "empty": b"",
        "header": (2**62).to_bytes(8, "little") + b"{}",
        "truncated": sound[: len(sound) - 40],
    }
    (checkpoint / name).write_bytes(files[kind])
    if name == TRAINING:
        refusal(lambda: load_training(checkpoint))
        Learned(checkpoint)  # does not even open it
    else:
        refusal(lambda: Learned(checkpoint))
        refusal(lambda: controller(str(checkpoint)))
    if name == CARD:
        refusal(lambda: stored_config(tmp_path))
    assert not canary.exists()


def changed(checkpoint: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Rewrite the checkpoint's card with a change."""
    card = json.loads((checkpoint / CARD).read_text())
    change(card)
    (checkpoint / CARD).write_text(json.dumps(card))


DAMAGED: dict[str, Callable[[dict[str, Any]], object]] = {
    "no format": lambda card: card.pop("format"),
    "other format": lambda card: card.update(format="magenv model 99"),
    "unknown key": lambda card: card.update(hook="os.system('true')"),
    "no settings": lambda card: card.pop("settings"),
    "unknown setting": lambda card: card["settings"].update(hook=1),
    "settings a list": lambda card: card.update(settings=[1, 2]),
    "foreign algorithm": lambda card: card.update(algo="dqn"),
    "algorithm a list": lambda card: card.update(algo=["ppo"]),
    "other algorithm": lambda card: card.update(algo="sac"),
    "no net": lambda card: card.pop("net"),
    "empty net": lambda card: card.update(net=[]),
    "narrower net": lambda card: card.update(net=[8, 8]),
    "deeper net": lambda card: card.update(net=[16, 8, 8]),
    "huge net": lambda card: card.update(net=[10**7, 10**7]),
    "negative net": lambda card: card.update(net=[-1, 8]),
    "net a text": lambda card: card.update(net="os"),
    "net a number": lambda card: card.update(net=64),
    "a net of truths": lambda card: card.update(net=[True, True]),
    "fractional net": lambda card: card.update(net=[16.5, 8]),
    "steps negative": lambda card: card.update(steps=-1),
    "steps a text": lambda card: card.update(steps="many"),
    "no activation": lambda card: card.pop("activation"),
    "foreign activation": lambda card: card.update(activation="elu"),
    "activation a list": lambda card: card.update(activation=["relu"]),
    "other activation": lambda card: card.update(activation="tanh"),
    "no clip": lambda card: card.pop("clip_observation"),
    "clip zero": lambda card: card.update(clip_observation=0),
    "clip infinite": lambda card: card.update(clip_observation=math.inf),
    "clip a text": lambda card: card.update(clip_observation="10"),
    "other clip": lambda card: card.update(clip_observation=5.0),
    "no clip in its training": lambda card: card["config"].pop("clip_observation"),
    "no activation in its training": lambda card: card["config"]["ppo"].pop("activation"),
    "of another algorithm's training": lambda card: card["config"].update(algo="sac"),
    "of no algorithm's training": lambda card: card["config"].pop("ppo"),
    "options a list": lambda card: card["config"].update(ppo=[]),
    "of another net's training": lambda card: card["config"]["ppo"].update(net=[64, 64]),
    "of a residual's training": lambda card: card["config"].update(residual="idle"),
    "config a text": lambda card: card.update(config="none"),
    "other n_epm": lambda card: card["settings"].update(n_epm=3),
    "impossible n_epm": lambda card: card["settings"].update(n_epm=10**6),
    "n_epm a text": lambda card: card["settings"].update(n_epm="2"),
    "foreign plant": lambda card: card["settings"].update(plant="moon"),
    "plant a list": lambda card: card["settings"].update(plant=["paper"]),
    "foreign scenario": lambda card: card["settings"].update(scenario="approach-5"),
    "foreign action": lambda card: card["settings"].update(action="jump"),
    "other action": lambda card: card["settings"].update(action="wrench"),
    "other observation": lambda card: card["settings"].update(observation="errors"),
    "foreign frame": lambda card: card["settings"].update(frame="lab"),
    "control_hz a text": lambda card: card["settings"].update(control_hz="2.0"),
    "control_hz null": lambda card: card["settings"].update(control_hz=None),
    "control_hz zero": lambda card: card["settings"].update(control_hz=0.0),
    "action of its size": lambda card: card["settings"].update(action="pose"),
    "frame of its size": lambda card: card["settings"].update(frame="global"),
    "other control_hz": lambda card: card["settings"].update(control_hz=4.0),
    "no version": lambda card: card.update(versions={}),
    "other version": lambda card: card["versions"].update(magenv="7.1.0"),
    "other minor version": lambda card: card["versions"].update(magenv="0.2.0"),
    "version a number": lambda card: card["versions"].update(magenv=0.1),
    "residual a text": lambda card: card.update(residual="tuned"),
    "residual of nobody": lambda card: card.update(residual={"controller": "nobody", "scale": 0.1}),
    "residual of a list": lambda card: card.update(residual={"controller": ["tuned"], "scale": 0.1}),
    "residual unscaled": lambda card: card.update(residual={"controller": "idle"}),
    "residual scale zero": lambda card: card.update(residual={"controller": "idle", "scale": 0.0}),
    "residual of another action": lambda card: card.update(residual={"controller": "tuned", "scale": 0.1}),
    "a policy of no residual": lambda card: card.update(residual={"controller": "idle", "scale": 0.1}),
    "control_hz infinite": lambda card: card["settings"].update(control_hz=math.inf),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_card_is_refused(checkpoint: Path, damage: str) -> None:
    changed(checkpoint, DAMAGED[damage])
    refusal(lambda: Learned(checkpoint))


def test_a_residual_of_another_share_than_in_its_training_is_refused(tmp_path: Path) -> None:
    shutil.copytree(Path(agents.__file__).parent / "data" / "steered-ppo", tmp_path / "model")
    changed(tmp_path / "model", lambda card: card["residual"].update(scale=1.0))
    assert "residual_scale must be 0.2, as in its training" in refusal(lambda: Learned(tmp_path / "model"))


@pytest.mark.parametrize("text", ["[]", "null", '"magenv model 1"', "{}", "{" * 10_000, "[" * 100_000, "\x00", "NaN"])
def test_a_card_that_is_no_card_is_refused(checkpoint: Path, text: str) -> None:
    (checkpoint / CARD).write_text(text)
    refusal(lambda: Learned(checkpoint))


def without(name: str) -> Callable[[dict[str, torch.Tensor]], object]:
    return lambda tensors: tensors.pop(name)


def with_value(name: str, value: torch.Tensor) -> Callable[[dict[str, torch.Tensor]], object]:
    return lambda tensors: tensors.update({name: value})


FOREIGN: dict[str, Callable[[dict[str, torch.Tensor]], object]] = {
    "no mean": without("observation.mean"),
    "no variance": without("observation.variance"),
    "no count": without("observation.count"),
    "no log_std": without("policy.log_std"),
    "an extra tensor": with_value("policy.extra", torch.zeros(3)),
    "a shape": with_value("policy.log_std", torch.zeros(11)),
    "weights not finite": with_value("policy.log_std", torch.full((10,), math.nan)),
    "a short mean": with_value("observation.mean", torch.zeros(62, dtype=torch.float64)),
    "a mean not finite": with_value("observation.mean", torch.full((63,), math.inf, dtype=torch.float64)),
    "a variance not finite": with_value("observation.variance", torch.full((63,), math.nan, dtype=torch.float64)),
    "a negative variance": with_value("observation.variance", -torch.ones(63, dtype=torch.float64)),
    "a mean in bfloat16": with_value("observation.mean", torch.zeros(63, dtype=torch.bfloat16)),
    "weights in float8": with_value("policy.log_std", torch.zeros(10).to(torch.float8_e4m3fn)),
    "complex weights": with_value("policy.log_std", torch.zeros(10, dtype=torch.complex64)),
    "weights that overflow": lambda tensors: [
        value.fill_(3e38) for name, value in tensors.items() if name.startswith("policy.")
    ],
    "an empty count": with_value("observation.count", torch.zeros(0, dtype=torch.float64)),
    "a count not finite": with_value("observation.count", torch.tensor([math.nan], dtype=torch.float64)),
}


@pytest.mark.parametrize("damage", FOREIGN)
def test_foreign_weights_are_refused(checkpoint: Path, damage: str) -> None:
    tensors = load_file(checkpoint / POLICY)
    FOREIGN[damage](tensors)
    save_file(tensors, checkpoint / POLICY)
    refusal(lambda: Learned(checkpoint))


def test_what_a_policy_is_stored_for_and_what_it_meets_are_both_named(checkpoint: Path, tmp_path: Path) -> None:
    def told(damage: str, training_told: bool = True) -> str:
        copy = tmp_path / f"{damage}, {training_told}"
        shutil.copytree(checkpoint, copy)
        changed(copy, DAMAGED[damage])
        if not training_told:
            changed(copy, lambda card: card["config"].update(card["settings"]))
            changed(copy, lambda card: card["config"]["ppo"].update(net=card["net"]))
            if json.loads((copy / CARD).read_text())["residual"] is not None:
                changed(copy, lambda card: card["config"].update(residual="idle", residual_scale=0.1))
        return refusal(lambda: Learned(copy))

    assert "'magenv model 1'; instead received 'magenv model 99'" in told("other format")
    own = version("magenv").rpartition(".")[0]
    assert f"of magenv {own}, as this one; instead received '7.1.0'" in told("other version")
    assert "action must be 'home', as in its training; instead received 'pose'" in told("action of its size")
    assert "frame must be 'robots', as in its training; instead received 'global'" in told("frame of its size")
    assert "control_hz must be 2.0, as in its training; instead received 4.0" in told("other control_hz")
    assert re.search(r"shape \(8, 63\).*\(16, 63\)", told("narrower net", training_told=False))
    assert re.search(r"\[63, 6\].*'wrench'.*\[63, 10\]", told("other action", training_told=False))
    assert re.search(r"\[70, 15\].*n_epm 3.*\[63, 10\]", told("other n_epm", training_told=False))
    assert re.search(r"\[8, 10\].*'errors'.*\[63, 10\]", told("other observation", training_told=False))
    assert re.search(r"\[73, 10\].*corrects idle.*\[63, 10\]", told("a policy of no residual", training_told=False))


def test_a_missing_model_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    for name in (tmp_path / "nowhere", tmp_path, checkpoint / CARD):
        assert str(name) in refusal(lambda name=name: Learned(name))  # type: ignore[misc]
        assert str(name) in refusal(lambda name=name: controller(str(name)))  # type: ignore[misc]
    (checkpoint / POLICY).unlink()
    assert POLICY in refusal(lambda: Learned(checkpoint))
    assert "baseline" in refusal(lambda: controller("nobody"))


def test_an_agent_refuses_what_it_was_not_made_for(checkpoint: Path) -> None:
    assert controller(str(checkpoint), 2, 2.0).action == "home"
    assert "n_epm" in refusal(lambda: controller(str(checkpoint), 3))
    assert "control_hz" in refusal(lambda: controller(str(checkpoint), 2, 10.0))
    with pytest.raises(ValueError, match="shape"):
        Learned(checkpoint).predict(np.zeros((2, 70), np.float32))
