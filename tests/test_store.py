"""Models on disk: they come back as they were, and never half."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.numpy import save_file
from tiny_runs import SAVED, files_of

from agents.catalogue import controller, names
from agents.checkpoints import save_model
from agents.learned import Learned
from agents.networks import flatten, unflatten_like
from agents.store import (
    CARD,
    FORMAT,
    POLICY,
    TRAINING,
    Card,
    Normalisation,
    load_card,
    load_policy,
    load_training,
    save,
)
from magenv.episodes import Settings


def observations(n: int) -> NDArray[np.float32]:
    """Return observations (n, 63), some beyond what normalisation clips."""
    return np.random.default_rng(0).normal(0.0, 2.0, (n, 63)).astype(np.float32)


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_a_stored_policy_acts_as_the_model_it_was_saved_from(algo: str, trained: Any, tmp_path: Path) -> None:
    model, env = trained[algo]
    save_model(tmp_path / "model", model, env, SAVED[algo], False, "")
    agent = Learned(tmp_path / "model")
    raw = observations(50)
    scaled = env.normalize_obs(raw)
    assert (np.abs(scaled) == SAVED[algo].clip_observation).any(), "no observation is clipped"
    assert not np.array_equal(scaled, raw)
    expected = model.predict(scaled, deterministic=True)[0]
    actions, state = agent.predict(raw)
    assert state is None
    assert actions.dtype == np.float32
    assert len(np.unique(actions)) > 10
    np.testing.assert_allclose(actions, expected, atol=1e-6)
    for row in range(3):
        single = agent.predict(raw[row])[0]
        assert single.shape == (10,)
        np.testing.assert_allclose(single, actions[row], rtol=0.0, atol=1e-6)
    assert (agent.name, agent.action, agent.observation, agent.frame) == (algo, "home", "full", "robots")


def test_the_card_comes_back_as_it_was(checkpoint: Path) -> None:
    card = load_card(checkpoint)
    assert (card.algo, card.net, card.settings, card.steps) == ("ppo", (16, 8), Settings(), 128)
    assert card.command == "python train.py"
    assert card.versions["torch"] == torch.__version__
    assert card.config["ppo"]["net"] == [16, 8]
    assert json.loads((checkpoint / CARD).read_text())["format"] == FORMAT


def test_weights_statistics_and_optimisers_come_back_as_they_were(checkpoint: Path, trained: Any) -> None:
    model, env = trained["ppo"]
    weights, statistics = load_policy(checkpoint)
    assert weights.keys() == model.policy.state_dict().keys()
    for name, value in model.policy.state_dict().items():
        np.testing.assert_array_equal(weights[name], value.numpy())
    np.testing.assert_array_equal(statistics.mean, env.obs_rms.mean)
    np.testing.assert_array_equal(statistics.variance, env.obs_rms.var)
    assert statistics.count == env.obs_rms.count
    assert sorted(path.name for path in checkpoint.iterdir()) == [CARD, POLICY, TRAINING]
    moments = [name for name in load_training(checkpoint) if name.endswith("exp_avg")]
    assert len(moments) == sum(parameter.requires_grad for parameter in model.policy.parameters())


def test_nested_state_survives_being_flattened() -> None:
    tree = {"a": [torch.arange(3.0), {"b": (1, 2.5)}], "c": True, "d": None, 0: {"e": torch.tensor(7.0)}}
    flat = flatten(tree)
    assert set(flat) == {"a.0", "a.1.b.0", "a.1.b.1", "c", "0.e"}
    blank = {"a": [torch.zeros(3), {"b": (0, 0.0)}], "c": False, "d": None, 0: {"e": torch.tensor(0.0)}}
    back = unflatten_like(blank, flat)
    assert torch.equal(back["a"][0], torch.arange(3.0))
    assert back["a"][1] == {"b": (1, 2.5)}
    assert (back["c"], back["d"], back[0]["e"].item()) == (True, None, 7.0)
    assert [type(value) for value in back["a"][1]["b"]] == [int, float]
    with pytest.raises(ValueError, match=r"Input checkpoint must be with c; instead received"):
        unflatten_like(blank, {name: value for name, value in flat.items() if name != "c"})
    with pytest.raises(ValueError, match=r"Input checkpoint a.0 must be of shape \(3,\)"):
        unflatten_like(blank, flat | {"a.0": np.zeros(4)})


def test_agents_of_several_folders_can_be_told_apart(checkpoint: Path, tmp_path: Path, trained: Any) -> None:
    save_model(tmp_path / "twin", *trained["ppo"], SAVED["ppo"], False, "")
    agents = [controller(str(path)) for path in (checkpoint, tmp_path / "twin")]
    assert len({agent.name for agent in agents} - set(names())) == 2


def test_statistics_of_a_constant_observation_are_sound(checkpoint: Path, trained: Any) -> None:
    model, _ = trained["ppo"]
    card = Card.of(SAVED["ppo"], 1)
    weights = flatten(dict(model.policy.state_dict()))
    save(checkpoint, card, weights, Normalisation(np.zeros(63), np.zeros(63), 1e-4))
    assert np.isfinite(Learned(checkpoint).predict(observations(3))[0]).all()


# A folder is replaced whole or not at all.


@pytest.mark.parametrize(("where", "call"), [("save_file", 1), ("save_file", 2), ("os.replace", 1), ("os.replace", 2)])
def test_a_write_that_fails_leaves_the_old_model(
    checkpoint: Path, trained: Any, monkeypatch: pytest.MonkeyPatch, where: str, call: int
) -> None:
    before, calls = files_of(checkpoint), 0
    original: Callable[..., Any] = save_file if where == "save_file" else os.replace

    def fail(*arguments: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == call:
            raise OSError("disk full")
        original(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(f"agents.store.{where}", fail)
        with pytest.raises(OSError, match="disk full"):
            save_model(checkpoint, *trained["ppo"], SAVED["ppo"], True, "another")
    assert calls >= call
    assert load_card(checkpoint).command == "python train.py"
    assert files_of(checkpoint) == before
    save_model(checkpoint, *trained["ppo"], SAVED["ppo"], False, "another")
    assert [path.name for path in checkpoint.parent.iterdir()] == [checkpoint.name]
    assert sorted(path.name for path in checkpoint.iterdir()) == [CARD, POLICY]
    assert load_card(checkpoint).command == "another"


def test_nothing_but_a_model_is_ever_replaced(tmp_path: Path, trained: Any) -> None:
    for name in ("model", "model.old", "model.new"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "thesis.txt").write_text("ten years")
    with pytest.raises(ValueError, match=r"Input out must be .*instead received"):
        save_model(tmp_path / "model", *trained["ppo"], SAVED["ppo"], False, "")
    save_model(tmp_path / "other", *trained["ppo"], SAVED["ppo"], False, "")
    (tmp_path / "model" / "thesis.txt").rename(tmp_path / "thesis.txt")
    (tmp_path / "model").rmdir()
    save_model(tmp_path / "model", *trained["ppo"], SAVED["ppo"], False, "")
    for name in ("model.old", "model.new"):
        assert (tmp_path / name / "thesis.txt").read_text() == "ten years"
