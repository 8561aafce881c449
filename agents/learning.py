"""Training: build an agent, train it, go on from a checkpoint.

A run's folder holds ``progress.csv`` (and TensorBoard events where it is installed), ``checkpoints/step-...`` (the
last two), ``best`` (the policy that was best on held-out episodes) and, at the end, ``model`` (the last one).
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from agents.checkpoints import MODEL, check_goes_on, is_run, restore
from agents.cloning import clone
from agents.configs import PPOConfig, SACConfig, TrainConfig
from agents.curriculum import Curriculum
from agents.folders import lock_folder, new_folder
from agents.history_vec import HistoryVecEnv
from agents.keeper import Keeper, Watch
from agents.networks import policy_kwargs
from agents.progress import Reporter, logger
from agents.residual_vec import ResidualVecEnv
from agents.sb3_vec import TwoRobotsVecEnv
from agents.store import check_replaceable, recover
from magenv.params import InputError

DEFAULT_FOLDER = Path("runs/train")


def _falling(start: float) -> Any:
    """Return a learning rate that falls linearly from ``start`` to a tenth."""
    return lambda remaining: start * (0.1 + 0.9 * max(remaining, 0.0))  # whole rollouts may end beyond the plan


def build(config: TrainConfig) -> tuple[BaseAlgorithm, VecNormalize]:
    """Return the untrained agent and its normalised environments."""
    own = config.own
    robots: VecEnv = TwoRobotsVecEnv(own.n_envs, config.settings, config.seed)
    if config.correction is not None:
        robots = ResidualVecEnv(robots, config.correction.base(config.settings), config.correction.scale)
    if config.history > 1:
        robots = HistoryVecEnv(robots, config.history)
    env = VecNormalize(robots, norm_reward=False, clip_obs=config.clip_observation)
    kwargs = policy_kwargs(own.net, own.activation)
    if isinstance(own, PPOConfig):
        kwargs["log_std_init"] = own.log_std_init
        ppo = PPO(
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
        )
        assert isinstance(ppo.policy, ActorCriticPolicy)
        ppo.policy.log_std.requires_grad_(own.learn_std)
        return ppo, env
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


class _Refill(BaseCallback):
    """Hold back the gradient steps of a continued SAC, whose replay buffer is not stored, until it has refilled."""

    def __init__(self, config: SACConfig) -> None:
        super().__init__()
        self._config = config

    def _on_training_start(self) -> None:
        assert isinstance(self.model, SAC)
        self.model.gradient_steps = 0
        self._until = self.num_timesteps + self._config.learning_starts

    def _on_step(self) -> bool:
        assert isinstance(self.model, SAC)
        if self.num_timesteps >= self._until:
            self.model.gradient_steps = self._config.gradient_steps
        return True


def train(config: TrainConfig, command: str = "", watch: Watch | None = None) -> tuple[Path, bool]:
    """Train as configured; return the run's folder and whether the training ran to its end.

    Ctrl-C ends it early: model and checkpoint are written all the same, unless nothing was learned yet.

    Parameters
    ----------
    config : TrainConfig
        To go on with a run: ``agents.checkpoints.stored_config`` of its folder, with more steps.
    command : str
        Kept in the model's card.
    watch : callable, optional
        Is told the score on the held-out episodes at every checkpoint; what it raises ends the training.

    Raises
    ------
    InputError
        If the configuration, or the run to go on with, is unsound, ``out`` holds a run, or the run is in training.
    DivergedError
        If numbers are no longer finite; what was stored before stays.
    KeyboardInterrupt
        If Ctrl-C came before the first step.
    """
    torch.set_num_threads(1)  # two threads on two cores spin: ten times slower
    new = config.resume is None or config.folder.resolve() != config.resume.resolve()
    if config.resume is not None:
        check_goes_on(config)
    model, env = build(config)
    if new:
        must_be = "a folder without a run (to go on with one: resume)"
        folder, lock = new_folder(config.out, DEFAULT_FOLDER, is_run, must_be)
        config = dataclasses.replace(config, out=folder)
    else:
        held = lock_folder(config.folder)
        if held is None:
            raise InputError(f"Input resume must be a run at rest; instead received {config.resume}, in training now.")
        lock = held
    try:
        return config.folder, _learn(config, model, env, command, watch)
    finally:
        env.close()
        lock.release()


def _learn(config: TrainConfig, model: BaseAlgorithm, env: VecNormalize, command: str, watch: Watch | None) -> bool:
    """Train in the run's folder, which is ours alone; return whether the training ran to its end."""
    callbacks: list[BaseCallback] = []
    if config.resume is not None:
        restore(check_goes_on(config), model, env, config.algo)
        # Not the first run's episodes again.
        env.seed(int(np.random.SeedSequence([config.seed, model.num_timesteps]).generate_state(1)[0]))
        if isinstance(model, SAC):
            callbacks.append(_Refill(config.sac))
    if config.curriculum is not None:
        callbacks.append(Curriculum(config, env, model.num_timesteps))
    recover(config.folder / MODEL)
    check_replaceable(config.folder / MODEL)
    keeper = Keeper(model, config, env, command, watch)
    callbacks += [keeper, progress := Reporter(model, config, keeper)]
    begun, finished = model.num_timesteps, True
    model.set_logger(logger(config, begun))
    try:
        try:
            if config.expert is not None:
                assert isinstance(model, PPO)
                clone(config, model, env, CallbackList(callbacks), keeper.keep)
            interval = 1 if config.algo == "ppo" else 50
            model.learn(
                config.total_steps - model.num_timesteps, callbacks, reset_num_timesteps=False, log_interval=interval
            )
        except KeyboardInterrupt:
            finished = False
            if model.num_timesteps == begun:
                raise
        except ValueError as error:  # torch and the environment refuse what is not finite
            keeper.check()
            if str(error).startswith("Input action must be finite"):  # drawn by chance: the mode may be cut to bounds
                raise keeper.diverged("actions are not finite") from error
            raise
        keeper.finish()
    finally:
        progress.close()
    return finished
