"""Episodes of one controller, shared among processes."""

from __future__ import annotations

import functools
from collections.abc import Callable

from joblib import Parallel, delayed, parallel_config

from agents import catalogue
from agents.controller import Controller
from agents.records import Record
from agents.rollout import run


def run_shared(
    controller: Controller,
    scenario: str,
    plant: str,
    n_epm: int,
    control_hz: float,
    episodes: int,
    seed: int,
    jobs: int = 1,
    progress: Callable[[Record], object] | None = None,
    made_for: str | None = None,
) -> list[Record]:
    """Return what ``rollout.run`` returns, the episodes shared among ``jobs`` processes.

    With more than one, the controller is made anew in each by its name, for the plant ``made_for`` (by default the one
    acted on). Results do not depend on it, but for the wall times.
    """
    if jobs == 1:
        return run(controller, scenario, plant, n_epm, control_hz, episodes, seed, progress)
    records = []
    one = functools.partial(_episode, controller.name, made_for or plant, scenario, plant, n_epm, control_hz)
    with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1):
        for record in Parallel(return_as="generator")(delayed(one)(own) for own in range(seed, seed + episodes)):
            records.append(record)
            if progress is not None:
                progress(record)
    return records


def _episode(name: str, made_for: str, scenario: str, plant: str, n_epm: int, control_hz: float, seed: int) -> Record:
    """Return the record of one episode, in a process that has nothing but the controller's name."""
    controller = _controller(name, n_epm, control_hz, made_for)
    (record,) = run(controller, scenario, plant, n_epm, control_hz, episodes=1, seed=seed)
    return record


@functools.lru_cache(maxsize=1)
def _controller(name: str, n_epm: int, control_hz: float, plant: str) -> Controller:
    return catalogue.controller(name, n_epm, control_hz, plant)
