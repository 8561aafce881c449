"""The ladder of separations: scenarios in which the robots come closer from rung to rung, down to where none is left.

The least separation at which control lasts is told by one number, the **survivable separation**: the smallest rung
survived. A rung is survived if at least 95 % of its episodes succeed, the median of the least separations reached is at
most 1.1 times the rung's (nobody survives by staying away), and every larger rung is survived too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.controller import Controller
from agents.metrics import Interval, Summary, summarise
from agents.records import Record
from agents.results import Table
from agents.sharing import run_shared

LADDER_MM = (60.0, 50.0, 45.0, 40.0, 35.0, 30.0, 27.5, 25.0, 22.5, 21.0, 20.0, 19.0, 18.0, 16.0, 14.0)
"""Separations of the rungs, from the top."""
SURVIVED_RATE = 0.95
"""Least rate of success on a rung that is survived."""
APART = 1.1
"""Greatest share of a rung's separation that the robots may keep on it in the median."""


@dataclass(frozen=True)
class Ladder:
    """What all rungs have in common."""

    plant: str = "paper"
    n_epm: int = 2
    control_hz: float = 2.0
    anti: bool = False
    """Whether the robots' headings are opposite to each other."""
    episodes: int = 20
    """Of each rung."""
    seed: int = 0
    """Of the first episode; the others follow."""

    def scenario(self, separation_mm: float) -> str:
        """Return the name of a rung's scenario."""
        return _scenario(separation_mm, self.anti)


def _scenario(separation_mm: float, anti: bool) -> str:
    return f"approach-{separation_mm:g}{'-anti' if anti else ''}"


@dataclass(frozen=True)
class Rung:
    """One controller on one rung: an entry of ``ladder.json``; null where there is nothing to average."""

    controller: str
    plant: str
    n_epm: int
    control_hz: float
    anti: bool
    separation_mm: float
    """Least separation of the references."""
    episodes: int
    success_rate: float
    success_rate_ci: Interval
    """95 % Wilson interval."""
    position_error_mm: float | None
    """Mean over the successful episodes; so is the next."""
    heading_error_deg: float | None
    min_separation_mm: float
    """Least separation reached, median over all episodes."""
    loss_of_control_s: float | None
    """Median over the lost episodes."""
    control_step_ms_p50: float
    """Percentiles of the wall time of ``predict``, over all calls."""
    control_step_ms_p99: float
    survived: bool
    """Success, no staying away, and every larger rung survived too."""

    @property
    def scenario(self) -> str:
        """Name of the scenario."""
        return _scenario(self.separation_mm, self.anti)


TABLE = Table("ladder", "rungs", Rung)


def climb(
    controller: Controller,
    ladder: Ladder,
    jobs: int = 1,
    known: Mapping[float, Rung] | None = None,
    keep: Callable[[Rung, list[Record]], object] | None = None,
    progress: Callable[[Record], object] | None = None,
) -> list[Rung]:
    """Climb down the ladder and return the rungs from the top.

    The second rung in succession on which no episode succeeds is the last: nothing below is run, and nothing below is
    returned.

    Parameters
    ----------
    controller : Controller
        Made for the ladder's number of EPMs and control rate.
    ladder : Ladder
        What all rungs have in common.
    jobs : int
        Processes among which the episodes of a rung are shared (see ``sharing``).
    known : mapping, optional
        Rungs of an earlier climb, by separation (mm); they are not run again.
    keep : callable, optional
        Called with each rung that was run, and its records, as soon as it is done.
    progress : callable, optional
        Called with each record.

    Raises
    ------
    ValueError
        If the ladder does not fit the controller or the environment.
    """
    rungs: list[Rung] = []
    for separation_mm in LADDER_MM:
        rung = (known or {}).get(separation_mm)
        if rung is None:
            shared = (ladder.plant, ladder.n_epm, ladder.control_hz, ladder.episodes, ladder.seed)
            records = run_shared(controller, ladder.scenario(separation_mm), *shared, jobs, progress)
            (summary,) = summarise(records)
            rung = _rung(summary, ladder.anti, separation_mm, rungs)
            if keep is not None:
                keep(rung, records)
        rungs.append(rung)
        if finished(rungs):
            break
    return rungs


def finished(rungs: Sequence[Rung]) -> bool:
    """Return whether a climb has come to its end: to the last rung, or to the second in succession without success."""
    two = [rung.success_rate for rung in rungs[-2:]]
    return two == [0.0, 0.0] or (len(rungs) > 0 and rungs[-1].separation_mm == LADDER_MM[-1])


def _rung(summary: Summary, anti: bool, separation_mm: float, above: Sequence[Rung]) -> Rung:
    """Return a rung below those ``above``."""
    here = summary.success_rate >= SURVIVED_RATE and summary.min_separation_mm <= APART * separation_mm
    return Rung(
        controller=summary.controller,
        plant=summary.plant,
        n_epm=summary.n_epm,
        control_hz=summary.control_hz,
        anti=anti,
        separation_mm=separation_mm,
        episodes=summary.episodes,
        success_rate=summary.success_rate,
        success_rate_ci=summary.success_rate_ci,
        position_error_mm=summary.position_error_mm,
        heading_error_deg=summary.heading_error_deg,
        min_separation_mm=summary.min_separation_mm,
        loss_of_control_s=summary.loss_of_control_s,
        control_step_ms_p50=summary.control_step_ms_p50,
        control_step_ms_p99=summary.control_step_ms_p99,
        survived=here and all(rung.survived for rung in above),
    )


def survivable(rungs: Sequence[Rung]) -> float | None:
    """Return the survivable separation (mm): the smallest of one controller's rungs that is survived, None if none."""
    return min((rung.separation_mm for rung in rungs if rung.survived), default=None)


def load(path: Path) -> tuple[dict[str, Any], list[Rung]]:
    """Read a ``ladder.json``: the file but its rungs, and the rungs in the order of the file (see ``Table.load``)."""
    return TABLE.load(path)
