"""Models on disk: they come back as they were, never half, and no file of theirs is ever run."""

from __future__ import annotations

import ast
import json
import math
import os
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from agents.catalogue import controller, names
from agents.checkpoints import save_model, stored_config
from agents.configs import PPOConfig, SACConfig, TrainConfig
from agents.learned import Learned
from agents.learning import build
from agents.store import (
    CARD,
    FORMAT,
    POLICY,
    TRAINING,
    Card,
    Normalisation,
    flatten,
    load_card,
    load_policy,
    load_training,
    save,
    unflatten_like,
)
from magenv.episodes import Settings

ROOT = Path(__file__).parents[1]
CONFIGS = {
    "ppo": TrainConfig(ppo=PPOConfig(n_envs=8, n_steps=16, batch_size=64, n_epochs=1, net=(16, 8)), steps=128),
    "sac": TrainConfig(
        algo="sac",
        sac=SACConfig(n_envs=8, batch_size=32, buffer_size=1000, learning_starts=64, gradient_steps=1, net=(16, 8)),
        steps=128,
    ),
}


@pytest.fixture(scope="module")
def trained() -> dict[str, tuple[BaseAlgorithm, VecNormalize]]:
    """Return agents of both algorithms after a few gradient steps."""
    made = {}
    for algo, config in CONFIGS.items():
        model, env = build(config)
        model.learn(128)
        env.training = False
        made[algo] = (model, env)
    return made


@pytest.fixture
def folder(tmp_path: Path, trained: Any) -> Path:
    """Return a sound PPO checkpoint."""
    path = tmp_path / "checkpoints" / "step-000000000128"
    save_model(path, *trained["ppo"], CONFIGS["ppo"], True, "python train.py")
    return path


def observations(n: int) -> NDArray[np.float32]:
    """Return observations (n, 63), some beyond what normalisation clips."""
    return np.random.default_rng(0).normal(0.0, 2.0, (n, 63)).astype(np.float32)


