"""Models on disk: a folder with a JSON card and safetensors weights. Nothing in it is ever unpickled or evaluated.

``card.json`` tells what the policy needs to be built and is bound to (algorithm, networks, environment, versions);
``policy.safetensors`` holds its weights and the observation statistics; ``training.safetensors``, beside them in
checkpoints, the optimisers.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from agents.configs import check_net
from agents.evaluation import Score
from magenv.episodes import Settings
from magenv.params import InputError, require

FORMAT = "magenv model 1"
CARD, POLICY, TRAINING = "card.json", "policy.safetensors", "training.safetensors"
_PACKAGES = ("magenv", "numpy", "numba", "gymnasium", "stable-baselines3", "torch")
_MEAN, _VARIANCE, _COUNT = "observation.mean", "observation.variance", "observation.count"


@dataclass(frozen=True)
class Card:
    """What a stored policy is and was trained on."""

    algo: str
    net: tuple[int, ...]
    settings: Settings
    steps: int
    """Environment steps seen."""
    config: dict[str, Any]
    """The training's whole configuration."""
    versions: dict[str, str]
    """Of the packages that made it."""
    command: str = ""
    """Command that made it."""
    score: Score | None = None
    """On the held-out episodes of its training; None where it was not judged, as before there were any."""

    @classmethod
    def of(cls, algo: str, net: tuple[int, ...], settings: Settings, steps: int, config: object) -> Card:
        """Return the card of a model made now, with a dataclass as configuration."""
        assert dataclasses.is_dataclass(config)
        assert not isinstance(config, type)
        plain = json.loads(json.dumps(dataclasses.asdict(config), default=str))
        return cls(algo, net, settings, steps, plain, {name: version(name) for name in _PACKAGES})


@dataclass(frozen=True, eq=False)
class Normalisation:
    """Running statistics of the observations."""

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    count: float


class NotFiniteError(InputError):
    """Tensors to be stored that are not finite."""


def check_replaceable(folder: Path) -> None:
    """Raise ``ValueError`` where something stands in the place of a model's folder that is no model."""
    foreign = folder.exists() and not (folder / CARD).is_file()
    require(not foreign, "out", "a place for a model, not one of something else", str(folder))


def save(
    folder: Path,
    card: Card,
    policy: Mapping[str, torch.Tensor],
    normalisation: Normalisation,
    training: Mapping[str, torch.Tensor] | None = None,
) -> None:
    """Write a model folder whole or not at all; a folder that stood there is replaced.

    Raises
    ------
    ValueError
        If something else stands there.
    NotFiniteError
        If a tensor is not finite; nothing has been written then.
    """
    check_replaceable(folder)
    numbers = (torch.from_numpy(np.stack([normalisation.mean, normalisation.variance])), *policy.values())
    finite = all(bool(torch.isfinite(value).all()) for value in (*numbers, *(training or {}).values()))
    if not finite:
        raise NotFiniteError(f"Input model must be of finite numbers to be stored; instead received {str(folder)!r}.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{folder.name}.", dir=folder.parent) as scratch:
        new, old = Path(scratch) / "new", Path(scratch) / "old"
        new.mkdir()
        (new / CARD).write_text(json.dumps({"format": FORMAT} | dataclasses.asdict(card), indent=1) + "\n")
        tensors = {f"policy.{name}": value.detach().cpu().contiguous() for name, value in policy.items()}
        tensors[_MEAN] = torch.from_numpy(np.array(normalisation.mean))
        tensors[_VARIANCE] = torch.from_numpy(np.array(normalisation.variance))
        tensors[_COUNT] = torch.tensor([normalisation.count], dtype=torch.float64)
        save_file(tensors, new / POLICY)
        if training is not None:
            save_file({name: value.detach().cpu().contiguous() for name, value in training.items()}, new / TRAINING)
        try:
            if folder.exists():
                os.replace(folder, old)
            os.replace(new, folder)
        except BaseException:  # Ctrl-C as well
            if old.exists() and not folder.exists():
                os.replace(old, folder)
            raise


def recover(folder: Path) -> None:
    """Finish or drop what a process killed within ``save`` left beside a model's folder; nobody may be writing it."""
    for scratch in folder.parent.glob(f"{folder.name}.*"):
        left = {path.name for path in scratch.iterdir()} if scratch.is_dir() else {"a file"}
        if left <= {"new", "old"}:
            if "old" in left and not folder.exists():  # killed between the two moves: the new one is whole
                os.replace(scratch / "new", folder)
            shutil.rmtree(scratch)


