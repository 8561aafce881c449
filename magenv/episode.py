"""A single episode, the short way: one compiled call a step, whose answers are Python's own numbers.

The laws are those of ``Episodes``; what is saved is their handling as arrays, which takes longer than the laws.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magenv.actions import PLANAR
from magenv.episodes import Episodes, check_action
from magenv.state import type_of
from magenv.steps import begin_one, one_kernel

Observation = NDArray[np.float32]


class Episode:
    """The only episode of ``Episodes(1, ...)``."""

    def __init__(self, episodes: Episodes) -> None:
        self._episodes = episodes
        state, self._packed = episodes.state, episodes.packed
        # Compiled for this state beforehand: numba need not look up its type at each call.
        step: Any = one_kernel(episodes.settings.action, *episodes.world.shape)
        begin: Any = begin_one
        types = (type_of(self._packed),)
        self._step, self._begin = step.compile(types), begin.compile(types)
        self._draw = functools.partial(episodes.draw, state.every)
        self._solves = episodes.settings.action in PLANAR
        self._action = state.action[0]
        self._shape = self._action.shape
        self._observation = state.observation[0].copy
        self._robots, self._reference, self._poses = (a[0].copy for a in (state.robots, state.references, state.poses))

    def __reduce__(self) -> tuple[type[Episode], tuple[Episodes]]:
        return Episode, (self._episodes,)

    def start(self) -> tuple[Observation, dict[str, Any]]:
        """Begin a new episode; return the first observation (d,) and info, newly allocated."""
        self._draw()
        self._begin(self._packed)
        info = {
            "time_s": 0.0,
            "robots": self._robots(),
            "reference": self._reference(),
            "epm_pose": self._poses(),
        }
        return self._observation(), info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act (size,) for one control period; return observation (d,), reward, both ends and info, newly allocated.

        Raises
        ------
        ValueError
            If the action has the wrong shape or is not finite; nothing has moved then.
        """
        if type(action) is np.ndarray and action.shape == self._shape and action.dtype.kind == "f":
            self._action[...] = action
        else:
            self._action[...] = check_action(action, self._shape)
        (
            fit,
            reward,
            terminated,
            truncated,
            time_s,
            position_error_m,
            heading_error_rad,
            position_error_end_m,
            heading_error_end_rad,
            separation_min_m,
            separation_tracked_m,
            substeps,
            loss,
            reward_position,
            reward_heading,
            projected,
            solver,
        ) = self._step(self._packed)
        if not fit:
            check_action(action, self._shape)
        info = {
            "time_s": time_s,
            "robots": self._robots(),
            "reference": self._reference(),
            "epm_pose": self._poses(),
            "position_error_m": position_error_m,
            "heading_error_rad": heading_error_rad,
            "position_error_end_m": position_error_end_m,
            "heading_error_end_rad": heading_error_end_rad,
            "separation_min_m": separation_min_m,
            "separation_tracked_m": separation_tracked_m,
            "substeps": substeps,
            "loss": loss,
            "reward_position": reward_position,
            "reward_heading": reward_heading,
            "projected": projected,
        }
        if self._solves:
            info["solver"] = solver
        return self._observation(), reward, terminated, truncated, info
