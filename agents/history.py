"""Policies that see the last observations of their episode side by side. The law of training and of use.

One observation tells neither how the robots answer to their magnets, nor where they are beyond the noise of a single
measurement; several do. Where the EPMs were, full observations tell as well.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.controller import Actions, Observations
from magenv.params import is_whole, require

LONGEST = 64
"""Observations that a policy may see at once."""


def check_history(history: Any) -> None:
    """Raise ``InputError`` unless ``history`` is a sensible number of observations."""
    require(is_whole(history) and 1 <= history <= LONGEST, "history", f"a whole number from 1 to {LONGEST}", history)


def recalled(
    past: Observations | None, observation: Observations, history: int, starts: NDArray[np.bool_] | None = None
) -> Observations:
    """Return the last observations (n, history, d), the newest (n, d) last.

    ``past`` (n, history, d) are those of the instant before. Where an episode begins, in the rows of ``starts`` (n,) or
    without a past, its first observation stands for all that came before.
    """
    if past is None:
        return np.repeat(observation[:, None], history, axis=1)
    told: Observations = np.concatenate([past[:, 1:], observation[:, None]], axis=1)
    if starts is not None:
        told[starts] = observation[starts, None]
    return told


def side_by_side(past: Observations) -> Observations:
    """Return what the policy sees (n, history * d) of the last observations (n, history, d)."""
    n, history, size = past.shape
    return past.reshape(n, history * size)


class Recalling:
    """A policy that sees the last observations of its episode, behind ``predict`` (see ``agents.controller``).

    Parameters
    ----------
    policy : callable
        Returns the actions (n, a) for what it sees, (n, history * d).
    history : int
        How many observations it sees.
    """

    def __init__(self, policy: Callable[[Observations], Actions], history: int) -> None:
        self._policy, self._history = policy, history

    def seed(self, seed: int) -> None:
        """Do nothing: there is no randomness."""

    def predict(
        self,
        observation: Observations,
        state: Any | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, Any]:
        """Return actions (n, a) or (a,) for observations (n, d) or (d,), and the observations seen (n, history, d)."""
        batch = np.atleast_2d(observation)
        n, size = batch.shape
        must_be = f"what was seen of {n} episodes, of shape {(n, self._history, size)}"
        seen: Any = np.shape(state)  # type: ignore[arg-type]
        require(state is None or seen == (n, self._history, size), "state", must_be, seen)
        starts = None
        if episode_start is not None:
            starts = np.asarray(episode_start, np.bool_)
            require(starts.shape == (n,), "episode_start", f"of shape ({n},)", starts.shape)
        past = recalled(state, batch, self._history, starts)
        actions = self._policy(side_by_side(past))
        return actions.reshape(*np.shape(observation)[:-1], actions.shape[-1]), past
