"""How speed is measured: contestants in turns, A B A B ..., each on its own cores; medians of the rounds."""

from __future__ import annotations

import gc
import importlib.util
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

EXTRA = 'python -m pip install -c constraints.txt -e ".[bench]"'
"""How to get the peers."""


@dataclass(frozen=True)
class Effort:
    """How much is measured."""

    repeats: int = 7
    """Rounds in which all contestants take their turn."""
    envs: int = 4096
    """Environments of a batch."""
    steps: int = 50
    """Steps of a batch in a turn."""
    recorded: int = 16
    """Different episodes among those under control."""
    scalar_steps: int = 10_000
    """Steps of a single environment in a turn."""
    pairs: int = 100_000
    """Dipoles and points."""
    rollout_envs: int = 64
    """Environments under PPO."""
    rollout_steps: int = 32
    """Steps of each of them in a turn."""
    targets: int = 20
    """Targets of a class of allocation."""
    batch: int = 1000
    """Targets in one call."""
    cold_starts: int = 3
    """New processes without compiled kernels on disk, one after the other."""
    processes: int = 8
    """Processes that start at once."""
    memory_steps: int = 1_000_000
    """Steps over which memory must not grow."""
    memory_resets: int = 100_000
    """Resets over which memory must not grow."""


def _nothing() -> None:
    """Prepare nothing."""


@dataclass(frozen=True)
class Contestant:
    """Something that does a fixed amount of work when it is run."""

    run: Callable[[], object]
    units: int
    """Amount of work: steps, pairs, ..."""
    prepare: Callable[[], object] = _nothing
    """Called before every turn; takes no part in the time."""
    cores: int = 1


@dataclass(frozen=True)
class Times:
    """Seconds per unit of work of every contestant in every round."""

    of: Mapping[str, Floats]

    def seconds(self, name: str) -> float:
        """Return the median seconds per unit."""
        return float(np.median(self.of[name]))

    def rate(self, name: str) -> float:
        """Return the median units per second."""
        return 1.0 / self.seconds(name)

    def speedup(self, name: str, peer: str) -> float:
        """Return how many times faster than the peer: the median over the rounds, which slow hours leave alone."""
        return float(np.median(self.of[peer] / self.of[name]))

    def fastest(self, prefix: str) -> str:
        """Return which of the contestants whose names begin so has the best median."""
        return min((name for name in self.of if name.startswith(prefix)), key=self.seconds)


def side_by_side(contestants: Mapping[str, Contestant], repeats: int) -> Times:
    """Warm all contestants up, then run them in turns."""
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for turn in range(repeats + 1):
        gc.collect()
        for name, contestant in contestants.items():
            with on_cores(contestant.cores):
                contestant.prepare()
                before = time.perf_counter()
                contestant.run()
                took = time.perf_counter() - before
            if turn > 0:
                times[name].append(took / contestant.units)
        tell(f"round {turn} of {repeats}: {len(contestants)} contestants")
    return Times({name: np.array(values) for name, values in times.items()})


@contextmanager
def on_cores(count: int) -> Iterator[None]:
    """Keep this thread, and threads it makes, on the first ``count`` of its cores, where the system can."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def installed(package: str) -> bool:
    """Return whether a peer is there."""
    return importlib.util.find_spec(package) is not None


def tell(progress: str) -> None:
    """Tell on stderr what is done, in place on a terminal."""
    end = "\033[K\r" if sys.stderr.isatty() else "\n"
    print(f"  {progress}", end=end, file=sys.stderr, flush=True)
