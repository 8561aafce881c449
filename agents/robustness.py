"""The robustness score: success where the plant is not what the controller was made for.

In the manner of the double pendulum's leaderboards (Wiebe et al., "Open Source Dual-Purpose Acrobot and Pendubot
Platform", IEEE Robotics & Automation Magazine): for each criterion, one thing about the plant is made worse step
by step, everything else stays. The score of a criterion is the mean of the success rates over its values, the overall
score the mean of the criteria, in per cent: 100 holds everywhere, and each value counts as much as its neighbours.

The controllers are made for the plant in the middle and are told nothing of the change.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

from agents.controller import Controller
from agents.metrics import Interval, summarise
from agents.records import Record
from agents.results import Table
from agents.sharing import run_shared
from magenv.params import plant_named

BASE = "base"
"""Stands for a criterion in the row of the plant as it is."""


@dataclass(frozen=True)
class Criterion:
    """One thing that a plant may do worse, and the values it takes, from good to bad."""

    name: str
    unit: str
    values: tuple[float, ...]
    changes: Callable[[float], dict[str, float]]
    """Returns what of ``magenv.params.Plant`` a value changes."""

    def plant(self, base: str, value: float) -> str:
        """Return the text of the plant ``base`` with this value."""
        name, _, told = base.partition(":")
        kept = dict(change.split("=", 1) for change in told.split(",") if change)
        changed = kept | {parameter: repr(number) for parameter, number in self.changes(value).items()}
        return f"{name}:{','.join('='.join(pair) for pair in changed.items())}"


CRITERIA = (
    # About the localisation of two capsules at once, 1.3 mm and 1.1 degrees (see plant ``arm``).
    Criterion(
        "noise",
        "x 1.3 mm, 1.1\N{DEGREE SIGN}",
        (0.25, 0.5, 1.0, 2.0),
        lambda share: {"noise_position_m": 1.3e-3 * share, "noise_heading_rad": math.radians(1.1) * share},
    ),
    # From localisation alone (20 ms) over that of ``arm`` to nearly half a period at 2 Hz.
    Criterion("latency", "s", (0.02, 0.05, 0.1, 0.2), lambda seconds: {"latency_s": seconds}),
    # From what a balance and a gaussmeter leave open to drags that are guessed.
    Criterion("mismatch", "share", (0.05, 0.1, 0.2, 0.4), lambda share: {"mismatch": share}),
    # Drag at 1 mm/s is 0.15 mN; 3 mN alone move a robot by 10 mm from one command to the next at 2 Hz.
    Criterion("disturbance", "mN", (0.1, 0.3, 1.0, 3.0), lambda force: {"disturbance_n": 1e-3 * force}),
    # About the typical speed of a collaborative arm's tool, 1 m/s and half a turn a second.
    Criterion(
        "EPM speed",
        "m/s",
        (2.0, 1.0, 0.5, 0.25),
        lambda speed: {"epm_speed_mps": speed, "epm_turn_radps": math.pi * speed},
    ),
)


@dataclass(frozen=True)
class Sweep:
    """What all rows have in common."""

    plant: str = "paper"
    """In the middle; the controllers are made for it."""
    n_epm: int = 2
    control_hz: float = 2.0
    scenarios: tuple[str, ...] = ("approach-60",)
    episodes: int = 20
    """Of each row."""
    seed: int = 0
    """Of the first episode; the others follow."""

    def points(self) -> list[tuple[str, float | None, str]]:
        """Return criterion, value and plant of all rows of one controller and scenario, the plant as it is first.

        Values that the plant has anyway are left out.
        """
        points: list[tuple[str, float | None, str]] = [(BASE, None, self.plant)]
        for criterion in CRITERIA:
            plants = {value: criterion.plant(self.plant, value) for value in criterion.values}
            points += [
                (criterion.name, value, plant)
                for value, plant in plants.items()
                if plant_named(plant) != plant_named(self.plant)
            ]
        return points


@dataclass(frozen=True)
class Row:
    """One controller on one plant: an entry of ``robustness.json``; null where there is nothing to average."""

    controller: str
    scenario: str
    criterion: str
    """Name of one of ``CRITERIA``, or ``base``."""
    value: float | None
    """In the criterion's unit; null of ``base``."""
    plant: str
    """Acted on."""
    episodes: int
    success_rate: float
    success_rate_ci: Interval
    """95 % Wilson interval."""
    position_error_mm: float | None
    """Mean over the successful episodes; so is the next."""
    heading_error_deg: float | None
    loss_of_control_s: float | None
    """Median over the lost episodes."""

    @property
    def point(self) -> tuple[str, str, float | None]:
        """What tells a row from the others of its controller."""
        return self.scenario, self.criterion, self.value


