"""Adapter: the batched environment as a Stable-Baselines3 ``VecEnv``, without one process or object per episode."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from magenv.episodes import Episodes, Settings, check_action

EPISODE_KEYS = ("position_error_m", "heading_error_rad")
"""Means over each episode that its last info carries beside ``is_success``."""


class TwoRobotsVecEnv(VecEnv):
    """``n`` environments with the given settings, reset in the same step, as Stable-Baselines3 wants.

    The info of an episode's last step holds ``terminal_observation``, ``TimeLimit.truncated``, ``is_success``,
    ``episode`` (return, length) as ``VecMonitor`` would give it, and the episode's mean errors.
    """

    render_mode: str | None = None

    def __init__(self, n: int, settings: Settings, seed: int) -> None:
        self._episodes = Episodes(n, settings)
        self.layout = self._episodes.layout
        super().__init__(n, self._episodes.observation_space, self._episodes.action_space)
        self.seed(seed)
        self._all = np.ones(n, np.bool_)
        self._actions: NDArray[np.float32] = np.zeros((n, 0), np.float32)
        self._sums = np.zeros((len(EPISODE_KEYS) + 1, n))  # of the errors, then of the reward
        self._lengths = np.zeros(n, np.int64)

    def reset(self) -> NDArray[np.float32]:
        """Begin all episodes; after ``seed`` from there, else further along the same random streams."""
        for row, seed in enumerate(self._seeds):
            if seed is not None:
                self._episodes.seed(row, seeding.np_random(seed)[0])
        self._reset_seeds()
        self._forget(self._all)
        return self._episodes.start(self._all)

    def _forget(self, mask: NDArray[np.bool_]) -> None:
        """Begin sums of new episodes where ``mask`` says."""
        self._sums[:, mask] = 0.0
        self._lengths[mask] = 0

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all episodes."""
        episodes = self._episodes
        actions = check_action(self._actions, (self.num_envs, episodes.actions.size))
        observations = episodes.step(actions, self._all)
        rewards, terminated, truncated = episodes.outcome()
        measured = episodes.world.measurements
        for sums, values in zip(self._sums, (*(getattr(measured, key) for key in EPISODE_KEYS), rewards), strict=True):
            sums += values
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        dones = terminated | truncated
        if dones.any():
            rows = np.flatnonzero(dones)
            lengths, sums = self._lengths[rows], self._sums[:, rows]
            means = (sums[:-1] / lengths).T.tolist()
            ends = (observations[rows], truncated[rows].tolist(), sums[-1].tolist(), lengths.tolist(), means)
            position, heading = EPISODE_KEYS
            for row, last, kept, total, length, errors in zip(rows.tolist(), *ends, strict=True):
                infos[row] = {
                    "terminal_observation": last,
                    "TimeLimit.truncated": kept,
                    "is_success": kept,
                    "episode": {"r": total, "l": length, "t": 0.0},
                    position: errors[0],
                    heading: errors[1],
                }
            self._forget(dones)
            episodes.start(dones, observations)
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Do nothing: there is nothing to close."""

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of this adapter once per index."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

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
