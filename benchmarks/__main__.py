"""Measure the speed of magenv against its peers: ``python -m benchmarks --help``."""

from __future__ import annotations

import os
import shlex
import sys

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))  # before numpy and torch

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from benchmarks import allocation, dipole, env, memory, rollouts, start
from benchmarks.machine import head
from benchmarks.measure import Effort
from benchmarks.table import Line, Row, console, page
from magenv.command import friendly, parse
from magenv.files import check_output_dir, write_file
from magenv.params import require

Part = Literal["env", "dipole", "sb3", "allocation", "start", "memory"]
PARTS: dict[Part, tuple[str, Callable[[Effort], Iterator[Line]]]] = {
    "env": (env.TITLE, env.measure),
    "dipole": (dipole.TITLE, dipole.measure),
    "sb3": (rollouts.TITLE, rollouts.measure),
    "allocation": (allocation.TITLE, allocation.measure),
    "start": (start.TITLE, start.measure),
    "memory": (memory.TITLE, memory.measure),
}
PAGE = Path(__file__).parents[1] / "docs" / "benchmarks.md"


@dataclass(frozen=True)
class BenchmarkConfig:
    """Measure speed against the peers; print the figures, and write them to docs/benchmarks.md if all are measured."""

    only: tuple[Part, ...] = get_args(Part)
    """Parts to measure."""
    repeats: int = 7
    """Rounds of which the medians are taken."""
    out: Path | None = None
    """File to write; by default docs/benchmarks.md for all parts, none for some."""

    def __post_init__(self) -> None:
        require(self.repeats >= 1, "repeats", "a whole number of at least 1", self.repeats)


def main() -> None:
    """Measure, print, write."""
    config = parse(BenchmarkConfig)
    out = config.out
    if out is None and set(config.only) == set(PARTS):
        out = PAGE
    if out is not None:
        check_output_dir(out.parent)
    effort = replace(Effort(), repeats=config.repeats)
    parts: dict[str, list[Line]] = {}
    for name, (title, measure) in PARTS.items():
        if name not in config.only:
            continue
        print(f"\n{title}", flush=True)
        lines = parts[title] = []
        for line in measure(effort):
            lines.append(line)
            print("  " + (console(line) if isinstance(line, Row) else str(line)), flush=True)
    if out is not None:
        write_file(
            out, page(head(shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]]), config.repeats), parts).encode()
        )
        print(f"\nWritten: {out}")


if __name__ == "__main__":
    friendly(main)
