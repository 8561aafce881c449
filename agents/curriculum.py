"""A training that begins with robots far apart: the random family's least separation falls while it goes on."""

from __future__ import annotations

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from agents.configs import TrainConfig
from agents.sb3_vec import TwoRobotsVecEnv

FALLS_FOR = 0.5
"""Share of all steps for which the least separation falls."""


def nearest_m(config: TrainConfig, steps: int) -> float:
    """Return the least separation (m) of episodes that begin after so many steps of a training with a curriculum.

    It falls evenly from where the curriculum begins to that of the scenario, where it comes after ``FALLS_FOR`` of all
    steps and stays.
    """
    first, last = config.curriculum_m
    left = max(1.0 - steps / (FALLS_FOR * config.total_steps), 0.0)
    return min(last + left * (first - last), first)  # rounding


class Curriculum(BaseCallback):
    """Lets the least separation fall with every step, of cloning as well.

    Parameters
    ----------
    config : TrainConfig
        With a curriculum.
    env : VecEnv
        Whatever wraps a ``TwoRobotsVecEnv``.
    steps : int
        Done already: episodes that begin from now on are those of that time.
    """

    def __init__(self, config: TrainConfig, env: VecEnv, steps: int) -> None:
        super().__init__()
        robots = env.unwrapped
        assert isinstance(robots, TwoRobotsVecEnv)
        self._config, self._robots = config, robots
        robots.set_nearest(nearest_m(config, steps))

    def _on_step(self) -> bool:
        self._robots.set_nearest(nearest_m(self._config, self.model.num_timesteps))
        return True
