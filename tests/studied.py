"""Made-up records of the study, whose numbers are known without a training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from agents.configs import command_of
from agents.study import entries
from agents.study.entries import Curve, Entry, Made, Outcomes
from agents.study.trainings import SCENARIOS, as_told, training

EPISODES = 12
_LEVELS = {"baseline": (10.0, 15.0), "tuned": (0.4, 1.7), "predictive": (0.05, 0.14), "ppo": (0.5, 11.0)}


def some_outcomes(rng: np.random.Generator, level: tuple[float, float], hold: float, episodes: int) -> Outcomes:
    """Return episodes about a level of position error (mm) and heading error (degrees), held with a chance."""
    held = tuple(bool(lucky) for lucky in rng.random(episodes) < hold)
    position, heading = (tuple(map(entries.short, mean * np.exp(0.2 * rng.normal(size=episodes)))) for mean in level)
    lost = tuple(
        None if kept else entries.short(time) for kept, time in zip(held, rng.uniform(1, 99, episodes), strict=True)
    )
    apart = tuple(map(entries.short, rng.uniform(25, 60, episodes)))
    return Outcomes(0, held, position, heading, apart, lost)


def an_entry(name: str, seed: int | None = None, episodes: int = EPISODES, hold: float = 0.9, **changes: Any) -> Entry:
    """Return the record of a controller, or of an agent with a seed."""
    rng = np.random.default_rng([*name.encode(), 0 if seed is None else seed + 1])
    made, action = None, "pose"
    level = _LEVELS.get(name, (1.0, 12.0))
    if seed is not None:
        config = training(name).of_seed(seed)
        level, action = (rng.uniform(0.5, 2.0), rng.uniform(9, 14)), config.settings.action
        steps = np.linspace(0.02, 1.0, 60) * config.total_steps
        curve = Curve(
            steps=tuple(map(int, steps)),
            seconds=tuple(map(entries.short, 1e-4 * rng.uniform(1, 2) * steps)),
            success_rate=tuple(map(entries.short, 1 - np.exp(-5 * steps / steps[-1]))),
            position_error_mm=tuple(map(entries.short, level[0] * (1 + 5 * np.exp(-4 * steps / steps[-1])))),
            heading_error_deg=tuple(map(entries.short, level[1] * (1 + 3 * np.exp(-4 * steps / steps[-1])))),
        )
        packages = {"magenv": "0.1.0", "torch": "2.9"}
        made = Made(
            seed,
            as_told(config),
            command_of(config),
            int(steps[-1]),
            curve.seconds[-1],
            packages,
            ("abcdef123456 on M, 2 cores, Linux",),
            curve,
        )
    fields: dict[str, Any] = {
        "name": name,
        "plant": "paper",
        "n_epm": 2,
        "control_hz": 2.0,
        "action": action,
        "outcomes": {scenario: some_outcomes(rng, level, hold, episodes) for scenario in SCENARIOS},
        "versions": {"Python": "3.11.2", "magenv": "0.1.0"},
        "commit": "abcdef123456",
        "machine": "M, 2 cores, Linux",
        "training": made,
    }
    return Entry(**(fields | changes))


def a_store(
    folder: Path, seeds: dict[str, int], controllers: tuple[str, ...] = ("baseline", "tuned"), **kw: Any
) -> None:
    """Fill a store: agents with so many seeds, and controllers."""
    for name, count in seeds.items():
        for seed in range(count):
            entries.save(an_entry(name, seed, **kw), folder)
    for name in controllers:
        entries.save(an_entry(name, **({"hold": 0.3 if name == "baseline" else 0.9} | kw)), folder)
