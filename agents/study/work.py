"""Train and measure what the study asks for, and keep it; what is kept already is not done again."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from joblib import Parallel, delayed, parallel_config

from agents import catalogue
from agents.checkpoints import checkpoints, stored_config
from agents.comparison import episode_bar
from agents.configs import TrainConfig, command_of
from agents.controller import Controller
from agents.learned import Learned
from agents.learning import train
from agents.report import versions
from agents.sharing import run_shared
from agents.store import CARD, load_card
from agents.study import entries
from agents.study.entries import CURVE_POINTS, Curve, Entry, Made, Where, outcomes_of, short
from agents.study.trainings import Training, as_told, check_told, told_of, training
from magenv import origin
from magenv.episodes import Episodes, Settings
from magenv.files import check_output_dir, write_file
from magenv.params import InputError, require

RUNS = Path("runs/study")
"""Folder of the trainings."""
_BEGUN = "begun.txt"
_COLUMNS = (
    "time/total_timesteps",
    "time/time_elapsed",
    "episodes/success_rate",
    "episodes/position_error_mm",
    "episodes/heading_error_deg",
)
"""Of progress.csv, in the order of ``Curve``."""


@dataclass(frozen=True)
class Setting:
    """What all measurements of a run of the study have in common."""

    store: Path
    episodes: int = 100
    first_seed: int = 0
    """Of the episodes."""
    jobs: int = 1


def run(name: str, seeds: Sequence[int], setting: Setting) -> Iterator[str]:
    """Train and measure an agent with every seed; yield in words what came of each, as soon as it is done.

    With more than one job, that many trainings go on side by side, each in a process of its own.

    Raises
    ------
    ValueError
        If the study has no such training, or what it has kept of it is of another configuration.
    KeyboardInterrupt
        On Ctrl-C; the same run goes on where it was.
    """
    chosen = training(name)
    alone = dataclasses.replace(setting, jobs=1)
    if setting.jobs == 1 or len(seeds) == 1:
        yield from (_run_seed(chosen, seed, alone) for seed in seeds)
        return
    with parallel_config(backend="loky", n_jobs=setting.jobs, inner_max_num_threads=1):
        yield from Parallel(return_as="generator_unordered")(delayed(_run_seed)(chosen, k, alone) for k in seeds)


def _run_seed(chosen: Training, seed: int, setting: Setting) -> str:
    """Do the work of one seed."""
    told = _kept(chosen, seed, setting.store)
    if told is not None:
        return told
    folder = RUNS / chosen.name / f"seed-{seed}"
    return evaluate(chosen, seed, _trained(chosen.of_seed(seed), folder), setting)


def _kept(chosen: Training, seed: int, store: Path) -> str | None:
    """Return in words that the record is there already, None where it is not."""
    path = store / entries.file_of(chosen.name, seed)
    if not path.exists():
        return None
    made = entries.load(path).training
    assert made is not None
    check_told(made.config, chosen.of_seed(seed), str(path))
    return f"kept: {path}"


def _trained(config: TrainConfig, folder: Path) -> Path:
    """Return the model of a training in its folder: as it stands there, gone on with, or trained anew.

    Raises
    ------
    KeyboardInterrupt
        If Ctrl-C ended the training.
    """
    found = _finished(config, folder)
    if found is not None:
        return found
    check_output_dir(folder)
    if checkpoints(folder):
        own = stored_config(folder)
        check_told(as_told(own) | {"steps": config.total_steps}, config, str(folder))
        config = dataclasses.replace(config, resume=folder)
    _note_origin(folder)
    config = dataclasses.replace(config, out=folder)
    _, finished = train(config, command_of(config))
    if not finished:
        raise KeyboardInterrupt
    return folder / "model"


def _finished(config: TrainConfig, folder: Path) -> Path | None:
    """Return the model of a training that came to its end, None where it did not; a last checkpoint serves as one."""
    for model in (folder / "model", *checkpoints(folder)[-1:]):
        if (model / CARD).is_file() and load_card(model).steps >= config.total_steps:
            return model
    return None


def _note_origin(folder: Path) -> None:
    """Note in a training's folder where it is begun or gone on with."""
    lines = [*_origins(folder), f"{origin.commit()} on {origin.machine()}"]
    write_file(folder / _BEGUN, "".join(f"{line}\n" for line in dict.fromkeys(lines)).encode())


def _origins(folder: Path) -> list[str]:
    path = folder / _BEGUN
    return path.read_text(encoding="utf-8").splitlines() if path.is_file() else []


