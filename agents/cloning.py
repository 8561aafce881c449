"""Cloning a controller: the policy is fitted to what the controller would do in the states that the policy comes to.

Dataset aggregation (Ross, Gordon and Bagnell, "A reduction of imitation learning and structured prediction to
no-regret online learning", AISTATS 2011). The value function is fitted to the returns meanwhile: learning by reward,
which follows, would not keep what was cloned if its critic knew nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.vec_env import VecNormalize

from agents.configs import TrainConfig
from agents.residual import seen_by, teacher
from agents.rollout import controller_seed
from magenv.files import write_file
from magenv.params import InputError, is_whole, require

ANSWERS = "answers.safetensors"
"""What the controller has answered, in the run's folder: a run that is gone on with needs not ask again."""
_SHARING = 2
"""Stream of the random numbers that share the episodes out."""

Floats = NDArray[np.float32]


@dataclass
class Answers:
    """Of the rounds done."""

    observations: Floats
    """(m, d) as the environment tells them."""
    actions: Floats
    """(m, a) of the controller."""
    rounds: int = 0

    @classmethod
    def none(cls, observations: int, actions: int) -> Answers:
        """Return those of no round, of so many numbers each."""
        return cls(np.empty((0, observations), np.float32), np.empty((0, actions), np.float32))

    def save(self, folder: Path) -> None:
        """Write them into a run's folder."""
        rounds = np.array([self.rounds])
        arrays = {"observations": self.observations, "actions": self.actions, "rounds": rounds}
        write_file(folder / ANSWERS, save(arrays))

    @classmethod
    def load(cls, folder: Path, observations: int, actions: int) -> Answers:
        """Return those of a run's folder, of so many numbers each.

        Raises
        ------
        InputError
            If there are none, or they are damaged, or of another environment.
        """
        try:
            found = load_file(folder / ANSWERS)
            told = cls(found["observations"], found["actions"], found["rounds"].item())
        except (OSError, SafetensorError, KeyError, ValueError) as error:
            raise InputError(f"Input resume must be a run with sound {ANSWERS}; instead received {error}.") from error
        arrays = (told.observations, told.actions)
        shapes, m = tuple(array.shape for array in arrays), told.actions.shape[:1]
        fits = len(m) == 1 and shapes == ((*m, observations), (*m, actions))
        require(fits, ANSWERS, f"of shapes (m, {observations}) and (m, {actions})", shapes)
        sound = all(array.dtype == np.float32 and bool(np.isfinite(array).all()) for array in arrays)
        require(sound, ANSWERS, "of finite numbers in single precision", [str(array.dtype) for array in arrays])
        counted = is_whole(told.rounds) and told.rounds >= 0 and (told.rounds > 0) == (m > (0,))
        require(counted, ANSWERS, "of whole rounds", told.rounds)
        return told

    def add(self, observations: list[Floats], actions: list[Floats]) -> None:
        """Add those of a further round, (n, d) and (n, a) of each step."""
        self.observations = np.concatenate([self.observations, *observations])
        self.actions = np.concatenate([self.actions, *actions])
        self.rounds += 1


