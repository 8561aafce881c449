"""PPO's collection of rollouts through our adapter, against ``DummyVecEnv`` and against an environment for nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

import agents
from agents.networks import load_weights, policy_kwargs
from agents.sb3_vec import TwoRobotsVecEnv
from agents.store import load_card, load_policy
from benchmarks.measure import Contestant, Effort, side_by_side
from benchmarks.table import Limit, Line, Row
from magenv import ENV_ID
from magenv.episodes import Settings

TITLE = "Rollouts of Stable-Baselines3"

DATA = Path(agents.__file__).parent / "data"
POSES, VELOCITIES = DATA / "home-ppo", DATA / "ppo"
"""Shipped agents: the actions of one are poses, those of the other velocities, for which each step seeks the poses."""


class Free(VecEnv):
    """Costs nothing: the same arrays at every step, in the spaces of the environment it stands for."""

    def __init__(self, like: VecEnv) -> None:
        super().__init__(like.num_envs, like.observation_space, like.action_space)
        assert like.observation_space.shape is not None
        self._observations = np.zeros((like.num_envs, *like.observation_space.shape), np.float32)
        self._rewards, self._dones = np.zeros(like.num_envs, np.float32), np.zeros(like.num_envs, np.bool_)
        self._infos: list[dict[str, Any]] = [{} for _ in range(like.num_envs)]

    def reset(self) -> NDArray[np.float32]:
        """Return the observations."""
        return self._observations

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Do nothing."""

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Return what is always returned."""
        return self._observations, self._rewards, self._dones, self._infos

    def close(self) -> None:
        """Do nothing."""

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return None per environment."""
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Refuse."""
        raise NotImplementedError

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refuse."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: type[Any], indices: int | Iterable[int] | None = None) -> list[bool]:
        """Return False per environment."""
        return [False] * self.num_envs


def measure(effort: Effort) -> Iterator[Line]:
    """Measure all of this part."""
    poses, velocities = load_card(POSES).settings, load_card(VELOCITIES).settings
    yield from _collection("untrained policy, 2 Hz", Settings(), POSES, False, effort)
    yield from _collection("agent by poses, 2 Hz", poses, POSES, True, effort)
    yield from _collection("agent by poses, 4 Hz", replace(poses, control_hz=4.0), POSES, True, effort)  # as other rows
    yield from _collection("agent by velocities, 2 Hz", velocities, VELOCITIES, True, effort, limited=False)


def _collection(
    policy: str, settings: Settings, agent: Path, trained: bool, effort: Effort, limited: bool = True
) -> Iterator[Row]:
    n = effort.rollout_envs
    ours = TwoRobotsVecEnv(n, settings, seed=0)

    def one() -> gymnasium.Env[Any, Any]:
        return gymnasium.make(ENV_ID, disable_env_checker=True, **asdict(settings))

    makers: list[Callable[[], gymnasium.Env[Any, Any]]] = [one] * n
    envs: dict[str, VecEnv] = {"ours": ours, "DummyVecEnv": DummyVecEnv(makers), "an env for nothing": Free(ours)}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        collectors = {name: Collector(env, agent, trained, effort.rollout_steps) for name, env in envs.items()}
        work = n * effort.rollout_steps
        times = side_by_side({name: Contestant(c.run, work) for name, c in collectors.items()}, effort.repeats)
    finally:
        torch.set_num_threads(threads)
        for env in envs.values():
            env.close()
    took, free = (1e6 * n * times.seconds(name) for name in ("ours", "an env for nothing"))
    resets = collectors["ours"].resets_per_step()
    note = f"per step {resets:.2g} resets; a step of all envs takes {took:.0f} µs, without an env {free:.0f} µs"
    note += (
        f": 0.85 x leaves the env {free / 0.85 - free:.0f} µs" if limited else "; each of ours seeks the EPMs' poses"
    )
    what = f"PPO.collect_rollouts, {n} envs, {policy}"
    for peer, limit in (("DummyVecEnv", 1.8), ("an env for nothing", 0.85)):
        ratio = times.speedup("ours", peer)
        wanted = Limit(limit) if limited else None
        yield Row(what, times.rate("ours"), "steps/s", peer, times.rate(peer), ratio, wanted, note)


class Collector:
    """A PPO that collects rollouts and never learns; a trained one with its observations normalised, as trained."""

    def __init__(self, env: VecEnv, agent: Path, trained: bool, steps: int) -> None:
        batch = env.num_envs * steps
        card, (weights, normalisation) = load_card(agent), load_policy(agent)
        if trained:
            env = VecNormalize(env, training=False, norm_reward=False, clip_obs=card.clip_observation)
            statistics: Any = env.obs_rms
            statistics.mean, statistics.var = normalisation.mean, normalisation.variance
        kwargs = policy_kwargs(card.net, card.activation)
        self._model = PPO("MlpPolicy", env, n_steps=steps, batch_size=batch, seed=0, policy_kwargs=kwargs, device="cpu")
        if trained:
            load_weights(self._model.policy, weights)
        self._steps = steps
        _, self._callback = self._model._setup_learn(batch)

    def run(self) -> None:
        """Collect."""
        env = self._model.env
        assert env is not None
        self._model.collect_rollouts(env, self._callback, self._model.rollout_buffer, self._steps)

    def resets_per_step(self) -> float:
        """Return the share of the last rollout's steps that began an episode."""
        return float(self._model.rollout_buffer.episode_starts.mean())