def evaluate(chosen: Training, seed: int, model: Path, setting: Setting) -> str:
    """Measure a trained model, keep the record, and return in words where; one that is there already is kept.

    Parameters
    ----------
    chosen : Training
        What the model must have been trained as.
    seed : int
        Of the training.
    model : Path
        Folder of the model, or of the run that holds it.
    setting : Setting
        Of the measurement.

    Raises
    ------
    ValueError
        If the model is of another training or seed.
    """
    told = _kept(chosen, seed, setting.store)
    if told is not None:
        return told
    model = model if (model / CARD).is_file() else model / "model"
    card, config = load_card(model), chosen.of_seed(seed)
    check_told(told_of(card.config), config, str(model))
    require(card.steps >= config.total_steps, str(model), f"trained for {config.total_steps} steps", card.steps)
    folder = model.parents[1] if model.parent.name == "checkpoints" else model.parent
    curve = read_curve(folder / "progress.csv")
    made = Made(
        seed=seed,
        config=as_told(config),
        command=command_of(config),
        steps=card.steps,
        seconds=curve.seconds[-1],
        versions=card.versions,
        origins=tuple(_origins(folder)),
        curve=curve,
    )
    agent = Learned(model, str(model))
    return _measure(agent, chosen.name, made, config.plant, config.n_epm, config.control_hz, chosen.scenarios, setting)


def check_controllers(names: Sequence[str], where: Where, scenarios: Sequence[str]) -> None:
    """Raise ``InputError`` unless the catalogue knows all names, there, and the environment all scenarios."""
    distinct = len(scenarios) > 0 and len(set(scenarios)) == len(scenarios)
    require(distinct, "scenarios", "one or more, each once", tuple(scenarios))
    for scenario in scenarios:
        Episodes(1, Settings(scenario, where.plant, where.n_epm, control_hz=where.control_hz))
    for name in names:
        require(name in catalogue.names(), "name", f"one of the controllers ({', '.join(catalogue.names())})", name)
        catalogue.controller(name, where.n_epm, where.control_hz, where.plant)


def run_controller(name: str, setting: Setting, where: Where, scenarios: Sequence[str]) -> str:
    """Measure a controller of the catalogue, keep the record, and return in words where; one that is there is kept."""
    check_controllers([name], where, scenarios)
    path = setting.store / entries.controller_file(name, where)
    if path.exists():
        kept = tuple(entries.load(path).outcomes)
        require(kept == tuple(scenarios), "scenarios", f"{kept}, as kept in {path}", tuple(scenarios))
        return f"kept: {path}"
    controller = catalogue.controller(name, where.n_epm, where.control_hz, where.plant)
    return _measure(controller, name, None, where.plant, where.n_epm, where.control_hz, scenarios, setting)


def _measure(
    controller: Controller,
    name: str,
    made: Made | None,
    plant: str,
    n_epm: int,
    control_hz: float,
    scenarios: Sequence[str],
    setting: Setting,
) -> str:
    """Run all episodes, with a progress bar, and keep the record."""
    torch.set_num_threads(1)  # two threads on two cores spin
    check_output_dir(setting.store)
    outcomes = {}
    with episode_bar() as bar:
        task = bar.add_task("", total=len(scenarios) * setting.episodes)
        for scenario in scenarios:
            bar.update(task, description=f"{name} on {scenario}")
            shared = (scenario, plant, n_epm, control_hz, setting.episodes, setting.first_seed, setting.jobs)
            outcomes[scenario] = outcomes_of(run_shared(controller, *shared, lambda _: bar.advance(task)))
    entry = Entry(
        name=name,
        plant=plant,
        n_epm=n_epm,
        control_hz=control_hz,
        action=controller.action,
        outcomes=outcomes,
        versions=versions(),
        commit=origin.commit(),
        machine=origin.machine(),
        training=made,
    )
    return f"stored: {entries.save(entry, setting.store)}"


def read_curve(path: Path) -> Curve:
    """Return how a training went, thinned, from its progress.csv.

    Times are those in training: what a run that was gone on with had lost at the break counts for nothing.

    Raises
    ------
    ValueError
        If there is no such file, or it tells of no episode.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            read = [[_number(row.get(column)) for column in _COLUMNS] for row in csv.DictReader(file)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"Input progress must be a progress.csv of a training; instead received {str(path)!r}."
        ) from error
    rows = np.array([row for row in read if np.isfinite(row).all()])
    require(len(rows) > 0, "progress", "a progress.csv that tells of episodes", str(path))
    elapsed = rows[:, 1].copy()
    for last in np.flatnonzero(np.diff(elapsed) < 0):  # of a training that was then gone on with
        rows[last + 1 :, 1] += elapsed[last]
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, CURVE_POINTS).round().astype(int))]
    steps, *others = rows.T
    return Curve(tuple(map(int, steps)), *(tuple(short(value) for value in column) for column in others))


def _number(text: Any) -> float:
    """Return a cell's number, NaN where it has none."""
    try:
        return float(text)
    except (TypeError, ValueError):
        return math.nan
