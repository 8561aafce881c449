"""On what, with what, when and how the figures were measured."""

from __future__ import annotations

import os
import platform
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version

from magenv.origin import cpu

PACKAGES = ("magenv", "numba", "llvmlite", "numpy", "scipy", "gymnasium", "torch", "stable_baselines3")
PEERS = ("envpool", "mujoco", "magpylib", "casadi")


def versions() -> str:
    """Return Python's version and those of the packages that count, where they are installed."""
    found = [f"Python {platform.python_version()}"]
    for package in (*PACKAGES, *PEERS):
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)


def head(command: str, repeats: int) -> str:
    """Return the page's first paragraphs."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = f", load average {os.getloadavg()[0]:.1f} at the end" if hasattr(os, "getloadavg") else ""
    return f"""# Benchmarks

Written by `{command}`.

* When: {datetime.now(UTC):%Y-%m-%d %H:%M} UTC
* Machine: {cpu()}, {cores} cores, {platform.system()} {platform.release()}{load}
* Versions: {versions()}
* Method: ours and the peers in turns in one process (start and memory in processes of their own), each pinned to one
  core unless said, one thread of BLAS and OpenMP, compiled and warmed up before; medians of {repeats} rounds. A ratio
  is the median of the rounds': how many times faster (or better) than the peer. Ratios travel between machines;
  absolute figures do not."""
