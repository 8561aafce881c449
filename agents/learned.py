"""Learned policies behind ``predict``: built from a card and safetensors weights, never unpickled, without torch."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.controller import Actions, Observations
from agents.history import Recalling
from agents.player import Player
from agents.residual import Corrected, Correction
from agents.store import load_card, load_policy
from magenv.episodes import Episodes, Settings
from magenv.params import require


def whole(
    policy: Callable[[Observations], Actions], settings: Settings, correction: Correction | None, history: int
) -> Corrected | Recalling | None:
    """Return a policy with what it goes with: the controller it corrects, or its memory; None if it has neither."""
    if correction is not None:
        return Corrected(correction.base(settings), policy, correction.scale)
    return Recalling(policy, history) if history > 1 else None


class Learned:
    """A stored policy, or a controller with the corrections of a stored policy.

    It plays the policy's mode: what it tried in training beside it is left behind.

    Parameters
    ----------
    folder : Path
        A model folder (see ``agents.store``).
    name : str, optional
        Under which results are reported; by default the algorithm's, and that of the controller it corrects.

    Raises
    ------
    ValueError
        If the folder holds no sound model.
    """

    def __init__(self, folder: Path, name: str | None = None) -> None:
        self.card = card = load_card(folder)
        self.settings: Settings = card.settings
        episodes = Episodes(1, card.settings)
        self._size, outputs = episodes.layout.size, episodes.actions.size
        correction = card.residual
        inputs = card.history * self._size if correction is None else self._size + outputs
        self._player = Player(card, *load_policy(folder), inputs, outputs)
        self._whole = whole(self._player, card.settings, correction, card.history)
        self.name = name or (card.algo if correction is None else f"{correction.controller}-{card.algo}")
        self.action = card.settings.action
        self.observation = card.settings.observation
        self.frame = card.settings.frame

    def seed(self, seed: int) -> None:
        """Seed the controller that is corrected; the policy's mode has no randomness."""
        if self._whole is not None:
            self._whole.seed(seed)

    def check(self, n_epm: int, control_hz: float) -> None:
        """Raise ``ValueError`` unless the policy was made for this number of EPMs and control rate."""
        trained = self.settings
        require(trained.n_epm == n_epm, f"n_epm for {self.name}", f"{trained.n_epm}, as trained", n_epm)
        require(
            trained.control_hz == control_hz,
            f"control_hz for {self.name}",
            f"{trained.control_hz}, as trained",
            control_hz,
        )

    def predict(
        self,
        observation: Observations,
        state: Any | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, Any]:
        """Return actions (n, a) or (a,) for observations (n, d) or (d,), and the state.

        That is the state of the controller corrected, or the observations that the policy remembers; others have none.
        ``deterministic`` changes nothing.
        """
        shape = np.shape(observation)
        fits = len(shape) in (1, 2) and shape[-1] == self._size
        require(fits, f"observation for {self.name}", f"of shape ({self._size},) or (n, {self._size})", shape)
        if self._whole is None:
            return self._player(observation), None
        return self._whole.predict(observation, state, episode_start, deterministic)
