"""Statistics over records: what an episode measured, and one summary row per controller and scenario."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, bootstrap

from agents.causes import lost_first
from agents.records import Record
from magenv.params import require

Floats = NDArray[np.float64]
Interval = tuple[float, float]

CONFIDENCE = 0.95
_RESAMPLES = 9999


@dataclass(frozen=True)
class Episode:
    """Scalars of one episode, in the units of reports."""

    controller: str
    scenario: str
    plant: str
    n_epm: int
    control_hz: float
    action: str
    seed: int
    success: bool
    loss: str
    position_error_mm: float
    """Mean over both robots and all substeps until the end or the loss."""
    heading_error_deg: float
    """Absolute, mean likewise."""
    position_error_instant_mm: float
    """Mean over both robots and the ends of the holds."""
    heading_error_instant_deg: float
    min_separation_mm: float
    loss_of_control_s: float | None
    separation_before_loss_mm: float | None
    """At the last instant at which both robots were near their references, where control was lost later."""
    lost_first: str | None
    """What was lost before control was, one of ``causes.CAUSES``; None where control was kept."""
    lost_first_s: float | None
    """From when on; None for ``other``, too."""
    control_step_ms: float
    """Median wall time of a call of ``predict``."""


@dataclass(frozen=True)
class Summary:
    """One controller on one scenario: a row of ``summary.json``; null where there is nothing to average."""

    controller: str
    scenario: str
    plant: str
    n_epm: int
    control_hz: float
    action: str
    seed: int
    """Of the first episode."""
    episodes: int
    success_rate: float
    success_rate_ci: Interval
    position_error_mm: float | None
    """Mean over the successful episodes; so are the next five."""
    position_error_mm_ci: Interval | None
    heading_error_deg: float | None
    heading_error_deg_ci: Interval | None
    position_error_instant_mm: float | None
    heading_error_instant_deg: float | None
    position_error_until_end_mm: float
    """Mean over all episodes, each until its end or its loss of control."""
    position_error_until_end_mm_ci: Interval
    min_separation_mm: float
    """Median over all episodes."""
    loss_of_control_s: float | None
    """Median over the lost episodes; so is the next."""
    separation_before_loss_mm: float | None
    lost_first: dict[str, int]
    """How many of the lost episodes lost what first (see ``causes``), the most frequent first; empty if none."""
    control_step_ms_p50: float
    """Percentiles over all calls of ``predict``."""
    control_step_ms_p99: float


def measure(record: Record) -> Episode:
    """Return the scalars of one episode."""
    lost, first = not record.success, lost_first(record)
    tracked = record.separation_tracked_m
    return Episode(
        controller=record.controller,
        scenario=record.scenario,
        plant=record.plant,
        n_epm=record.n_epm,
        control_hz=record.control_hz,
        action=record.action,
        seed=record.seed,
        success=record.success,
        loss=record.loss,
        position_error_mm=1e3 * float(np.average(record.position_error_m, weights=record.substeps)),
        heading_error_deg=math.degrees(np.average(record.heading_error_rad, weights=record.substeps)),
        position_error_instant_mm=1e3 * float(np.mean(record.position_error_end_m)),
        heading_error_instant_deg=math.degrees(np.mean(record.heading_error_end_rad)),
        min_separation_mm=1e3 * float(np.min(record.separation_min_m)),
        loss_of_control_s=record.loss_time_s,
        separation_before_loss_mm=1e3 * tracked if lost and tracked is not None else None,
        lost_first=None if first is None else first.what,
        lost_first_s=None if first is None else first.time_s,
        control_step_ms=float(np.median(record.step_ms)),
    )


def by_scenario(records: list[Record]) -> dict[str, list[Record]]:
    """Return the records of each scenario, in order of appearance."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(record.scenario, []).append(record)
    return groups


def by_controller(records: list[Record]) -> dict[str, list[Record]]:
    """Return the records of each controller, in order of appearance."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(record.controller, []).append(record)
    return groups


def summarise(records: list[Record]) -> list[Summary]:
    """Return one row per scenario and controller.

    The records share plant, number of EPMs and control rate; there is one per controller, scenario and seed.
    """
    keys = [(record.controller, record.scenario, record.seed) for record in records]
    twice = [key for key in dict.fromkeys(keys) if keys.count(key) > 1]
    require(not twice, "records", "one per controller, scenario and seed", twice)
    rows = []
    for of_scenario in by_scenario(records).values():
        rows += [_summary(episodes) for episodes in by_controller(of_scenario).values()]
    return rows


def _summary(records: list[Record]) -> Summary:
    episodes = [measure(record) for record in records]
    kept = [episode for episode in episodes if episode.success]
    position = [episode.position_error_mm for episode in kept]
    heading = [episode.heading_error_deg for episode in kept]
    until_end = [episode.position_error_mm for episode in episodes]
    step_ms = np.concatenate([record.step_ms for record in records])
    first = episodes[0]
    return Summary(
        controller=first.controller,
        scenario=first.scenario,
        plant=first.plant,
        n_epm=first.n_epm,
        control_hz=first.control_hz,
        action=first.action,
        seed=min(episode.seed for episode in episodes),
        episodes=len(episodes),
        success_rate=len(kept) / len(episodes),
        success_rate_ci=rate_interval(len(kept), len(episodes)),
        position_error_mm=_mean(position),
        position_error_mm_ci=mean_interval(position) if kept else None,
        heading_error_deg=_mean(heading),
        heading_error_deg_ci=mean_interval(heading) if kept else None,
        position_error_instant_mm=_mean([episode.position_error_instant_mm for episode in kept]),
        heading_error_instant_deg=_mean([episode.heading_error_instant_deg for episode in kept]),
        position_error_until_end_mm=float(np.mean(until_end)),
        position_error_until_end_mm_ci=mean_interval(until_end),
        min_separation_mm=float(np.median([episode.min_separation_mm for episode in episodes])),
        loss_of_control_s=_median([episode.loss_of_control_s for episode in episodes]),
        separation_before_loss_mm=_median([episode.separation_before_loss_mm for episode in episodes]),
        lost_first=dict(Counter(episode.lost_first for episode in episodes if episode.lost_first).most_common()),
        control_step_ms_p50=float(np.percentile(step_ms, 50)),
        control_step_ms_p99=float(np.percentile(step_ms, 99)),
    )


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _median(values: list[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.median(present)) if present else None


def mean_interval(values: list[float]) -> Interval:
    """Return the 95 % bootstrap interval of the mean (percentile method, always the same resamples).

    One value alone, or equal values, tell nothing of their spread: the interval is then that value.
    """
    if min(values) == max(values):
        return values[0], values[0]
    resampling = np.random.default_rng(0)
    result = bootstrap(
        (values,), np.mean, n_resamples=_RESAMPLES, confidence_level=CONFIDENCE, method="percentile", rng=resampling
    )
    low, high = result.confidence_interval
    return float(low), float(high)


def rate_interval(successes: int, episodes: int) -> Interval:
    """Return the 95 % Wilson interval of a success rate, which is meaningful at 0 and 100 % too."""
    interval = binomtest(successes, episodes).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def typical(records: list[Record]) -> Record:
    """Return the episode in the middle: ordered by how long control was kept, then by position error."""
    ordered = sorted(
        records,
        key=lambda record: (
            math.inf if record.loss_time_s is None else record.loss_time_s,
            -measure(record).position_error_mm,
        ),
    )
    return ordered[(len(ordered) - 1) // 2]
