"""The one door of all controllers: ``predict``, as in Stable-Baselines3; and two controllers that set the floor."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from magenv.actions import ActionMode
from magenv.poses import POSE_SIZE
from magenv.task import Frame, ObservationMode

Actions = NDArray[np.float32]
Observations = NDArray[np.float32]


class Controller(Protocol):
    """Whatever turns observations into actions; SB3's ``PolicyPredictor`` by the shape of its ``predict``.

    A controller says which environment it speaks to (``action``, ``observation``, ``frame``) and is told nothing of
    it but observations. What it remembers from step to step is in the ``state`` it hands out, or is forgotten by
    ``seed``: an episode's outcome depends on no other episode.
    """

    @property
    def name(self) -> str:
        """Name in tables and pictures."""
        ...

    @property
    def action(self) -> ActionMode:
        """Action mode of the environment."""
        ...

    @property
    def observation(self) -> ObservationMode:
        """Observation mode of the environment."""
        ...

    @property
    def frame(self) -> Frame:
        """Frame of the observation."""
        ...

    def seed(self, seed: int) -> None:
        """Fix the controller's own randomness for the episode that follows.

        Called before every episode with a number that depends on the episode's seed alone and is independent of what
        the environment draws from that seed. All later draws depend on this number and on the seed the controller was
        made with, on nothing before. Controllers without randomness do nothing here.
        """
        ...

    def predict(
        self,
        observation: Observations,
        state: Any | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, Any]:
        """Return actions and the state for the next call.

        Parameters
        ----------
        observation : ndarray, shape (n, d) or (d,)
            One per episode, or a single one.
        state : optional
            What the previous call returned; None at the start. It may be changed in place: it serves once.
        episode_start : ndarray of bool, shape (n,), optional
            Where an episode begins: the state of these rows is to be forgotten.
        deterministic : bool
            Whether a stochastic policy returns its mode.

        Returns
        -------
        action : ndarray of float32, shape (n, a) or (a,)
            Within [-1, 1].
        state
            For the next call; None where there is no memory. A controller whose actions a solver finds tells how it
            ended in an attribute ``solver`` (n,) of its state, codes into ``magenv.outcome.OUTCOMES``: it is recorded.
        """
        ...


class RowGenerators:
    """Random numbers of a controller's rows: each row has its own, whatever the others draw."""

    def __init__(self, seed: int) -> None:
        self._seeds = np.random.SeedSequence(seed)
        self._rngs = [np.random.default_rng(self._seeds)]

    def of(self, n: int) -> list[np.random.Generator]:
        """Return the generators of ``n`` rows; the first is the one of a single row."""
        missing = max(n - len(self._rngs), 0)
        self._rngs += [np.random.default_rng(child) for child in self._seeds.spawn(missing)]
        return self._rngs[:n]


class Idle:
    """Leaves the EPMs at home, in the frame that the robots carry."""

    name = "idle"
    action: ActionMode = "home"
    observation: ObservationMode = "full"
    frame: Frame = "robots"

    def __init__(self, n_epm: int = 2) -> None:
        self._size = POSE_SIZE * n_epm

    def seed(self, seed: int) -> None:
        """Do nothing: there is no randomness."""

    def predict(
        self,
        observation: Observations,
        state: Any | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, Any]:
        """Return zero actions (n, 5 N) or (5 N,)."""
        return np.zeros((*np.shape(observation)[:-1], self._size), np.float32), None


class Random:
    """Draws every action uniformly from the whole action space, in the ``home`` mode.

    Parameters
    ----------
    n_epm : int
        Number of EPMs.
    seed : int
        The controller's own seed.
    """

    name = "random"
    action: ActionMode = "home"
    observation: ObservationMode = "full"
    frame: Frame = "robots"

    def __init__(self, n_epm: int = 2, seed: int = 0) -> None:
        self._size = POSE_SIZE * n_epm
        self._own_seed = seed
        self._rng = np.random.default_rng(seed)

    def seed(self, seed: int) -> None:
        """Begin the random numbers of the episode with this number anew."""
        self._rng = np.random.default_rng([self._own_seed, seed])

    def predict(
        self,
        observation: Observations,
        state: Any | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, Any]:
        """Return random actions (n, 5 N) or (5 N,); ``deterministic`` changes nothing."""
        shape = (*np.shape(observation)[:-1], self._size)
        return self._rng.uniform(-1.0, 1.0, shape).astype(np.float32), None
