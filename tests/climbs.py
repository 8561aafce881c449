"""Climbs down the ladder whose episodes end as told, without a simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from recorded import STEPS, a_record

from agents.ladder import Rung
from agents.records import Record

Outcomes = dict[float, tuple[int, float]]
"""By separation: successful episodes of 20, and how far apart the robots stay, over the separation."""
Climbed = Callable[..., list[Rung]]


class Told:
    """Stands for ``rollout.run``: episodes that end as told, all in success where nothing is told; counts its calls."""

    def __init__(self) -> None:
        self.outcomes: Outcomes = {}
        self.calls: list[tuple[str, str]] = []
        self.break_at: int | None = None
        self.episodes = {steps: a_record(steps) for steps in (10, STEPS)}

    def __call__(
        self,
        who: Any,
        scenario: str,
        plant: str,
        n_epm: int,
        control_hz: float,
        episodes: int,
        seed: int,
        progress: Any,
    ) -> list[Record]:
        if len(self.calls) == self.break_at:
            raise KeyboardInterrupt
        self.calls.append((who.name, scenario))
        separation_mm = float(scenario.split("-")[1])
        successes, apart = self.outcomes.get(separation_mm, (episodes, 1.0))
        records = []
        for k in range(episodes):
            steps = STEPS if k < successes else 10
            least = np.full(steps, 1e-3 * apart * separation_mm)
            setting = {"scenario": scenario, "plant": plant, "n_epm": n_epm, "control_hz": control_hz, "seed": seed + k}
            records.append(replace(self.episodes[steps], controller=who.name, separation_min_m=least, **setting))
            if progress is not None:
                progress(records[-1])
        return records