def clone(
    config: TrainConfig, model: PPO, env: VecNormalize, callbacks: CallbackList, keep: Callable[[], None]
) -> None:
    """Fit the policy to the controller, in as many rounds as the run lacks; its steps are counted as training.

    Parameters
    ----------
    config : TrainConfig
        Names the controller.
    model : PPO
        Whose policy and value function are fitted.
    env : VecNormalize
        The environments of the training.
    callbacks : CallbackList
        Are told every step, as in training.
    keep : callable
        Writes a checkpoint, after each round: no policy is gone on with that was not fitted to all answers kept.

    Raises
    ------
    InputError
        If the answers of a run gone on with are missing or damaged.
    """
    assert config.expert is not None
    expert = teacher(config.expert, config.settings, "cloned")
    sizes = [int(np.prod(space.shape or ())) for space in (env.observation_space, env.action_space)]
    answers = Answers.none(*sizes) if config.resume is None else Answers.load(config.resume, *sizes)
    answers.save(config.folder)  # those of a run gone on with elsewhere; none in the place of what a killed run left
    todo = range(answers.rounds, config.cloning.rounds)
    if not todo:
        return
    sharing = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(_SHARING, answers.rounds)))
    expert.seed(controller_seed(config.seed))
    optimiser = torch.optim.Adam(model.policy.parameters())
    callbacks.init_callback(model)
    callbacks.on_training_start({}, {})
    begun = time.monotonic()
    normalised: Any = env.reset()
    starts, state = np.ones(env.num_envs, np.bool_), None
    for number in todo:
        share = 1.0 - number / config.cloning.led if number < config.cloning.led else 0.0
        led = sharing.random(env.num_envs) < share
        observations, actions, rewards, dones = [], [], [], []
        for _ in range(config.cloning.steps):
            told: Any = env.get_original_obs()
            answer, state = expert.predict(seen_by(expert, told), state, starts, deterministic=True)
            own, _ = model.predict(normalised, deterministic=False)
            normalised, _, starts, infos = env.step(np.where(led[:, None], answer, own))
            observations.append(told)
            actions.append(answer)
            rewards.append(env.get_original_reward())
            dones.append(starts)
            model.num_timesteps += env.num_envs
            callbacks.update_locals({"infos": infos})
            callbacks.on_step()
        answers.add(observations, actions)
        returns = _returns(model, np.array(rewards), np.array(dones), normalised)
        for group in optimiser.param_groups:
            group["lr"] = config.cloning.learning_rate * (1.0 - 0.9 * number / config.cloning.rounds)
        losses = _fit(config, model, env, optimiser, answers, np.concatenate(observations), returns)
        for name, loss in zip(("clone_loss", "value_loss"), losses, strict=True):
            model.logger.record(f"train/{name}", loss)
        keep()
        answers.save(config.folder)
        model.logger.record("time/time_elapsed", time.monotonic() - begun)
        model.logger.record("time/total_timesteps", model.num_timesteps)
        model.logger.dump(model.num_timesteps)


def _returns(model: PPO, rewards: Floats, dones: NDArray[np.bool_], last: Any) -> Floats:
    """Return the discounted returns (T, n) of a round, at its end those that the value function foretells.

    Nothing is reckoned with beyond an episode's end, a time limit included: learning by reward mends what that leaves
    out of the last steps.
    """
    with torch.no_grad():
        after = model.policy.predict_values(torch.from_numpy(last)).numpy()[:, 0]
    returns = np.empty(rewards.shape, np.float32)
    for t in reversed(range(len(rewards))):
        after = rewards[t] + model.gamma * np.where(dones[t], 0.0, after)
        returns[t] = after
    return returns


def _fit(
    config: TrainConfig,
    model: PPO,
    env: VecNormalize,
    optimiser: Any,
    answers: Answers,
    recent: Floats,
    returns: Floats,
) -> tuple[float, float]:
    """Fit the mode to all answers and the values to the returns of the recent observations; return the last losses."""
    policy, sizes = model.policy, config.cloning
    seen, valued = (
        torch.from_numpy(env.normalize_obs(observations)) for observations in (answers.observations, recent)
    )
    wanted, worth = torch.from_numpy(answers.actions), torch.from_numpy(returns.reshape(-1))
    cloned: Any = torch.zeros(())
    missed: Any = torch.zeros(())
    policy.set_training_mode(True)
    for _ in range(sizes.epochs):
        order: Any = torch.randperm(len(seen))
        for rows in order.split(sizes.batch_size):
            some = torch.randint(len(valued), (len(rows),))
            cloned = torch.nn.functional.mse_loss(policy.get_distribution(seen[rows]).mode(), wanted[rows])
            missed = torch.nn.functional.mse_loss(policy.predict_values(valued[some])[:, 0], worth[some])
            optimiser.zero_grad()
            (cloned + missed).backward()
            optimiser.step()
    policy.set_training_mode(False)
    return cloned.item(), missed.item()
