"""Training: build an agent, train it, keep checkpoints, go on from one.

A run's folder holds ``progress.csv`` (and TensorBoard events where it is installed), ``checkpoints/step-...`` (the
last two) and, at the end, ``model``.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import shutil
import sys
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat, Logger, configure
from stable_baselines3.common.vec_env import VecNormalize

from agents.configs import PPOConfig, SACConfig, TrainConfig
from agents.learned import CLIP_OBSERVATION, load_weights, policy_kwargs
from agents.records import check_output_dir
from agents.sb3_vec import TwoRobotsVecEnv
from agents.store import (
    Card,
    Normalisation,
    check_replaceable,
    flatten,
    load_card,
    load_policy,
    load_training,
    save,
    unflatten_like,
)
from magenv.params import require

KEPT_CHECKPOINTS = 2
_RECENT_EPISODES = 200
_OPTIMISERS = {"ppo": ("policy.optimizer",), "sac": ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer")}


def _falling(start: float) -> Any:
    """Return a learning rate that falls linearly from ``start`` to a tenth."""
    return lambda remaining: start * (0.1 + 0.9 * max(remaining, 0.0))  # whole rollouts may end beyond the plan


def build(config: TrainConfig) -> tuple[BaseAlgorithm, VecNormalize]:
    """Return the untrained agent and its normalised environments."""
    own = config.ppo if config.algo == "ppo" else config.sac
    env = VecNormalize(
        TwoRobotsVecEnv(own.n_envs, config.settings, config.seed), norm_reward=False, clip_obs=CLIP_OBSERVATION
    )
    kwargs = policy_kwargs(config.algo, own.net)
    if isinstance(own, PPOConfig):
        kwargs["log_std_init"] = own.log_std_init
        return PPO(
            "MlpPolicy",
            env,
            n_steps=own.n_steps,
            batch_size=own.batch_size,
            n_epochs=own.n_epochs,
            gamma=own.gamma,
            gae_lambda=own.gae_lambda,
            learning_rate=_falling(own.learning_rate),
            seed=config.seed,
            policy_kwargs=kwargs,
            device="cpu",
        ), env
    return SAC(
        "MlpPolicy",
        env,
        batch_size=own.batch_size,
        buffer_size=own.buffer_size,
        learning_starts=own.learning_starts,
        train_freq=1,
        gradient_steps=own.gradient_steps,
        gamma=own.gamma,
        learning_rate=_falling(own.learning_rate),
        seed=config.seed,
        policy_kwargs=kwargs,
        device="cpu",
    ), env


def _training_state(model: BaseAlgorithm, algo: str) -> dict[str, Any]:
    """Return all that a continued training needs beside the policy, as nested dictionaries."""
    state: dict[str, Any] = {name: _attribute(model, name).state_dict() for name in _OPTIMISERS[algo]}
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
    folder: Path, model: BaseAlgorithm, env: VecNormalize, config: TrainConfig, with_training: bool, command: str
) -> None:
    """Write the agent as it is now (see ``agents.store``), with its optimisers where asked."""
    own = config.ppo if config.algo == "ppo" else config.sac
    card = Card.of(config.algo, own.net, config.settings, model.num_timesteps, config)
    statistics: Any = env.obs_rms
    training = flatten(_training_state(model, config.algo)) if with_training else None
    save(
        folder,
        dataclasses.replace(card, command=command),
        model.policy.state_dict(),
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
    statistics: Any = env.obs_rms
    shape = statistics.mean.shape
    require(normalisation.mean.shape == shape, "checkpoint", f"statistics of shape {shape}", normalisation.mean.shape)
    statistics.mean, statistics.var = normalisation.mean, normalisation.variance
    statistics.count = normalisation.count
    model.num_timesteps = load_card(folder).steps


def _optimiser_state(optimiser: torch.optim.Optimizer, stored: dict[str, torch.Tensor]) -> dict[str, Any]:
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
            state.setdefault(int(part[1]), {})[part[2]] = value
    return {"state": state, "param_groups": groups}


def checkpoints(run: Path) -> list[Path]:
    """Return the run's checkpoints, oldest first."""
    return sorted(path for path in (Path(run) / "checkpoints").glob("step-*") if path.name[5:].isdigit())


def resumed(config: TrainConfig) -> tuple[TrainConfig, Path]:
    """Return the configuration of the run to go on with, new steps and folder put in, and its last checkpoint."""
    assert config.resume is not None
    found = checkpoints(config.resume)
    require(bool(found), "resume", "a run's folder with checkpoints", str(config.resume))
    card = load_card(found[-1])
    raw = dict(card.config)
    try:
        raw["ppo"], raw["sac"] = (
            cls(**(raw[key] | {"net": tuple(raw[key]["net"])})) for key, cls in (("ppo", PPOConfig), ("sac", SACConfig))
        )
        raw |= {"out": config.folder, "resume": config.resume, "steps": config.steps or raw["steps"]}
        old = TrainConfig(**raw)
    except (KeyError, TypeError) as error:
        raise ValueError(
            f"Input resume must be a run of this version; instead received {found[-1]} ({error})."
        ) from error
    require(old.total_steps > card.steps, "steps", f"more than the {card.steps} already trained", old.total_steps)
    return old, found[-1]


