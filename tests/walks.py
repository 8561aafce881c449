"""The predictive controller in an environment, step by step."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.predictive import Predictive
from magenv.env import TwoRobots

Observations = NDArray[np.float32]
Actions = NDArray[np.float32]

BEGINS, GOES_ON = np.ones(1, np.bool_), np.zeros(1, np.bool_)


def first(env: TwoRobots, seed: int) -> Observations:
    """Return the first observation (d,) of an episode."""
    observation: Observations = env.reset(seed=seed)[0]
    return observation


def walk(env: TwoRobots, agent: Predictive, seed: int, steps: int) -> tuple[list[Observations], list[Actions], Any]:
    """Let the controller act: observations, one more than actions, and the state it hands out at last."""
    observations, actions, state = [first(env, seed)], [], None
    for _ in range(steps):
        action, state = agent.predict(observations[-1], state, BEGINS if state is None else GOES_ON)
        observation, _, terminated, _, _ = env.step(action)
        assert not terminated
        observations.append(observation)
        actions.append(action)
    return observations, actions, state
