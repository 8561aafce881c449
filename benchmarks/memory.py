"""Memory of a process of its own over many steps and resets."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import gymnasium
import numpy as np

from benchmarks.measure import Effort, tell
from benchmarks.policies import make_batch
from benchmarks.table import LeftOut, Limit, Line, Row
from magenv import ENV_ID
from magenv.episodes import Settings

TITLE = "Memory"

Work = Literal["steps of make", "resets of make", "steps of make_vec"]
FLAT_B = 1e6
"""Growth over the whole work that still counts as flat."""
SAMPLES = 40
STATM = Path("/proc/self/statm")


def resident_b() -> int:
    """Return the memory in RAM of this process in bytes."""
    gc.collect()
    return int(STATM.read_text(encoding="utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE")


def growth(work: Work, units: int, envs: int) -> tuple[float, float]:
    """Return the growth in bytes over the work, by a line through the samples after warm-up, and the last sample."""
    do, at_once = _work(work, envs)
    chunk = max(units // at_once // SAMPLES, 1)
    do(max(chunk // 2, 2))  # warm up
    samples = []
    for _ in range(SAMPLES):
        do(chunk)
        samples.append(resident_b())
    done = at_once * chunk * np.arange(SAMPLES)
    return float(np.polyfit(done, samples, 1)[0] * units), float(samples[-1])


def _work(work: Work, envs: int) -> tuple[Callable[[int], None], int]:
    """Return a function that does so much of the work, and how much of it it does at once."""
    if work == "steps of make_vec":
        batch = make_batch(Settings(), envs)
        batch.reset(seed=0)

        def steps_at_once(count: int) -> None:
            for _ in range(count):
                batch.step(batch.action_space.sample())

        return steps_at_once, envs
    env = gymnasium.make(ENV_ID, disable_env_checker=True)
    env.reset(seed=0)

    def steps(count: int) -> None:
        for _ in range(count):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()

    def resets(count: int) -> None:
        for _ in range(count):
            env.reset()

    return (steps if work == "steps of make" else resets), 1


def measure(effort: Effort) -> Iterator[Line]:
    """Measure all of this part, each work in a process of its own."""
    if not STATM.is_file():
        yield LeftOut("growth of memory", f"{STATM} is not there")
        return
    works: tuple[tuple[Work, int], ...] = (
        ("steps of make", effort.memory_steps),
        ("resets of make", effort.memory_resets),
        ("steps of make_vec", effort.memory_steps),
    )
    for work, units in works:
        tell(f"{units:,} {work}")
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            grown, last = pool.submit(growth, work, units, min(effort.envs, 1024)).result()
        note = f"{last / 1e6:.0f} MB at the end; negative: shrinks"
        what = f"growth over {units:,} {work}"
        yield Row(what, grown, "B", wanted=Limit(FLAT_B, "B", at_least=False), note=note)
