"""How good a policy is while it learns: held-out episodes, side by side, the same ones whenever it is asked.

They are of the scenario that is trained on. Each episode is fixed by its seed, and no training draws these.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from magenv.actions import PLANAR
from magenv.episodes import Episodes, Settings, check_action
from magenv.params import require

EPISODES = 64
EPISODES_CORRECTED = 16
"""Where the policy corrects a controller: ``predictive`` takes up to 10 ms a decision, a minute or two for all 64."""
SEED = 2**40
"""Of the first held-out episode; the others follow. Trainings, like ``evaluate.py``, stay far below."""
POSITION_UNIT_MM, HEADING_UNIT_DEG = 1.0, 5.0
"""Errors that weigh the same."""
LOST_UNITS = 100.0
"""What the time after a loss weighs, in such errors: of policies that lose control, the better keeps it longer."""
THREADS = 2
"""That share the episodes where each action is solved for, which takes most of a step; elsewhere one is as fast."""


def threads_for(settings: Settings) -> int:
    """Return how many threads should share the episodes of an environment."""
    return THREADS if settings.action in PLANAR else 1


@dataclass(frozen=True)
class Score:
    """What a policy reaches on the held-out episodes."""

    success_rate: float
    position_error_mm: float
    """Mean over the episodes, both robots and all substeps until the episode's end or its loss; NaN where a state was
    lost."""
    heading_error_deg: float
    """Absolute, mean likewise."""
    held: float
    """Share of the episodes' whole time for which control was kept."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            number = isinstance(value, (int, float)) and not isinstance(value, bool) and not value < 0
            require(number, name, "a number of at least 0", value)
        for name in ("success_rate", "held"):
            require(getattr(self, name) <= 1, name, "at most 1", getattr(self, name))

    @property
    def merit(self) -> float:
        """One number that orders scores: more success is better, of equal success smaller errors and longer control."""
        errors = self.position_error_mm / POSITION_UNIT_MM + self.heading_error_deg / HEADING_UNIT_DEG
        cost = self.held * errors + (1.0 - self.held) * LOST_UNITS
        # It decides less than one episode more or less does.
        return self.success_rate + (0.0 if math.isnan(cost) else 1.0 / (EPISODES * (1.0 + cost)))

    def __str__(self) -> str:
        return f"{self.success_rate:.0%} {self.position_error_mm:.1f} mm {self.heading_error_deg:.1f} deg"


class HeldOut:
    """The held-out episodes of an environment, the first of them where fewer are asked for."""

    def __init__(self, settings: Settings, episodes: int = EPISODES) -> None:
        self._n, self._episodes = episodes, Episodes(episodes, settings, threads_for(settings))

    def score(self, predict: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> Score:
        """Run all episodes to their ends and return what was reached.

        Parameters
        ----------
        predict : callable
            Returns the actions (n, a) for observations (n, d).

        Raises
        ------
        ValueError
            If actions are not finite.
        """
        n, episodes = self._n, self._episodes
        active = np.ones(n, np.bool_)
        for row in range(n):
            episodes.seed(row, seeding.np_random(SEED + row)[0])
        observations = episodes.start(active)
        sums, substeps, success = np.zeros((2, n)), np.zeros(n), np.zeros(n, np.bool_)
        while active.any():
            actions = check_action(predict(observations), (n, episodes.actions.size))
            observations = episodes.step(actions, active)
            hold = episodes.step_info()
            errors = np.stack([hold["position_error_m"], hold["heading_error_rad"]])
            sums[:, active] += (hold["substeps"] * errors)[:, active]
            substeps[active] += hold["substeps"][active]
            _, terminated, truncated = episodes.outcome()
            success |= active & truncated
            active &= ~(terminated | truncated)
        position, heading = np.mean(sums / substeps, axis=1).tolist()
        world = episodes.world
        held = np.minimum(substeps * (world.period_s / world.substeps) / world.duration_s, 1.0)
        return Score(float(np.mean(success)), 1e3 * position, math.degrees(heading), float(np.mean(held)))
