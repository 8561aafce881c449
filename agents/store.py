"""Models on disk: a folder with a JSON card and safetensors weights. Nothing in it is ever unpickled or evaluated.

``card.json`` tells what the policy needs to be built and is bound to (algorithm, networks, environment, versions);
``policy.safetensors`` holds its weights and the observation statistics; ``training.safetensors``, beside them in
checkpoints, the optimisers. All are arrays here: a model is read and played without torch.
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
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from agents.configs import Activation, TrainConfig, check_activation, check_clip, check_net
from agents.evaluation import Score
from agents.history import check_history
from agents.residual import Correction
from magenv.episodes import Settings
from magenv.params import InputError, is_whole, require

FORMAT = "magenv model 1"
CARD, POLICY, TRAINING = "card.json", "policy.safetensors", "training.safetensors"
_PACKAGES = ("magenv", "numpy", "numba", "gymnasium", "stable-baselines3", "torch")
_MEAN, _VARIANCE, _COUNT = "observation.mean", "observation.variance", "observation.count"
_DTYPES = ("F32", "F64")
"""Of all that is stored."""

Arrays = dict[str, NDArray[Any]]


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
    activation: Activation
    """Of the hidden layers."""
    clip_observation: float
    """Standard deviations at which it sees observations cut."""
    command: str = ""
    """Command that made it."""
    score: Score | None = None
    """On the held-out episodes of its training; None where it was not judged, as before there were any."""
    residual: Correction | None = None
    """What the policy corrects; None where it acts by itself."""
    history: int = 1
    """How many of its episode's last observations it sees."""
    limits: str = ""
    """What it holds and what not, in words; of agents that ship."""

    @classmethod
    def of(cls, config: TrainConfig, steps: int, command: str = "", score: Score | None = None) -> Card:
        """Return the card of a model made now."""
        return cls(
            algo=config.algo,
            net=config.own.net,
            settings=config.settings,
            steps=steps,
            config=json.loads(json.dumps(dataclasses.asdict(config.resolved), default=str)),
            versions={name: version(name) for name in _PACKAGES},
            activation=config.own.activation,
            clip_observation=config.clip_observation,
            command=command,
            score=score,
            residual=config.correction,
            history=config.history,
        )


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
    policy: Mapping[str, NDArray[Any]],
    normalisation: Normalisation,
    training: Mapping[str, NDArray[Any]] | None = None,
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
    numbers = (normalisation.mean, normalisation.variance, *policy.values(), *(training or {}).values())
    if not all(bool(np.isfinite(value).all()) for value in numbers):
        raise NotFiniteError(f"Input model must be of finite numbers to be stored; instead received {str(folder)!r}.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{folder.name}.", dir=folder.parent) as scratch:
        new, old = Path(scratch) / "new", Path(scratch) / "old"
        new.mkdir()
        (new / CARD).write_text(json.dumps({"format": FORMAT} | dataclasses.asdict(card), indent=1) + "\n")
        arrays = {f"policy.{name}": value for name, value in policy.items()}
        arrays |= {_MEAN: normalisation.mean, _VARIANCE: normalisation.variance}
        save_file(arrays | {_COUNT: np.array([normalisation.count])}, new / POLICY)
        if training is not None:
            save_file(dict(training), new / TRAINING)
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
        If the folder holds no magenv model, the card is damaged or contradicts itself, or another major version of
        magenv made it; before the first one, another minor version.
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
        if raw.get("residual") is not None:
            raw["residual"] = Correction(**raw["residual"])
        card = Card(**raw)
    except (KeyError, TypeError) as error:
        raise InputError(f"Input model must have a whole card; instead received {path} ({error}).") from error
    check_net(card.net)
    check_activation(card.activation)
    check_clip(card.clip_observation)
    check_history(card.history)
    alone = card.residual is None
    require(alone or card.history == 1, "model's history", "1 where it corrects a controller", card.history)
    require(is_whole(card.steps) and card.steps >= 0, "model's steps", "a whole number of at least 0", card.steps)
    for name, value, kind in (
        ("algo", card.algo, str),
        ("config", card.config, dict),
        ("versions", card.versions, dict),
        ("command", card.command, str),
        ("limits", card.limits, str),
    ):
        require(isinstance(value, kind), f"model's {name}", f"of type {kind.__name__}", value)
    made, here = card.versions.get("magenv"), version("magenv")
    told = 2 if here.startswith("0.") else 1  # before the first major version, minor ones may break
    same = isinstance(made, str) and made.split(".")[:told] == here.split(".")[:told]
    require(same, "model", f"of magenv {'.'.join(here.split('.')[:told])}, as this one", made)
    _check_as_trained(card)
    return card