def load_card(folder: Path) -> Card:
    """Read and check a model's card.

    Raises
    ------
    ValueError
        If the folder holds no magenv model or the card is damaged.
    """
    path = Path(folder) / CARD
    require(path.is_file(), "model", f"a folder with {CARD}", str(folder))
    try:
        raw = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        raise InputError(f"Input model must be a magenv model; instead received {path}, which is not JSON.") from error
    told = raw.pop("format", None) if isinstance(raw, dict) else None
    require(told == FORMAT, "model", f"a card of format {FORMAT!r}", told)
    try:
        raw["settings"] = Settings(**raw["settings"])
        raw["net"] = tuple(raw["net"])
        if raw.get("score") is not None:
            raw["score"] = Score(**raw["score"])
        card = Card(**raw)
    except (KeyError, TypeError) as error:
        raise InputError(f"Input model must have a whole card; instead received {path} ({error}).") from error
    check_net(card.net)
    for name, value, kind in (
        ("algo", card.algo, str),
        ("steps", card.steps, int),
        ("config", card.config, dict),
        ("versions", card.versions, dict),
        ("command", card.command, str),
    ):
        require(isinstance(value, kind), f"model's {name}", f"of type {kind.__name__}", value)
    return card


def load_policy(folder: Path) -> tuple[dict[str, torch.Tensor], Normalisation]:
    """Read a model's weights and observation statistics.

    Raises
    ------
    ValueError
        If the file is missing, is not safetensors, or lacks the statistics.
    """
    tensors = _load_tensors(Path(folder) / POLICY)
    for name in (_MEAN, _VARIANCE, _COUNT):
        require(name in tensors, "model", f"weights with {name}", str(Path(folder) / POLICY))
    kinds = {name: torch.float64 if name in (_MEAN, _VARIANCE, _COUNT) else torch.float32 for name in tensors}
    fits = all(value.dtype == kinds[name] for name, value in tensors.items())
    require(fits, "model", "weights in float32 and statistics in float64", str(Path(folder) / POLICY))
    finite = all(bool(torch.isfinite(value).all()) for value in tensors.values())
    require(finite, "model", "finite weights", str(Path(folder) / POLICY))
    mean, variance, count = (tensors.pop(name).numpy().astype(np.float64) for name in (_MEAN, _VARIANCE, _COUNT))
    sound = bool((variance >= 0).all()) and count.shape == (1,)
    require(sound, "model", "sound observation statistics", str(Path(folder) / POLICY))
    policy = {name.removeprefix("policy."): value for name, value in tensors.items()}
    return policy, Normalisation(mean, variance, float(count[0]))


def load_training(folder: Path) -> dict[str, torch.Tensor]:
    """Read a checkpoint's optimisers; the errors are those of ``load_policy``."""
    return _load_tensors(Path(folder) / TRAINING)


def _load_tensors(path: Path) -> dict[str, torch.Tensor]:
    require(path.is_file(), "model", f"a folder with {path.name}", str(path.parent))
    try:
        tensors: dict[str, torch.Tensor] = load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"Input model must hold safetensors; instead received {path} ({error}).") from error
    return tensors


def flatten(tree: Any, prefix: str = "") -> dict[str, torch.Tensor]:
    """Return all tensors and numbers of nested dictionaries and lists by dotted path."""
    if isinstance(tree, torch.Tensor):
        return {prefix: tree}
    if isinstance(tree, (bool, int, float)):
        return {prefix: torch.tensor(tree, dtype=torch.float64)}
    items = tree.items() if isinstance(tree, Mapping) else enumerate(tree) if isinstance(tree, (list, tuple)) else ()
    flat: dict[str, torch.Tensor] = {}
    for key, value in items:
        flat |= flatten(value, f"{prefix}.{key}" if prefix else str(key))
    return flat


def unflatten_like(tree: Any, flat: Mapping[str, torch.Tensor], prefix: str = "") -> Any:
    """Return ``tree`` with its tensors and numbers replaced by those of ``flat``, the rest as it is.

    Raises
    ------
    ValueError
        If one is missing or has another shape.
    """
    if isinstance(tree, (torch.Tensor, bool, int, float)):
        require(prefix in flat, "checkpoint", f"with {prefix}", "a file without it")
        value = flat[prefix]
        if isinstance(tree, torch.Tensor):
            require(value.shape == tree.shape, f"checkpoint {prefix}", f"of shape {tuple(tree.shape)}", value.shape)
            return value.to(tree.dtype)
        return type(tree)(value.item())
    if isinstance(tree, Mapping):
        return {k: unflatten_like(v, flat, f"{prefix}.{k}" if prefix else str(k)) for k, v in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(unflatten_like(v, flat, f"{prefix}.{i}" if prefix else str(i)) for i, v in enumerate(tree))
    return tree
