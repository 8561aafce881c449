"""Adapter: the batched environment as a Stable-Baselines3 ``VecEnv``, without one process or object per episode."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from magenv.episodes import Settings
from magenv.vector_env import TwoRobotsVector

EPISODE_KEYS = ("position_error_m", "heading_error_rad")
"""Means over each episode that its last info carries beside ``is_success``."""


class TwoRobotsVecEnv(VecEnv):
    """``n`` environments with the given settings, reset in the same step, as Stable-Baselines3 wants.

    The info of an episode's last step holds ``terminal_observation``, ``TimeLimit.truncated``, ``is_success``,
    ``episode`` (return, length) as ``VecMonitor`` would give it, and the episode's mean errors.
    """

    def __init__(self, n: int, settings: Settings, seed: int) -> None:
        self._env = TwoRobotsVector(n, **vars(settings), autoreset_mode=AutoresetMode.SAME_STEP)
        super().__init__(n, self._env.single_observation_space, self._env.single_action_space)
        self.seed(seed)
        self._actions: NDArray[np.float32] = np.zeros((n, 0), np.float32)
        self._sums = {key: np.zeros(n) for key in (*EPISODE_KEYS, "reward")}
        self._lengths = np.zeros(n, np.int64)

    def reset(self) -> NDArray[np.float32]:
        """Begin all episodes; after ``seed`` from there, else further along the same random streams."""
        observations, _ = self._env.reset(seed=list(self._seeds))
        self._reset_seeds()
        for total in self._sums.values():
            total[:] = 0.0
        self._lengths[:] = 0
        return observations

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all episodes."""
        observations, rewards, terminated, truncated, info = self._env.step(self._actions)
        dones = terminated | truncated
        for key in EPISODE_KEYS:
            self._sums[key] += info[key]
        self._sums["reward"] += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(dones):
            length = int(self._lengths[row])
            infos[row] = {
                "terminal_observation": info["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row]),
                "is_success": bool(truncated[row]),
                "episode": {"r": float(self._sums["reward"][row]), "l": length, "t": 0.0},
            }
            for key in EPISODE_KEYS:
                infos[row][key] = float(self._sums[key][row] / length)
            for total in self._sums.values():
                total[row] = 0.0
            self._lengths[row] = 0
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Close the batched environment."""
        self._env.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of the batched environment once per index."""
        return [getattr(self._env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Refuse: the episodes share one environment."""
        raise NotImplementedError("The episodes of a batched environment share their attributes.")

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refuse: the episodes share one environment."""
        raise NotImplementedError("The episodes of a batched environment have no methods of their own.")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: int | Iterable[int] | None = None) -> list[bool]:
        """Return False per index: nothing is wrapped."""
        return [False] * len(list(self._get_indices(indices)))
