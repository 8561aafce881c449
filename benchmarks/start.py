"""From a new process to the first finished step, with and without compiled kernels on disk."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.measure import Effort, tell
from benchmarks.table import Limit, Line, Row

TITLE = "Start"

ROOT = Path(__file__).parents[1]
SCALAR = """
import gymnasium, magenv
env = gymnasium.make("magenv/TwoRobots-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
"""
BATCH = """
import gymnasium, magenv
env = gymnasium.make_vec("magenv/TwoRobots-v0", num_envs=64, vectorization_mode="vector_entry_point")
env.reset(seed=0)
env.step(env.action_space.sample())
"""
IMPORT = "import magenv"
DONE = "\nprint('done', flush=True)\n"
COLD_S, WARM_S, IMPORT_S = 20.0, 1.5, 0.7
TIMEOUT_S = 600.0


def _started(code: str, cache: Path) -> subprocess.Popen[str]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", code + DONE]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment, cwd=ROOT)


def _finished(process: subprocess.Popen[str]) -> bool:
    """Wait until the process has told that it is done; return whether it did."""
    assert process.stdout is not None
    return process.stdout.readline().strip() == "done"


def seconds(code: str, cache: Path) -> float:
    """Return the time from a new process to the end of the code.

    Raises
    ------
    RuntimeError
        If the code fails.
    """
    before = time.perf_counter()
    process = _started(code, cache)
    done = _finished(process)
    took = time.perf_counter() - before
    process.communicate(timeout=TIMEOUT_S)
    if not done or process.returncode != 0:
        raise RuntimeError(f"The process that ran {code!r} has failed.")
    return took


def measure(effort: Effort) -> Iterator[Line]:
    """Measure all of this part."""
    with tempfile.TemporaryDirectory() as folder:
        for what, code in (("make and step", SCALAR), ("make_vec and step", BATCH)):
            tell(f"{what}, cold cache")
            caches = [Path(folder) / f"{what} {i}" for i in range(effort.cold_starts)]
            times = [seconds(code, cache) for cache in caches]
            note = f"median of {len(times)}: {min(times):.1f} to {max(times):.1f} s"
            cold, limit = float(np.median(times)), Limit(COLD_S, "s", False)
            yield Row(f"new process, {what}, cache cold", cold, "s", wanted=limit, note=note)
            warm = float(np.median([seconds(code, caches[0]) for _ in range(effort.repeats)]))
            yield Row(f"new process, {what}, cache warm", warm, "s", wanted=Limit(WARM_S, "s", False))
        imported = float(np.median([seconds(IMPORT, Path(folder)) for _ in range(effort.repeats)]))
        yield Row("new process, import magenv", imported, "s", wanted=Limit(IMPORT_S, "s", False))
        yield from at_once(SCALAR, effort.processes, Path(folder) / "shared")


def at_once(code: str, count: int, cache: Path) -> Iterator[Row]:
    """Let processes start at once with one cold cache among them."""
    tell(f"{count} processes at once, cold cache")
    before = time.perf_counter()
    processes = [_started(code, cache) for _ in range(count)]
    done = [_finished(process) for process in processes]
    took = time.perf_counter() - before
    for process in processes:
        process.communicate(timeout=TIMEOUT_S)
    worked = sum(told and process.returncode == 0 for told, process in zip(done, processes, strict=True))
    what, unit = f"{count} processes at once, one cold cache: those that work", f"of {count}"
    yield Row(what, worked, unit, wanted=Limit(count, unit), note=f"{took:.1f} s until the last had stepped")
