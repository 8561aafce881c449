"""Tables of the study, in Markdown."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from agents.configs import TrainConfig
from agents.report import three_digits
from agents.statistics import interquartile_mean, interval
from agents.study.entries import USUAL, Entry
from agents.study.evidence import (
    Measured,
    OfEpisodes,
    improvement,
    least_separation,
    mean_kept,
    mean_until_end,
    success_rate,
)
from agents.study.trainings import MAIN, SCENARIOS, as_told
from magenv.origin import UNKNOWN

Floats = NDArray[np.float64]
Row = Sequence[str]
_DASH = "-"
COLUMNS = {"position_error_mm": "position error (mm)", "heading_error_deg": "heading error (degrees)"}


def table(head: Row, rows: Sequence[Row], texts: Sequence[int] = ()) -> list[str]:
    """Return the lines of a table: numbers to the right, the first column and those of texts to the left."""
    rule = "".join("|---" if index in (0, *texts) else "|---:" for index in range(len(head)))
    return [_line(head), f"{rule}|", *(_line(row) for row in rows)]


def _line(cells: Row) -> str:
    return "| " + " | ".join(cells) + " |"


def by_scenario(measured: Sequence[Measured], scenarios: Sequence[str]) -> list[str]:
    """Return the tables of success, errors and separation, a row per agent or controller."""
    lines = ["Success (%):", "", *_spreads(measured, scenarios, success_rate, lambda rate: f"{100 * rate:.0f}")]
    for column, title in COLUMNS.items():
        told = _spreads(measured, scenarios, mean_kept(column), three_digits)
        lines += ["", f"{title[0].upper()}{title[1:]}, mean over the successful episodes:", "", *told]
    lines += [
        "",
        "Least separation of the robots (mm), median over all episodes: who keeps it wide holds by staying away.",
    ]
    return [*lines, "", *_spreads(measured, scenarios, least_separation, three_digits)]


def _spreads(
    measured: Sequence[Measured], scenarios: Sequence[str], of_episodes: OfEpisodes, told: Callable[[float], str]
) -> list[str]:
    rows = []
    for one in measured:
        cells = [
            spread(one.per_seed(scenario, of_episodes), told) if one.measured_on([scenario]) else _DASH
            for scenario in scenarios
        ]
        rows.append([one.label, str(len(one.made)) if one.made else _DASH, *cells])
    return table(["", "seeds", *scenarios], rows)


def spread(values: Floats, told: Callable[[float], str]) -> str:
    """Return in words the median over the seeds, and least and greatest where there are several.

    Seeds without a value (NaN) are left out, and it is said how many have one.
    """
    present = values[~np.isnan(values)]
    if len(present) == 0:
        return _DASH
    text = told(float(np.median(present)))
    if len(present) > 1:
        text += f" ({told(present.min())} to {told(present.max())})"
    return text if len(present) == len(values) else f"{text}, {len(present)} of {len(values)} seeds"


def aggregates(measured: Sequence[Measured], scenarios: Sequence[str]) -> list[str]:
    """Return the table of interquartile means over seeds and scenarios, with both intervals."""
    rows = []
    for one in measured:
        if one.measured_on(scenarios):
            rates = one.matrix(scenarios, success_rate)
            cells = [f"{100 * float(rates.mean()):.0f}"]
            for column in COLUMNS:
                cells += _aggregate(one.matrix(scenarios, mean_until_end(column)))
            rows.append([one.label, *cells])
    head = [
        part for title in COLUMNS.values() for part in (f"IQM of {title}", "95 %, per scenario", "95 %, whole seeds")
    ]
    return table(["", "success (%), mean", *head], rows)


def _aggregate(scores: Floats) -> list[str]:
    value = three_digits(float(interquartile_mean(scores)))
    if len(scores) == 1:
        return [value, _DASH, _DASH]
    bounds = [interval(interquartile_mean, scores, whole_runs=whole) for whole in (False, True)]
    return [value, *(f"{three_digits(low)} to {three_digits(high)}" for low, high in bounds)]


def improvements(measured: Sequence[Measured], scenarios: Sequence[str]) -> list[str]:
    """Return the table of the chances that an agent errs less than a controller of the same setting.

    Of the agents of the main group, and of those of settings that it does not come to.
    """
    rows = []
    controllers = [one for one in measured if one.training is None]
    agents = [one for one in measured if one.training is not None]
    for agent in (one for one in agents if one.group == MAIN or one.where != USUAL):
        for controller in (one for one in controllers if one.where == agent.where):
            both = [agent.measured_on([s]) and controller.measured_on([s]) for s in scenarios]
            cells = [
                _chance(improvement(agent, controller, scenario)) if fits else _DASH
                for scenario, fits in zip(scenarios, both, strict=True)
            ]
            rows.append([f"{agent.label} over {controller.label}", *cells])
    return table(["", *scenarios], rows)


def _chance(chances: Floats) -> str:
    text = f"{chances.mean():.2f}"
    if len(chances) == 1:
        return text
    low, high = interval(lambda resampled: resampled.mean(axis=(-2, -1)), chances[:, None], whole_runs=True)
    return f"{text} ({low:.2f} to {high:.2f})"


def meanings(measured: Sequence[Measured]) -> list[str]:
    """Return what each agent is there for, and what of its configuration is not the default."""
    rows = []
    for one in measured:
        if one.training is not None:
            told, usual = as_told(one.training.config), as_told(TrainConfig(algo=one.training.config.algo))
            other = [f"`{name}` {value}" for name, value in told.items() if value != usual[name]]
            rows.append([one.label, one.training.shows, ", ".join(other) or "the defaults"])
    return table(["agent", "shows", "differs from the defaults of its algorithm in"], rows, texts=(1, 2))


def places(measured: Sequence[Measured]) -> list[str]:
    """Return the commits and machines by which anything was trained or measured, each once."""
    return list(dict.fromkeys(place for entry in _entries(measured) for place in (*_trained(entry), _measured(entry))))


def _entries(measured: Sequence[Measured]) -> list[Entry]:
    return [entry for one in measured for entry in one.entries]


def _trained(entry: Entry) -> tuple[str, ...]:
    return () if entry.training is None else entry.training.origins or (UNKNOWN,)


def _measured(entry: Entry) -> str:
    return f"{entry.commit} on {entry.machine}"


def packages(measured: Sequence[Measured]) -> list[str]:
    """Return the sets of packages with which entries were made, each once."""
    return list(dict.fromkeys(map(_packages, _entries(measured))))


def _packages(entry: Entry) -> str:
    told = _versions(entry.versions)
    trained = {} if entry.training is None else entry.training.versions
    others = {name: number for name, number in trained.items() if entry.versions.get(name, number) != number}
    return f"{told}; trained with {_versions(others)}" if others else told


def _versions(versions: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {number}" for name, number in versions.items())


def _measures(entry: Entry) -> str:
    """Return the command that measures a controller."""
    where, options = entry.where, []
    if where != USUAL:
        options = ["--plant", where.plant, "--n-epm", str(where.n_epm), "--control-hz", f"{where.control_hz:g}"]
    if tuple(entry.outcomes) != SCENARIOS:
        options += ["--scenarios", *entry.outcomes]
    return shlex.join(["python", "-m", "agents.study", "controllers", entry.name, *options])


def provenance(measured: Sequence[Measured]) -> list[str]:
    """Return how every record came about, a row each, with the numbers of its places and packages."""
    where, what, rows = places(measured), packages(measured), []
    for one in measured:
        for entry in one.entries:
            made = entry.training
            command = _measures(entry) if made is None else made.command
            training = (
                [_DASH] * 4
                if made is None
                else [
                    str(made.seed),
                    f"{made.steps:,}",
                    f"{made.seconds / 60:.1f}",
                    ", ".join(str(1 + where.index(place)) for place in _trained(entry)),
                ]
            )
            numbers = [str(1 + where.index(_measured(entry))), str(1 + what.index(_packages(entry)))]
            rows.append([one.label, *training, *numbers, f"`{command}`"])
    head = ["", "seed", "steps", "training (minutes)", "trained by", "measured by", "packages", "command"]
    return table(head, rows, texts=(7,))
