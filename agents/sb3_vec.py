"""Adapter: the batched environment as a Stable-Baselines3 ``VecEnv``, without one process or object per episode."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from numba import typeof
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from agents.evaluation import threads_for
from magenv.episodes import Episodes, Settings, check_action
from magenv.kernels import kernel
from magenv.poses import LANES
from magenv.state import State
from magenv.steps import step_kernel
from magenv.workers import Workers
from magenv.world import Measurements

Floats = NDArray[np.float64]
Rewards = NDArray[np.float32]
Bools = NDArray[np.bool_]

EPISODE_KEYS = Measurements.NUMBERS[:2]
"""Means over each episode that its last info carries beside ``is_success``."""


@kernel
def add_rows(s: State, sums: Floats, ends: Floats, rewards: Rewards, dones: Bools) -> int:
    """Add a step to the sums (n, 4) of both errors, reward and length; return how many episodes ended.

    Their mean errors, return and length are written into the first rows of ``ends`` (n, 4), and their sums begin anew.
    One call: from Python a dozen operations on arrays so small took a third as long as the hold.
    """
    numbers, paid, ended, count = s.numbers, s.paid, s.ended, 0
    for i in range(len(dones)):
        rewards[i] = paid[2, i]
        dones[i] = ended[0, i] or ended[1, i]
        sums[i, 0] += numbers[0, i]
        sums[i, 1] += numbers[1, i]
        sums[i, 2] += paid[2, i]
        sums[i, 3] += 1.0
        if dones[i]:
            length = sums[i, 3]
            ends[count, 0], ends[count, 1] = sums[i, 0] / length, sums[i, 1] / length
            ends[count, 2], ends[count, 3] = sums[i, 2], length
            sums[i] = 0.0
            count += 1
    return count


def _types(*arguments: object) -> tuple[object, ...]:
    """Return numba's types of the arguments."""
    return tuple(typeof(argument) for argument in arguments)  # type: ignore[no-untyped-call]


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
        self._shape = (n, self._episodes.actions.size)
        self._actions: NDArray[np.float32] = np.zeros((n, 0), np.float32)
        self._sums, self._ends = np.zeros((n, 4)), np.zeros((n, 4))  # see ``add_rows``
        # Compiled for these types beforehand: numba need not look them up at each call.
        state, packed = self._episodes.state, self._episodes.packed
        step: Any = step_kernel(settings.action, *self._episodes.world.shape)
        add: Any = add_rows
        self._workers = Workers(threads_for(settings), LANES)
        self._step = step.compile(_types(0, n, self._all, self._sums, packed, state.observation))
        self._add = add.compile(_types(packed, self._sums, self._ends, state.bounds, self._all))

    def reset(self) -> NDArray[np.float32]:
        """Begin all episodes; after ``seed`` from there, else further along the same random streams."""
        for row, seed in enumerate(self._seeds):
            if seed is not None:
                self._episodes.seed(row, seeding.np_random(seed)[0])
        self._reset_seeds()
        self._sums[...] = 0.0
        return self._episodes.start(self._all)

    def set_nearest(self, nearest_m: float) -> None:
        """See ``Episodes.set_nearest``."""
        self._episodes.set_nearest(nearest_m)

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], Rewards, Bools, list[dict[str, Any]]]:
        """Step all episodes."""
        episodes, n = self._episodes, self.num_envs
        actions = check_action(self._actions, self._shape)
        observations = np.empty((n, self.layout.size), np.float32)
        rewards, dones = np.empty(n, np.float32), np.empty(n, np.bool_)
        self._workers.run(self._step, n, self._all, actions, episodes.packed, observations)
        count = self._add(episodes.packed, self._sums, self._ends, rewards, dones)
        infos: list[dict[str, Any]] = [{} for _ in range(n)]
        if count > 0:
            rows = np.flatnonzero(dones)
            told = (rows.tolist(), observations[rows], episodes.state.ended[1, rows].tolist())
            position_key, heading_key = EPISODE_KEYS
            for row, last, kept, end in zip(*told, self._ends[:count].tolist(), strict=True):
                position, heading, total, length = end
                infos[row] = {
                    "terminal_observation": last,
                    "TimeLimit.truncated": kept,
                    "is_success": kept,
                    "episode": {"r": total, "l": int(length), "t": 0.0},
                    position_key: position,
                    heading_key: heading,
                }
            episodes.start(dones, observations)
        return observations, rewards, dones, infos

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
