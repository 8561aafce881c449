"""The records of the study, put in order: who was measured, on what, and the numbers that tables and figures tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agents import catalogue
from agents.statistics import probability_of_improvement
from agents.study import trainings
from agents.study.entries import USUAL, Entry, Made, Outcomes, Where, load_all
from agents.study.trainings import MAIN, Training, check_told
from magenv.params import require

Floats = NDArray[np.float64]
OfEpisodes = Callable[[Outcomes], float]


@dataclass(frozen=True)
class Measured:
    """An agent with all its seeds, or a controller."""

    name: str
    entries: tuple[Entry, ...]
    """One per seed, in their order; one of a controller."""
    training: Training | None
    """None of a controller."""

    @property
    def label(self) -> str:
        """Name, and what is to be known of it: that it ships, and the setting where it is not the usual one."""
        where = self.where
        notes = ["as it ships"] if self.training is None and self.name in catalogue.shipped() else []
        if where != USUAL:
            notes += [where.plant, f"{where.n_epm} EPMs", f"{where.control_hz:g} Hz"]
        return f"{self.name} ({', '.join(notes)})" if notes else self.name

    @property
    def where(self) -> Where:
        """In which environment it was measured."""
        return self.entries[0].where

    @property
    def group(self) -> str:
        """Of the training; controllers are of the main one."""
        return MAIN if self.training is None else self.training.group

    @property
    def made(self) -> tuple[Made, ...]:
        """The trainings, one per seed; none of a controller."""
        return tuple(entry.training for entry in self.entries if entry.training is not None)

    def measured_on(self, scenarios: Sequence[str]) -> bool:
        """Return whether all these scenarios were measured."""
        return all(scenario in entry.outcomes for entry in self.entries for scenario in scenarios)

    def per_seed(self, scenario: str, of_episodes: OfEpisodes) -> Floats:
        """Return a number of each seed's episodes (seeds,)."""
        return np.array([of_episodes(entry.outcomes[scenario]) for entry in self.entries])

    def matrix(self, scenarios: Sequence[str], of_episodes: OfEpisodes) -> Floats:
        """Return a number of each seed's episodes on each scenario (seeds, scenarios)."""
        return np.stack([self.per_seed(scenario, of_episodes) for scenario in scenarios], axis=1)

    def errors(self, scenarios: Sequence[str], column: str) -> Floats:
        """Return a column of all episodes (seeds, scenarios * episodes), infinite where control was lost."""
        rows = []
        for entry in self.entries:
            chosen = [entry.outcomes[scenario] for scenario in scenarios]
            rows.append(np.concatenate([np.where(c.success, getattr(c, column), np.inf) for c in chosen]))
        return np.array(rows)


def success_rate(outcomes: Outcomes) -> float:
    """Return the share of episodes in which control was kept."""
    return float(np.mean(outcomes.success))


def least_separation(outcomes: Outcomes) -> float:
    """Return the least separation that the robots came to (mm), median over all episodes."""
    return float(np.median(outcomes.min_separation_mm))


def mean_kept(column: str) -> OfEpisodes:
    """Return what takes the mean of a column over the successful episodes; NaN where there is none."""

    def mean(outcomes: Outcomes) -> float:
        kept = np.array(getattr(outcomes, column))[np.array(outcomes.success)]
        return float(np.mean(kept)) if len(kept) else float("nan")

    return mean


def mean_until_end(column: str) -> OfEpisodes:
    """Return what takes the mean of a column over all episodes, each until its end or its loss of control."""
    return lambda outcomes: float(np.mean(getattr(outcomes, column)))


def improvement(agent: Measured, controller: Measured, scenario: str) -> Floats:
    """Return of each seed the chance to err less than a controller on the same episode (seeds,).

    By the position error; lost episodes are the worst, and as bad as each other.
    """
    theirs = -controller.errors([scenario], "position_error_mm")
    mine = -agent.errors([scenario], "position_error_mm")
    return probability_of_improvement(mine[:, None], theirs)


def collect(store: Path) -> list[Measured]:
    """Return all that the store holds: controllers first, agents in the order of the study.

    Raises
    ------
    ValueError
        If a record is damaged, of an unknown agent or controller, of a training that the study has otherwise, or of
        other episodes than the others.
    """
    entries = load_all(store)
    known = [*catalogue.names(), *trainings.names()]
    for entry in entries:
        path = store / entry.file
        require(entry.name in known, str(path), "of a training of the study or a controller of evaluate.py", entry.name)
        agent = entry.name in trainings.names()
        require(agent == (entry.training is not None), str(path), "an agent's if it is of a training", entry.name)
        if entry.training is not None:
            config = trainings.training(entry.name).of_seed(entry.training.seed)
            check_told(entry.training.config, config, str(path))
            wanted = (Where(config.plant, config.n_epm, config.control_hz), config.settings.action)
            require(
                (entry.where, entry.action) == wanted, str(path), f"measured in {wanted}", (entry.where, entry.action)
            )
    _check_episodes(entries, store)
    measured = []
    for name in known:
        own = [entry for entry in entries if entry.name == name]
        for where in dict.fromkeys(entry.where for entry in own):
            chosen = [entry for entry in own if entry.where == where]
            chosen.sort(key=lambda entry: -1 if entry.training is None else entry.training.seed)
            alike = {tuple(entry.outcomes) for entry in chosen}
            require(len(alike) == 1, str(store / name), "of the same scenarios with all seeds", sorted(alike))
            training = trainings.training(name) if name in trainings.names() else None
            measured.append(Measured(name, tuple(chosen), training))
    return measured


def _check_episodes(entries: Sequence[Entry], store: Path) -> None:
    """Raise ``InputError`` unless all were measured on the same episodes."""
    wanted: dict[str, tuple[int, int]] = {}
    for entry in entries:
        for scenario, outcomes in entry.outcomes.items():
            first, count = episodes = outcomes.seed, len(outcomes.success)
            usual = wanted.setdefault(scenario, episodes)
            must = f"of {usual[1]} episodes of {scenario} from seed {usual[0]}, as the others"
            require(episodes == usual, str(store / entry.file), must, f"{count} from seed {first}")


def scenarios_of(measured: Sequence[Measured]) -> list[str]:
    """Return all scenarios of any of them, those of the study first."""
    found = dict.fromkeys(scenario for one in measured for scenario in one.entries[0].outcomes)
    return sorted(found, key=lambda name: [*trainings.SCENARIOS, *found].index(name))


def groups(measured: Sequence[Measured]) -> list[str]:
    """Return the groups of agents that are not the main one, in the order of the study."""
    return [group for group in dict.fromkeys(one.group for one in measured if one.training) if group != MAIN]


def beside(measured: Sequence[Measured], group: str) -> list[Measured]:
    """Return the agents of a group, behind what they are compared with.

    That is what their trainings name, or the agents of the main group that have the same algorithm in the same
    environments; and, where the environment is not the usual one, the controllers there.
    """
    own = [one for one in measured if one.training is not None and one.group == group]
    if group == MAIN:
        return own
    algos = {one.training.config.algo for one in own if one.training is not None}
    places = {one.where for one in own}
    controllers = [one for one in measured if one.training is None and one.where in places - {USUAL}]
    named = {name for one in own if one.training is not None for name in one.training.compared_with}
    if named:
        others = [one for one in measured if one.name in named and one.group != group]
    else:
        main = [one for one in beside(measured, MAIN) if one.training is not None and one.training.config.algo in algos]
        others = [one for one in main if one.where in places]
    return [*controllers, *others, *own]
