"""Train, measure and report the agents of the study: ``python -m agents.study --help``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, Positional, subcommand

from agents.configs import command_of
from agents.study import work
from agents.study.entries import USUAL, Where, file_of
from agents.study.report import write_results
from agents.study.trainings import SCENARIOS, names, training
from magenv.command import friendly, parse
from magenv.params import is_whole, require

STORE = Path("docs/study")


@dataclass(frozen=True)
class _Measured:
    """What all that measures has in common."""

    episodes: int = 100
    """Episodes per scenario, from seed 0."""
    jobs: int = 1
    """Processes that share the work: trainings of run, episodes of the others."""
    store: Path = STORE
    """Folder of the records."""

    def __post_init__(self) -> None:
        for name in ("episodes", "jobs"):
            value = getattr(self, name)
            require(is_whole(value) and value >= 1, name, "a whole number of at least 1", value)

    @property
    def setting(self) -> work.Setting:
        """Of the measurements."""
        return work.Setting(self.store, self.episodes, jobs=self.jobs)


def _check_names(names: tuple[str, ...]) -> None:
    require(len(names) > 0 and len(set(names)) == len(names), "name", "one or more, each once", names)


@dataclass(frozen=True)
class List:
    """Print all trainings: their groups, what they show, the seeds that are kept, the command of the first seed."""

    store: Path = STORE
    """Folder of the records."""

    def do(self) -> None:
        """Print."""
        for one in map(training, names()):
            kept = [str(seed) for seed in one.seeds if (self.store / file_of(one.name, seed)).is_file()]
            print(f"{one.name} ({one.group}): {one.shows}")
            print(f"  seeds {' '.join(map(str, one.seeds))}, kept: {' '.join(kept) or 'none'}")
            print(f"  {command_of(one.of_seed(one.seeds[0]))}")


@dataclass(frozen=True)
class Run(_Measured):
    """Train agents with all their seeds, measure them and keep the records; what is kept is not done again."""

    names: Positional[tuple[str, ...]] = ()
    """Of trainings (see list)."""
    seeds: tuple[int, ...] | None = None
    """By default those of the training."""

    def do(self) -> None:
        """Train, measure, keep."""
        _check_names(self.names)
        chosen = [training(name) for name in self.names]
        if self.seeds is not None:
            fits = len(self.seeds) > 0 and len(set(self.seeds)) == len(self.seeds) and min(self.seeds) >= 0
            require(fits, "seeds", "whole numbers of at least 0, each once", self.seeds)
        for one in chosen:
            _tell(work.run(one.name, one.seeds if self.seeds is None else self.seeds, self.setting))


@dataclass(frozen=True)
class Controllers(_Measured):
    """Measure controllers and shipped agents (see evaluate.py --list) and keep the records."""

    names: Positional[tuple[str, ...]] = ()
    """Of controllers."""
    plant: str = USUAL.plant
    """As in evaluate.py; so are the next three."""
    n_epm: int = USUAL.n_epm
    """Number of external magnets, 2 or 3."""
    control_hz: float = USUAL.control_hz
    """Control rate."""
    scenarios: tuple[str, ...] = SCENARIOS
    """Trajectories."""

    def do(self) -> None:
        """Measure, keep."""
        _check_names(self.names)
        where = Where(self.plant, self.n_epm, self.control_hz)
        work.check_controllers(self.names, where, self.scenarios)
        _tell(work.run_controller(name, self.setting, where, self.scenarios) for name in self.names)


@dataclass(frozen=True, kw_only=True)
class Evaluate(_Measured):
    """Measure a model that was trained otherwise, and keep it as an agent of the study."""

    name: Positional[str]
    """Of the training that it is."""
    model: Path
    """Folder of the model, or of its run."""
    seed: int
    """Of its training."""

    def do(self) -> None:
        """Measure, keep."""
        require(self.seed >= 0, "seed", "a whole number of at least 0", self.seed)
        _tell([work.evaluate(training(self.name), self.seed, self.model, self.setting)])


@dataclass(frozen=True)
class Report:
    """Write results.md and its figures from the records alone."""

    store: Path = STORE
    """Folder of the records."""
    out: Path = Path("docs")
    """Folder of results.md."""
    ladder: tuple[Path, ...] | None = None
    """Files ladder.json of evaluate.py --ladder, for a figure of success over separation; by default those in folders
    ladder-... beside the store."""

    def do(self) -> None:
        """Read, draw, write."""
        ladders = sorted(self.store.parent.glob("ladder-*/ladder.json")) if self.ladder is None else self.ladder
        print(f"Results: {write_results(self.store, self.out, ladders)}")


@dataclass(frozen=True)
class Study:
    """Keep the experiments of the project: train agents, measure them, report."""

    what: OmitSubcommandPrefixes[
        OmitArgPrefixes[
            Annotated[List, subcommand("list")]
            | Annotated[Run, subcommand("run")]
            | Annotated[Controllers, subcommand("controllers")]
            | Annotated[Evaluate, subcommand("evaluate")]
            | Annotated[Report, subcommand("report")]
        ]
    ]


def _tell(done: Iterable[str]) -> None:
    for line in done:
        print(line, flush=True)


def main() -> None:
    """Do what is asked for."""
    parse(Study).what.do()


if __name__ == "__main__":
    friendly(main)