def _check_as_trained(card: Card) -> None:
    """Raise ``ValueError`` where a card tells of its training what it does not tell of the model.

    What has the same size would go unnoticed: a mode, a share.
    """
    own: Any = card.config.get(card.algo)
    require(isinstance(own, dict), "model's config", f"with the options of {card.algo}", own)
    correction = card.residual
    bound = dataclasses.asdict(card.settings) | {
        "algo": card.algo,
        "history": card.history,
        "clip_observation": card.clip_observation,
        "residual": None if correction is None else correction.controller,
    }
    if correction is not None:
        bound["residual_scale"] = correction.scale
    config = {"history": 1} | card.config  # there are models from before it could be more
    for told, values in ((config, bound), (own, {"net": list(card.net), "activation": card.activation})):
        for name, value in values.items():
            trained = told.get(name)
            require(trained == value, f"model's {name}", f"{trained!r}, as in its training", value)


def load_policy(folder: Path) -> tuple[Arrays, Normalisation]:
    """Read a model's weights and observation statistics.

    Raises
    ------
    ValueError
        If the file is missing, is not safetensors, or lacks the statistics.
    """
    arrays = _load(Path(folder) / POLICY)
    for name in (_MEAN, _VARIANCE, _COUNT):
        require(name in arrays, "model", f"weights with {name}", str(Path(folder) / POLICY))
    kinds = {name: np.float64 if name in (_MEAN, _VARIANCE, _COUNT) else np.float32 for name in arrays}
    fits = all(value.dtype == kinds[name] for name, value in arrays.items())
    require(fits, "model", "weights in float32 and statistics in float64", str(Path(folder) / POLICY))
    finite = all(bool(np.isfinite(value).all()) for value in arrays.values())
    require(finite, "model", "finite weights", str(Path(folder) / POLICY))
    mean, variance, count = (arrays.pop(name) for name in (_MEAN, _VARIANCE, _COUNT))
    sound = bool((variance >= 0).all()) and count.shape == (1,)
    require(sound, "model", "sound observation statistics", str(Path(folder) / POLICY))
    policy = {name.removeprefix("policy."): value for name, value in arrays.items()}
    return policy, Normalisation(mean, variance, float(count[0]))


def load_training(folder: Path) -> Arrays:
    """Read a checkpoint's optimisers; the errors are those of ``load_policy``."""
    return _load(Path(folder) / TRAINING)


def _load(path: Path) -> Arrays:
    require(path.is_file(), "model", f"a folder with {path.name}", str(path.parent))
    try:
        with safe_open(path, framework="np") as file:
            kinds = {name: file.get_slice(name).get_dtype() for name in file.keys()}  # noqa: SIM118 (no mapping)
            for kind in kinds.values():  # of others numpy may know nothing
                require(kind in _DTYPES, "model", f"safetensors of {' and '.join(_DTYPES)}", f"{path} with {kind}")
            return {name: file.get_tensor(name) for name in kinds}
    except (SafetensorError, OSError) as error:
        raise InputError(f"Input model must hold safetensors; instead received {path} ({error}).") from error