class _Progress(BaseCallback):
    """Progress bar with time left, training statistics, checkpoints."""

    def __init__(self, model: BaseAlgorithm, config: TrainConfig, env: VecNormalize, command: str) -> None:
        super().__init__()
        self.model = model
        self._config, self._env, self._command = config, env, command
        self._episodes: deque[dict[str, Any]] = deque(maxlen=_RECENT_EPISODES)
        self._next_checkpoint = 0
        same = config.resume is not None and config.resume.resolve() == config.folder.resolve()
        self._kept = checkpoints(config.folder) if same else []
        self._bar = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[told]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=Console(file=sys.stderr),
            refresh_per_second=2,
        )

    def _on_training_start(self) -> None:
        every = self._config.checkpoint_every
        self._next_checkpoint = (self.num_timesteps // every + 1) * every
        self._bar.start()
        self._task = self._bar.add_task(self._config.algo, total=self._config.total_steps, told="")

    def _on_step(self) -> bool:
        self._episodes.extend(info for info in self.locals["infos"] if "is_success" in info)
        self._bar.update(self._task, completed=self.num_timesteps, told=self._record())
        if self.num_timesteps >= self._next_checkpoint:
            self._next_checkpoint += self._config.checkpoint_every
            self.checkpoint()
        return True

    def _record(self) -> str:
        """Log the means of the last episodes, and return them for the bar."""
        if not self._episodes:
            return ""
        keys = ("is_success", "position_error_m", "heading_error_rad")
        success, position, heading = (float(np.mean([episode[key] for episode in self._episodes])) for key in keys)
        self.logger.record("episodes/success_rate", success)
        self.logger.record("episodes/position_error_mm", 1e3 * position)
        self.logger.record("episodes/heading_error_deg", math.degrees(heading))
        return f"success {success:.0%}  {1e3 * position:.1f} mm  {math.degrees(heading):.1f} deg"

    def _on_training_end(self) -> None:
        self._bar.stop()

    def checkpoint(self) -> None:
        """Write a checkpoint; drop all but this run's last two."""
        folder = self._config.folder / "checkpoints" / f"step-{self.num_timesteps:012d}"
        save_model(folder, self.model, self._env, self._config, True, self._command)
        self._kept = [*(kept for kept in self._kept if kept != folder), folder][-KEPT_CHECKPOINTS:]
        for other in folder.parent.iterdir():  # of this run, of an older one in its place, or half written
            if other.name.startswith("step-") and other not in self._kept:
                shutil.rmtree(other)

    def close(self) -> None:
        """Stop drawing the bar, tell the logs where the training ended."""
        self._bar.stop()
        self._record()
        self.logger.record("time/total_timesteps", self.model.num_timesteps)
        self.logger.dump(self.model.num_timesteps)
        self.logger.close()


def train(config: TrainConfig, command: str = "") -> tuple[Path, bool]:
    """Train as configured; return the model's folder and whether the training ran to its end.

    Ctrl-C ends it early: model and checkpoint are written all the same, unless nothing was learned yet.

    Raises
    ------
    ValueError
        If the configuration, or the run to go on with, is unsound.
    KeyboardInterrupt
        If Ctrl-C came before the first step.
    """
    torch.set_num_threads(1)  # two threads on two cores spin: ten times slower
    start: Path | None = None
    if config.resume is not None:
        config, start = resumed(config)
    model, env = build(config)
    if start is not None:
        restore(start, model, env, config.algo)
        # Not the first run's episodes again.
        env.seed(int(np.random.SeedSequence([config.seed, model.num_timesteps]).generate_state(1)[0]))
        if isinstance(model, SAC):  # the replay buffer is not stored: fill it first
            model.learning_starts += model.num_timesteps
    folder = config.folder / "model"
    check_output_dir(config.folder)
    check_replaceable(folder)
    begun, finished = model.num_timesteps, True
    model.set_logger(_logger(config))
    progress = _Progress(model, config, env, command)
    try:
        interval = 1 if config.algo == "ppo" else 50
        model.learn(config.total_steps - begun, progress, reset_num_timesteps=False, log_interval=interval)
    except KeyboardInterrupt:
        finished = False
        if model.num_timesteps == begun:
            raise
    finally:
        progress.close()
        env.close()
    progress.checkpoint()
    save_model(folder, model, env, config, False, command)
    return folder, finished


def _logger(config: TrainConfig) -> Logger:
    """Return the logger of a run; what stood in the progress.csv of the run gone on with stands first in its own."""
    past = config.resume / "progress.csv" if config.resume is not None else None
    rows: list[dict[str, Any]] = []
    if past is not None and past.is_file():
        with past.open(newline="") as file:
            rows = [{key: _number(value) for key, value in row.items() if value} for row in csv.DictReader(file)]
    logger = configure(str(config.folder), _log_formats())
    for output in logger.output_formats:
        if isinstance(output, CSVOutputFormat):
            for row in rows:
                output.write(row, dict.fromkeys(row, ()))
    return logger


def _number(text: str) -> str | float | int:
    """Return a number where the text is one, as it was written."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _log_formats() -> list[str]:
    try:
        import torch.utils.tensorboard  # noqa: F401
    except ImportError:
        return ["csv"]
    return ["csv", "tensorboard"]