TABLE = Table("robustness", "rows", Row)


@dataclass(frozen=True)
class Score:
    """The scores of one controller on one scenario, in per cent; null where rows are missing."""

    controller: str
    scenario: str
    base: float | None
    """Success on the plant as it is; no part of the score."""
    criteria: dict[str, float | None]
    """By name: mean of the success rates over the criterion's values."""
    overall: float | None
    """Mean of the criteria."""


def sweep_over(
    controller: Controller,
    sweep: Sweep,
    jobs: int = 1,
    known: Sequence[Row] = (),
    keep: Callable[[Row, list[Record]], object] | None = None,
    progress: Callable[[Record], object] | None = None,
) -> list[Row]:
    """Return the rows of one controller, in the order of ``Sweep.points``, scenario after scenario.

    Parameters
    ----------
    controller : Controller
        Made for the sweep's plant, number of EPMs and control rate.
    sweep : Sweep
        What all rows have in common.
    jobs : int
        Processes among which the episodes of a row are shared (see ``sharing``).
    known : sequence of Row
        Of an earlier sweep; they are not run again.
    keep : callable, optional
        Called with each row that was run, and its records, as soon as it is done.
    progress : callable, optional
        Called with each record.

    Raises
    ------
    ValueError
        If the sweep does not fit the controller or the environment.
    """
    done = {row.point: row for row in known}
    rows: list[Row] = []
    for scenario in sweep.scenarios:
        for criterion, value, plant in sweep.points():
            row = done.get((scenario, criterion, value))
            if row is None:
                shared = (sweep.n_epm, sweep.control_hz, sweep.episodes, sweep.seed, jobs, progress, sweep.plant)
                records = run_shared(controller, scenario, plant, *shared)
                row = _row(records, criterion, value)
                if keep is not None:
                    keep(row, records)
            rows.append(row)
    return rows


def _row(records: list[Record], criterion: str, value: float | None) -> Row:
    (summary,) = summarise(records)
    return Row(
        controller=summary.controller,
        scenario=summary.scenario,
        criterion=criterion,
        value=value,
        plant=summary.plant,
        episodes=summary.episodes,
        success_rate=summary.success_rate,
        success_rate_ci=summary.success_rate_ci,
        position_error_mm=summary.position_error_mm,
        heading_error_deg=summary.heading_error_deg,
        loss_of_control_s=summary.loss_of_control_s,
    )


def scores(rows: Sequence[Row], sweep: Sweep) -> list[Score]:
    """Return the scores of each controller and scenario, in the order of the rows."""
    wanted: dict[str, int] = {}
    for criterion, _, _ in sweep.points():
        wanted[criterion] = wanted.get(criterion, 0) + 1
    groups: dict[tuple[str, str], dict[str, list[float]]] = {}
    for row in rows:
        rates = groups.setdefault((row.controller, row.scenario), {})
        rates.setdefault(row.criterion, []).append(100 * row.success_rate)
    return [_score(*names, rates, wanted) for names, rates in groups.items()]


def _score(controller: str, scenario: str, rates: dict[str, list[float]], wanted: dict[str, int]) -> Score:
    means = {name: fmean(rates[name]) if len(rates.get(name, [])) == count else None for name, count in wanted.items()}
    base = means.pop(BASE)
    found = [mean for mean in means.values() if mean is not None]
    return Score(controller, scenario, base, means, fmean(found) if len(found) == len(means) else None)