def content(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files beside and below a model."""
    files = (path for path in folder.parent.rglob("*") if path.is_file())
    return {str(path.relative_to(folder.parent)): path.read_bytes() for path in files}


# What is stored comes back.


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_a_stored_policy_acts_as_the_model_it_was_saved_from(algo: str, trained: Any, tmp_path: Path) -> None:
    model, env = trained[algo]
    save_model(tmp_path / "model", model, env, CONFIGS[algo], False, "")
    agent = Learned(tmp_path / "model")
    raw = observations(50)
    scaled = env.normalize_obs(raw)
    assert (np.abs(scaled) == 5.0).any(), "no observation is clipped"
    assert not np.array_equal(scaled, raw)
    expected = model.predict(scaled, deterministic=True)[0]
    actions, state = agent.predict(raw)
    assert state is None
    assert actions.dtype == np.float32
    assert len(np.unique(actions)) > 10
    np.testing.assert_array_equal(actions, expected)
    for row in range(3):
        single = agent.predict(raw[row])[0]
        assert single.shape == (10,)
        np.testing.assert_array_equal(single, model.predict(scaled[row], deterministic=True)[0])
    assert (agent.name, agent.action, agent.observation, agent.frame) == (algo, "home", "full", "robots")


def test_the_card_comes_back_as_it_was(folder: Path) -> None:
    card = load_card(folder)
    assert (card.algo, card.net, card.settings, card.steps) == ("ppo", (16, 8), Settings(), 128)
    assert card.command == "python train.py"
    assert card.versions["torch"] == torch.__version__
    assert card.config["ppo"]["net"] == [16, 8]
    assert json.loads((folder / CARD).read_text())["format"] == FORMAT


def test_weights_statistics_and_optimisers_come_back_as_they_were(folder: Path, trained: Any) -> None:
    model, env = trained["ppo"]
    weights, statistics = load_policy(folder)
    assert weights.keys() == model.policy.state_dict().keys()
    for name, value in model.policy.state_dict().items():
        assert torch.equal(weights[name], value)
    np.testing.assert_array_equal(statistics.mean, env.obs_rms.mean)
    np.testing.assert_array_equal(statistics.variance, env.obs_rms.var)
    assert statistics.count == env.obs_rms.count
    assert sorted(path.name for path in folder.iterdir()) == [CARD, POLICY, TRAINING]
    moments = [name for name in load_training(folder) if name.endswith("exp_avg")]
    assert len(moments) == len(list(model.policy.parameters()))


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
        unflatten_like(blank, flat | {"a.0": torch.zeros(4)})


# A folder is replaced whole or not at all.


@pytest.mark.parametrize(("where", "call"), [("save_file", 1), ("save_file", 2), ("os.replace", 1), ("os.replace", 2)])
def test_a_write_that_fails_leaves_the_old_model(
    folder: Path, trained: Any, monkeypatch: pytest.MonkeyPatch, where: str, call: int
) -> None:
    before, calls = content(folder), 0
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
            save_model(folder, *trained["ppo"], CONFIGS["ppo"], True, "another")
    assert calls >= call
    assert load_card(folder).command == "python train.py"
    assert {name: value for name, value in content(folder).items() if name.startswith(f"{folder.name}/")} == before
    save_model(folder, *trained["ppo"], CONFIGS["ppo"], False, "another")
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    assert sorted(path.name for path in folder.iterdir()) == [CARD, POLICY]
    assert load_card(folder).command == "another"


def test_nothing_but_a_model_is_ever_replaced(tmp_path: Path, trained: Any) -> None:
    for name in ("model", "model.old", "model.new"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "thesis.txt").write_text("ten years")
    with pytest.raises(ValueError, match=r"Input out must be .*instead received"):
        save_model(tmp_path / "model", *trained["ppo"], CONFIGS["ppo"], False, "")
    save_model(tmp_path / "other", *trained["ppo"], CONFIGS["ppo"], False, "")
    (tmp_path / "model" / "thesis.txt").rename(tmp_path / "thesis.txt")
    (tmp_path / "model").rmdir()
    save_model(tmp_path / "model", *trained["ppo"], CONFIGS["ppo"], False, "")
    for name in ("model.old", "model.new"):
        assert (tmp_path / name / "thesis.txt").read_text() == "ten years"


# A doctored file is refused in one line, and runs nothing.


class Bomb:
    """Makes a file when unpickled."""

    def __init__(self, canary: Path) -> None:
        self._canary = canary

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self._canary,)


def one_line(call: Callable[[], object]) -> str:
    """Return the message of the ``ValueError`` that ``call`` must raise: one line, what must be and what was."""
    with pytest.raises(ValueError, match=r"^Input .+ must .+; instead received .+") as raised:
        call()
    message = str(raised.value)
    assert "\n" not in message
    assert len(message) < 600
    return message


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
def test_a_doctored_file_is_refused_and_runs_nothing(folder: Path, tmp_path: Path, name: str, kind: str) -> None:
    canary = tmp_path / "canary"
    sound = (folder / name).read_bytes()
    files = bombs(canary, tmp_path) | {
        "random": np.random.default_rng(0).bytes(5000),
        "empty": b"",
        "header": (2**62).to_bytes(8, "little") + b"{}",
        "truncated": sound[: len(sound) - 40],
    }
    (folder / name).write_bytes(files[kind])
    if name == TRAINING:
        one_line(lambda: load_training(folder))
        Learned(folder)  # does not even open it
    else:
        one_line(lambda: Learned(folder))
        one_line(lambda: controller(str(folder)))
    if name == CARD:
        one_line(lambda: stored_config(tmp_path))
    assert not canary.exists()


def changed(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Rewrite the folder's card with a change."""
    card = json.loads((folder / CARD).read_text())
    change(card)
    (folder / CARD).write_text(json.dumps(card))


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
    "steps a text": lambda card: card.update(steps="many"),
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
    "control_hz infinite": lambda card: card["settings"].update(control_hz=math.inf),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_card_is_refused(folder: Path, damage: str) -> None:
    changed(folder, DAMAGED[damage])
    one_line(lambda: Learned(folder))


@pytest.mark.parametrize("text", ["[]", "null", '"magenv model 1"', "{}", "{" * 10_000, "[" * 100_000, "\x00", "NaN"])
def test_a_card_that_is_no_card_is_refused(folder: Path, text: str) -> None:
    (folder / CARD).write_text(text)
    one_line(lambda: Learned(folder))


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
def test_foreign_weights_are_refused(folder: Path, damage: str) -> None:
    tensors = load_file(folder / POLICY)
    FOREIGN[damage](tensors)
    save_file(tensors, folder / POLICY)
    one_line(lambda: Learned(folder))


def test_a_missing_model_is_refused(folder: Path, tmp_path: Path) -> None:
    for name in (tmp_path / "nowhere", tmp_path, folder / CARD):
        assert str(name) in one_line(lambda name=name: Learned(name))  # type: ignore[misc]
        assert str(name) in one_line(lambda name=name: controller(str(name)))  # type: ignore[misc]
    (folder / POLICY).unlink()
    assert POLICY in one_line(lambda: Learned(folder))
    assert "baseline" in one_line(lambda: controller("nobody"))


def test_an_agent_refuses_what_it_was_not_made_for(folder: Path) -> None:
    assert controller(str(folder), 2, 2.0).action == "home"
    assert "n_epm" in one_line(lambda: controller(str(folder), 3))
    assert "control_hz" in one_line(lambda: controller(str(folder), 2, 10.0))
    with pytest.raises(ValueError, match="shape"):
        Learned(folder).predict(np.zeros((2, 70), np.float32))


def test_agents_of_several_folders_can_be_told_apart(folder: Path, tmp_path: Path, trained: Any) -> None:
    save_model(tmp_path / "twin", *trained["ppo"], CONFIGS["ppo"], False, "")
    agents = [controller(str(path)) for path in (folder, tmp_path / "twin")]
    assert len({agent.name for agent in agents} - set(names())) == 2


def test_statistics_of_a_constant_observation_are_sound(folder: Path, trained: Any) -> None:
    model, _ = trained["ppo"]
    card = Card.of("ppo", (16, 8), Settings(), 1, CONFIGS["ppo"])
    save(folder, card, model.policy.state_dict(), Normalisation(np.zeros(63), np.zeros(63), 1e-4))
    assert np.isfinite(Learned(folder).predict(observations(3))[0]).all()


# No source file may read code from data.

_MODULES = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "yaml"}
_BUILTINS = {"eval", "exec", "compile", "__import__"}


