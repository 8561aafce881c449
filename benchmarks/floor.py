"""What steps cannot go below: an environment that does nothing, the laws without Python, a hold alone, its products."""

from __future__ import annotations

import re
from typing import Any

import gymnasium
import numba
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding
from numpy.typing import NDArray

from benchmarks.measure import Contestant
from magenv.env import TwoRobots
from magenv.episodes import Episodes, Settings
from magenv.hold import hold_rows, hold_shape
from magenv.state import State
from magenv.steps import begin_one, one_kernel

Observation = NDArray[np.float32]


class Nothing(gymnasium.Env[Any, Any]):
    """Answers every step with constants of the kinds that ``TwoRobots`` answers with, its arrays copied."""

    def __init__(self) -> None:
        env = TwoRobots()
        self.observation_space, self.action_space = env.observation_space, env.action_space
        env.reset(seed=0)
        observation, self._reward, _, _, info = env.step(np.zeros(env.action_space.shape or 0, np.float32))
        info.pop("is_success", None)
        arrays = (observation, *(info.pop(name) for name in ("robots", "reference", "epm_pose")))
        self._observation, self._robots, self._reference, self._poses = (array.copy for array in arrays)
        self._numbers = info

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Observation, dict[str, Any]]:
        """Return the observation and no info."""
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Return what is always returned."""
        info = {
            **self._numbers,
            "robots": self._robots(),
            "reference": self._reference(),
            "epm_pose": self._poses(),
        }
        return self._observation(), self._reward, False, False, info


def nothing() -> gymnasium.Env[Any, Any]:
    """Return ``Nothing`` as ``gymnasium.make`` makes it, in no more wrappers than ``TwoRobots`` is in."""
    return gymnasium.make(
        EnvSpec("Nothing-v0", entry_point="benchmarks.floor:Nothing", order_enforce=False), disable_env_checker=True
    )


class Kernels:
    """One episode stepped with ``actions`` (k, size) in a compiled loop, and begun anew wherever it ends."""

    def __init__(self, settings: Settings, actions: NDArray[Any]) -> None:
        self.episodes = Episodes(1, settings)
        self._actions = actions.astype(np.float64)
        step, begin = one_kernel(settings.action, *self.episodes.world.shape), begin_one

        def play(s: State, actions: NDArray[np.float64]) -> None:
            for k in range(len(actions)):
                s.action[0] = actions[k]
                step(s)
                if s.ended[0, 0] or s.ended[1, 0]:
                    s.used[0] = 0  # the same start again
                    begin(s)

        self._play: Any = numba.njit(play)

    def reset(self) -> None:
        """Begin the episode of seed 0."""
        self.episodes.seed(0, seeding.np_random(0)[0])
        self.episodes.start(self.episodes.state.every)

    def run(self) -> None:
        """Step with all actions."""
        self._play(self.episodes.packed, self._actions)

    def contestant(self) -> Contestant:
        """Return this loop as a contestant."""
        return Contestant(self.run, len(self._actions), self.reset)


class Holds:
    """Holds of many episodes, each from the start and all its substeps long, and nothing else of a step."""

    def __init__(self, settings: Settings, envs: int, steps: int) -> None:
        episodes, self._every, self._steps = Episodes(envs, settings), np.ones(envs, np.bool_), steps
        for row in range(envs):
            episodes.seed(row, seeding.np_random(row)[0])
        episodes.start(self._every)
        self.world = episodes.world
        self._robots, self._epms = self.world.robots.copy(), self.world.epms.copy()
        self._epms[..., :3] *= 2.0  # too far away to move robots out of control in one hold

    def run(self) -> None:
        """Hold, with the robots put back before each."""
        for _ in range(self._steps):
            self.world.robots[...] = self._robots
            self.world.step_count[...] = 0
            self.world.step(self._epms, self._every)

    def contestant(self) -> Contestant:
        """Return these holds as a contestant."""
        return Contestant(self.run, len(self._every) * self._steps)


_PRODUCT = re.compile(r"^\s+v(?:fn?m(?:add|sub)\d+|mul)pd\b", re.M)
_LOOP = 20
"""A part of the machine code with so many vectors of products is one of the loops over lanes."""


def products(settings: Settings) -> int:
    """Return how many products, alone or with a sum in one instruction, a substep has in the vectorised machine code.

    The hold is compiled anew: numba does not show cached code.
    """
    cached: Any = hold_rows
    world, idle = Episodes(16, settings).world, np.zeros(16, np.bool_)
    fresh = numba.njit(error_model="numpy", nogil=True)(cached.py_func)
    fresh(0, 16, idle, world.robots, world.epms, world.epms, *world.held, *hold_shape(settings.n_epm, 16))
    (assembly,) = fresh.inspect_asm().values()
    counts = [len(_PRODUCT.findall(part)) for part in re.split(r"^\.L\w+:$", assembly, flags=re.M)]
    return sum(count for count in counts if count >= _LOOP)
