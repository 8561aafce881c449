"""A training on disk: checkpoints written, found, and put back into an agent; the configuration to go on with."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from agents.configs import CloningConfig, PPOConfig, SACConfig, TrainConfig
from agents.evaluation import Score
from agents.networks import flatten, load_weights, unflatten_like
from agents.store import (
    CARD,
    Card,
    Normalisation,
    check_replaceable,
    load_card,
    load_policy,
    load_training,
    recover,
    save,
)
from magenv.params import InputError, require

_AVERAGES = {"step", "exp_avg", "exp_avg_sq"}
"""What Adam keeps of each parameter, from its first step on."""
_OPTIMISERS = {"ppo": ("policy.optimizer",), "sac": ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer")}

MODEL, BEST = "model", "best"
"""Folders in that of a run: the last policy, and the best on the held-out episodes."""

GOING_ON = ("steps", "out", "resume", "checkpoint_every")
"""What may be changed when a run is gone on with."""


def _training_state(model: BaseAlgorithm, algo: str) -> dict[str, Any]:
    """Return all that a continued training needs beside the policy, as nested dictionaries."""
    state: dict[str, Any] = {name: _attribute(model, name).state_dict() for name in _OPTIMISERS[algo]}
    state["updates"] = _attribute(model, "_n_updates")
    if isinstance(model, SAC):
        assert model.log_ent_coef is not None
        state["log_ent_coef"] = model.log_ent_coef
    return state


def _attribute(model: BaseAlgorithm, path: str) -> Any:
    value: Any = model
    for name in path.split("."):
        value = getattr(value, name)
    return value


def save_model(
    folder: Path,
    model: BaseAlgorithm,
    env: VecNormalize,
    config: TrainConfig,
    with_training: bool,
    command: str,
    score: Score | None = None,
) -> None:
    """Write the agent as it is now (see ``agents.store``), with its optimisers where asked."""
    statistics: Any = env.obs_rms
    training = flatten(_training_state(model, config.algo)) if with_training else None
    save(
        folder,
        Card.of(config, model.num_timesteps, command, score),
        flatten(dict(model.policy.state_dict())),
        Normalisation(statistics.mean, statistics.var, statistics.count),
        training,
    )


def restore(folder: Path, model: BaseAlgorithm, env: VecNormalize, algo: str) -> None:
    """Put a checkpoint's weights, optimisers, statistics and step count into a model built from its configuration.

    Raises
    ------
    ValueError
        If they do not fit the model.
    """
    weights, normalisation = load_policy(folder)
    load_weights(model.policy, weights)
    flat = load_training(folder)
    for name in _OPTIMISERS[algo]:
        optimiser = _attribute(model, name)
        stored = {key.removeprefix(f"{name}."): value for key, value in flat.items() if key.startswith(f"{name}.")}
        optimiser.load_state_dict(_optimiser_state(optimiser, stored))
    if isinstance(model, SAC):
        assert model.log_ent_coef is not None
        model.log_ent_coef.data.copy_(unflatten_like(model.log_ent_coef, flat, "log_ent_coef"))
    model._n_updates = unflatten_like(0, flat, "updates")
    statistics: Any = env.obs_rms
    shape = statistics.mean.shape
    require(normalisation.mean.shape == shape, "checkpoint", f"statistics of shape {shape}", normalisation.mean.shape)
    statistics.mean, statistics.var = normalisation.mean, normalisation.variance
    statistics.count = normalisation.count
    model.num_timesteps = load_card(folder).steps


def _optimiser_state(optimiser: torch.optim.Optimizer, stored: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Return an optimiser's state dictionary from its flattened form, checked against the parameters it is for."""
    groups = unflatten_like(optimiser.state_dict()["param_groups"], stored, "param_groups")
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in stored.items():
        part = key.split(".")
        if part[0] == "state":
            known = len(part) == 3 and part[1].isdigit() and int(part[1]) < len(parameters)
            require(known, "checkpoint", "of optimisers of this model", key)
            shape = parameters[int(part[1])].shape if part[2] != "step" else torch.Size()
            require(value.shape == shape, f"checkpoint's {key}", f"of shape {tuple(shape)}", tuple(value.shape))
            state.setdefault(int(part[1]), {})[part[2]] = torch.from_numpy(value)
    learned = {number for number, parameter in enumerate(parameters) if parameter.requires_grad}
    whole = set(state) in (set(), learned) and all(set(kept) == _AVERAGES for kept in state.values())
    require(whole, "checkpoint", "with whole optimisers, of all that is learned", f"those of {len(state)} parameters")
    return {"state": state, "param_groups": groups}


def checkpoints(run: Path) -> list[Path]:
    """Return the run's checkpoints, oldest first."""
    return sorted(path for path in (Path(run) / "checkpoints").glob("step-*") if path.name[5:].isdigit())


def is_run(folder: Path) -> bool:
    """Return whether a folder holds a run: one that has come to its first checkpoint."""
    return bool(checkpoints(folder)) or (folder / MODEL).exists()


def best_so_far(config: TrainConfig) -> Score | None:
    """Return the score of the run's best model so far, which stands in the run's folder from now on; None without one.

    That of a run gone on with elsewhere is copied. What stands in a new run's folder was left by one that was killed
    before its first checkpoint, and is dropped.
    """
    best, resume = config.folder / BEST, config.resume
    recover(best)
    check_replaceable(best)
    if resume is None or resume.resolve() != config.folder.resolve():
        if best.exists():
            shutil.rmtree(best)
        if resume is not None and (resume / BEST / CARD).is_file():
            save(best, load_card(resume / BEST), *load_policy(resume / BEST))
    return load_card(best).score if best.exists() else None


def stored_config(run: Path) -> TrainConfig:
    """Return the configuration with which to go on with a run: its own, ``resume`` set, in the same folder.

    Raises
    ------
    InputError
        If the folder holds no run of this version.
    """
    found = checkpoints(run)
    require(bool(found), "resume", "a run's folder with checkpoints", str(run))
    raw = dict(load_card(found[-1]).config)
    try:
        raw["ppo"], raw["sac"] = (
            cls(**(raw[key] | {"net": tuple(raw[key]["net"])})) for key, cls in (("ppo", PPOConfig), ("sac", SACConfig))
        )
        raw["cloning"] = CloningConfig(**raw["cloning"])
        return TrainConfig(**(raw | {"out": None, "resume": run}))
    except (KeyError, TypeError) as error:
        raise InputError(
            f"Input resume must be a run of this version; instead received {found[-1]} ({error})."
        ) from error


def check_goes_on(config: TrainConfig) -> Path:
    """Return the checkpoint to go on from.

    Raises
    ------
    InputError
        If the configuration differs from the run's own in more than ``GOING_ON`` may change, or asks for no more steps.
    """
    assert config.resume is not None
    own, last = stored_config(config.resume), checkpoints(config.resume)[-1]
    for field in dataclasses.fields(TrainConfig):
        before, now = getattr(own, field.name), getattr(config.resolved, field.name)
        same = field.name in GOING_ON or now == before
        require(same, field.name, f"{before!r}, as in the run gone on with", now)
    done = load_card(last).steps
    require(config.total_steps > done, "steps", f"more than the {done} already trained", config.total_steps)
    return last
