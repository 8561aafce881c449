"""Train an agent, then compare it with the paper's controller on the same episodes: ``python train.py --help``."""

from __future__ import annotations

import os
import shlex
import signal

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: two threads on two cores spin
signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while modules load ends the process without a word

from agents.catalogue import controller
from agents.checkpoints import stored_config
from agents.comparison import compare
from agents.configs import TrainConfig
from agents.learned import Learned
from agents.learning import train
from magenv.command import command_line, friendly, parse

EPISODES = 20
SCENARIOS = ("approach-60", "approach-30")


def main() -> None:
    """Train, evaluate, report."""
    config = parse(TrainConfig)
    if config.resume is not None:  # what the command line leaves open is as in the run gone on with
        config = parse(TrainConfig, stored_config(config.resume))
    folder, finished = train(config, command_line())
    if not finished:
        again = f"python train.py --resume {shlex.quote(str(folder))}"
        print(f"Stopped early; model: {folder / 'model'}, to go on: {again}")
        raise KeyboardInterrupt
    agent = Learned(folder / "model")
    s = agent.settings
    corrects = [] if agent.card.residual is None else [agent.card.residual.controller]
    beside = dict.fromkeys((*corrects, "baseline", "idle", "random"))
    floor = [controller(name, s.n_epm, s.control_hz, s.plant) for name in beside]
    compare([agent, *floor], SCENARIOS, s.plant, s.n_epm, s.control_hz, EPISODES, 0, folder, command_line())


if __name__ == "__main__":
    friendly(main)
