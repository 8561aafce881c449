"""Training of a policy that sees the last observations of its episode: the environments as that policy meets them."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from agents.controller import Observations
from agents.history import recalled, side_by_side


class HistoryVecEnv(VecEnvWrapper):
    """Environments whose observation (history * d,) is the last ones of the episode (``agents.history``).

    Unlike Stable-Baselines3's ``VecFrameStack``, which puts zeros there, an episode's first observation stands for all
    before it: zeros would tell of robots without errors.

    Parameters
    ----------
    venv : VecEnv
        Environments without normalisation.
    history : int
        How many observations are seen.
    """

    def __init__(self, venv: VecEnv, history: int) -> None:
        seen = venv.observation_space
        assert isinstance(seen, spaces.Box)
        low, high = np.tile(seen.low, history), np.tile(seen.high, history)
        super().__init__(venv, spaces.Box(low, high, dtype=np.float32), venv.action_space)
        self._history = history
        self._past: Observations | None = None

    def reset(self) -> Observations:
        """Begin all episodes."""
        observations = self.venv.reset()
        assert isinstance(observations, np.ndarray)
        self._past = recalled(None, observations, self._history)
        return side_by_side(self._past)

    def step_wait(self) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all environments."""
        observations, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(observations, np.ndarray)
        assert self._past is not None
        for row in np.flatnonzero(dones):
            last = infos[row]["terminal_observation"][None]
            infos[row]["terminal_observation"] = side_by_side(recalled(self._past[[row]], last, self._history))[0]
        self._past = recalled(self._past, observations, self._history, dones)
        return side_by_side(self._past), rewards, dones, infos
