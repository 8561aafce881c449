"""Train an agent, then compare it with the paper's controller on the same episodes: ``python train.py --help``."""

from __future__ import annotations

import os
import shlex
import signal

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: two threads on two cores spin
signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while modules load ends the process without a word

from agents.catalogue import controller
from agents.checkpoints import BEST, MODEL, stored_config
from agents.comparison import compare
from agents.configs import TrainConfig
from agents.hyperparameters import search
from agents.learned import Learned
from agents.learning import train
from agents.store import load_card
from magenv.command import command_line, friendly, parse

EPISODES = 20
SCENARIOS = ("approach-60", "approach-30")


def main() -> None:
    """Train, evaluate, report."""
    config = parse(TrainConfig)
    if config.resume is not None:  # what the command line leaves open is as in the run gone on with
        config = parse(TrainConfig, stored_config(config.resume))
    if config.tune:
        search(config)
        return
    folder, finished = train(config, command_line())
    best = load_card(folder / BEST)
    print(f"Best on held-out episodes, after {best.steps} steps: {best.score} ({folder / BEST})")
    if not finished:
        again = f"python train.py --resume {shlex.quote(str(folder))}"
        print(f"Stopped early; model: {folder / MODEL}, to go on: {again}")
        raise KeyboardInterrupt
    agent = Learned(folder / MODEL)
    s = agent.settings
    corrects = [] if agent.card.residual is None else [agent.card.residual.controller]
    beside = dict.fromkeys((*corrects, "baseline", "idle", "random"))
    floor = [controller(name, s.n_epm, s.control_hz, s.plant) for name in beside]
    compare([agent, *floor], SCENARIOS, s.plant, s.n_epm, s.control_hz, EPISODES, 0, folder, command_line())


if __name__ == "__main__":
    friendly(main)