def violations(source: str) -> list[str]:
    """Return what in a Python source can run code that it has read."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.split(".")[0] in _MODULES]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            found += [module] if module.split(".")[0] in _MODULES else []
            loaders = [alias.name for alias in node.names if alias.name == "load"]
            found += loaders if module in ("torch", "numpy") else []
        elif isinstance(node, ast.Call):
            called, options = ast.unparse(node.func), {option.arg: option.value for option in node.keywords}
            pickles = options.get("allow_pickle")
            safe = isinstance(pickles, ast.Constant) and pickles.value is False
            loads = re.fullmatch(
                r"(torch|th|yaml|\w*(PPO|SAC|Policy|Algorithm|Normalize|model|policy|env)\w*)\.load", called
            )
            reads = called in ("np.load", "numpy.load")
            if called in _BUILTINS or loads or (reads and not safe) or ("allow_pickle" in options and not safe):
                found.append(called)
            if called.rsplit(".", maxsplit=1)[-1] in ("set_parameters", "load_replay_buffer", "unpickle", "run_path"):
                found.append(called)
    return found


def test_no_source_file_runs_what_it_reads() -> None:
    files = [path for pattern in ("agents/**/*.py", "magenv/**/*.py", "*.py") for path in ROOT.glob(pattern)]
    assert len(files) > 30
    assert {path.name: found for path in files if (found := violations(path.read_text()))} == {}


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from pickle import loads",
        "import yaml as y",
        "torch.load(path)",
        "from torch import load",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "np.savez(path, allow_pickle=flag)",
        "PPO.load(path)",
        "VecNormalize.load(path, env)",
        "model.load(path)",
        "policy = PPOPolicy.load(path)",
        "eval(text)",
        "exec(text)",
        "model.set_parameters(path)",
    ],
)
def test_the_scan_sees(line: str) -> None:
    assert violations(line)


def test_the_scan_lets_safe_readers_pass() -> None:
    safe = ["np.load(f, allow_pickle=False)", "load_file(p)", "json.loads(t)", "re.compile(p)", "policy.load_card(p)"]
    assert not [line for line in safe if violations(line)]
