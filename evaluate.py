"""Run controllers on the same episodes and report: ``python evaluate.py --help``."""

from __future__ import annotations

import os
import signal
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: two threads on two cores spin
signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while modules load ends the process without a word

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from agents.catalogue import controller, defaults, names
from agents.comparison import compare
from agents.ladder import Ladder
from agents.ladder_run import run_ladder
from agents.robustness import Sweep
from agents.robustness_run import run_robustness
from magenv.command import command_line, friendly, parse
from magenv.params import require


@dataclass(frozen=True)
class EvaluateConfig:
    """Run controllers on the same episodes; write summary.json, the episodes' records, figures and animations."""

    controllers: tuple[str, ...] | None = None
    """Names (see --list) or folders of trained models; by default baseline, tuned and the shipped agents that fit."""
    scenarios: tuple[str, ...] | None = None
    """approach-<s>, approach-<s>-anti, crossing-<s>, meeting-<s>, eight-<s>, still-<s> with s in mm, random or
    random-<s>; by default approach-60, and but for --robustness approach-30."""
    plant: str = "paper"
    """Plant acted on; parameters may be changed, as in arm:latency_s=0.05,mismatch=0."""
    n_epm: int = 2
    """Number of external magnets, 2 or 3."""
    control_hz: float = 2.0
    """Control rate."""
    episodes: int = 20
    """Episodes per controller and scenario."""
    seed: int = 0
    """Of the first episode; the others follow."""
    ladder: Literal["none", "parallel", "anti"] = "none"
    """Climb down the ladder of separations instead of the scenarios, with parallel or opposite headings."""
    robustness: bool = False
    """Score success on plants that are worse than the one for which the controllers are made: noise, latency, mismatch,
    disturbance, slow EPMs."""
    jobs: int = 1
    """Processes that share the episodes of --ladder or --robustness."""
    out: Path | None = None
    """Folder of the report, by default runs/evaluate; runs/ladder or runs/robustness, where one broken off goes on."""
    list: bool = False
    """Print the known controllers, one name a line, and stop."""


def main() -> None:
    """Evaluate, report."""
    c = parse(EvaluateConfig)
    if c.list:
        print("\n".join(names()))
        return
    require(not c.robustness or c.ladder == "none", "robustness", "without --ladder", f"--ladder {c.ladder}")
    unfit: list[str] = []
    if c.controllers is None:
        chosen, unfit = defaults(c.n_epm, c.control_hz)
    else:
        chosen = [controller(name, c.n_epm, c.control_hz, c.plant) for name in c.controllers]
    if c.robustness:
        sweep = Sweep(
            c.plant, c.n_epm, c.control_hz, ("approach-60",) if c.scenarios is None else c.scenarios, c.episodes, c.seed
        )
        run_robustness(chosen, sweep, c.jobs, c.out or Path("runs/robustness"), command_line())
    elif c.ladder == "none":
        out = c.out or Path("runs/evaluate")
        scenarios = ("approach-60", "approach-30") if c.scenarios is None else c.scenarios
        compare(chosen, scenarios, c.plant, c.n_epm, c.control_hz, c.episodes, c.seed, out, command_line())
    else:
        ladder = Ladder(c.plant, c.n_epm, c.control_hz, c.ladder == "anti", c.episodes, c.seed)
        run_ladder(chosen, ladder, c.jobs, c.out or Path("runs/ladder"), command_line())
    for reason in unfit:
        print(f"left out: {reason}", file=sys.stderr)


if __name__ == "__main__":
    friendly(main)
