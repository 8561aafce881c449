"""Training of a policy that corrects a controller: the environments as that policy meets them."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from agents.controller import Actions, Controller, Observations
from agents.residual import corrected, seen_by, with_base
from agents.rollout import controller_seed


class ResidualVecEnv(VecEnvWrapper):
    """Environments in which a controller acts, and actions are corrections of its own (``agents.residual``).

    An observation is that of the environment, and then the action that the controller is about to take. An episode's
    ``terminal_observation`` has in this place the last action taken: the controller, which is asked once at every
    instant, goes on with the episode that follows.

    Parameters
    ----------
    venv : VecEnv
        Environments that the controller speaks to, without normalisation.
    base : Controller
        Draws, where it does, one stream of random numbers per environment, over all its episodes.
    scale : float
        Of the corrections.
    """

    def __init__(self, venv: VecEnv, base: Controller, scale: float) -> None:
        seen, acted = venv.observation_space, venv.action_space
        assert isinstance(seen, spaces.Box)
        assert isinstance(acted, spaces.Box)
        low, high = with_base(seen.low, acted.low), with_base(seen.high, acted.high)
        super().__init__(venv, spaces.Box(low, high, dtype=np.float32), acted)
        self._base, self._scale = base, scale
        self._state: Any = None
        self._actions: Actions = np.zeros((venv.num_envs, *acted.shape), np.float32)

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Seed the environments and, independently of them, the controller."""
        if seed is not None:
            self._base.seed(controller_seed(seed))
        return list(self.venv.seed(seed))

    def reset(self) -> Observations:
        """Begin all episodes."""
        observations = self.venv.reset()
        assert isinstance(observations, np.ndarray)
        self._state = None
        return self._told(observations, np.ones(self.num_envs, np.bool_))

    def step_async(self, actions: Actions) -> None:
        """Correct the controller's actions (n, a) by these."""
        self.venv.step_async(corrected(self._actions, actions, self._scale))

    def step_wait(self) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all environments, and let the controller choose what to do next."""
        observations, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(observations, np.ndarray)
        for row in np.flatnonzero(dones):
            infos[row]["terminal_observation"] = with_base(infos[row]["terminal_observation"], self._actions[row])
        return (
            self._told(observations, dones),
            rewards,
            dones,
            infos,
        )  # of rows that ended these are the next first ones

    def _told(self, observations: Observations, starts: NDArray[np.bool_]) -> Observations:
        """Let the controller choose, and return the observations with what it chose."""
        seen = seen_by(self._base, observations)
        self._actions, self._state = self._base.predict(seen, self._state, starts, deterministic=True)
        return with_base(observations, self._actions)
