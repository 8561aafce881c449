"""A policy that corrects a controller: what it sees, and what comes of both actions. The law of training and of use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.classical import CLASSICAL, classical
from agents.controller import Actions, Controller, Observations
from magenv.episodes import Settings
from magenv.params import require
from magenv.task import ERRORS_SIZE


def seen_by(base: Controller, observation: Observations) -> Observations:
    """Return what the controller sees of the policy's observation (..., d): all, or the errors that it begins with."""
    return observation[..., :ERRORS_SIZE] if base.observation == "errors" else observation


def with_base(observation: Observations, base: Actions) -> Observations:
    """Return what the policy sees (..., d + a): the observation (..., d), then the controller's action (..., a)."""
    told: Observations = np.concatenate([observation, base], axis=-1, dtype=np.float32)
    return told


def corrected(base: Actions, correction: Actions, scale: float) -> Actions:
    """Return the controller's actions (..., a) plus ``scale`` times the policy's, within [-1, 1]."""
    actions: Actions = np.clip(base + np.float32(scale) * correction, -1.0, 1.0, dtype=np.float32)
    return actions


def teacher(name: str, settings: Settings, role: str) -> Controller:
    """Return the classical controller of this name, made for the environment in which a policy is trained beside it.

    One that sees errors alone may go with a policy that sees more (``seen_by``). ``role`` tells in errors what becomes
    of it.

    Raises
    ------
    ValueError
        If it speaks to another environment.
    """
    base = classical(name, settings.n_epm, settings.control_hz, settings.plant)
    for part in ("action", "observation", "frame"):
        own, asked = getattr(base, part), getattr(settings, part)
        fits = own == asked or (part == "observation" and own == "errors")
        require(fits, part, f"{own!r}, as of {name}, which is {role}", asked)
    return base


@dataclass(frozen=True)
class Correction:
    """Which controller a policy corrects, and how far.

    Raises
    ------
    ValueError
        If there is no classical controller of this name, or the scale is not above 0 and at most 1.
    """

    controller: str
    """Its name in ``agents.classical``."""
    scale: float
    """Of the policy's action, in that of both."""

    def __post_init__(self) -> None:
        known = isinstance(self.controller, str) and self.controller in CLASSICAL
        require(known, "residual", f"one of {', '.join(CLASSICAL)}", self.controller)
        number = isinstance(self.scale, int | float) and not isinstance(self.scale, bool)
        require(number and 0.0 < self.scale <= 1.0, "residual_scale", "a number above 0, at most 1", self.scale)

    def base(self, settings: Settings) -> Controller:
        """Return the controller, made for the environment (see ``teacher``)."""
        return teacher(self.controller, settings, "corrected")


class Corrected:
    """A controller and the policy that corrects it, together behind ``predict`` (see ``agents.controller``).

    Parameters
    ----------
    base : Controller
        Sees the observation, or what it knows of it (``seen_by``), and remembers what it does.
    policy : callable
        Returns the corrections (n, a) or (a,) for what the policy sees, (n, d + a) or (d + a,).
    scale : float
        Of the corrections.
    """

    def __init__(self, base: Controller, policy: Callable[[Observations], Actions], scale: float) -> None:
        self._base, self._policy, self._scale = base, policy, scale

    def seed(self, seed: int) -> None:
        """Fix the controller's own randomness; the policy has none."""
        self._base.seed(seed)

    def predict(
        self,
        observation: Observations,
        state: Any | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, Any]:
        """Return actions (n, a) or (a,) for observations (n, d) or (d,), and the controller's state."""
        base, state = self._base.predict(seen_by(self._base, observation), state, episode_start, deterministic)
        return corrected(base, self._policy(with_base(observation, base)), self._scale), state
