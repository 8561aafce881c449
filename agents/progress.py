"""What a training tells while it runs: progress bar, progress.csv."""

from __future__ import annotations

import csv
import math
import sys
from collections import deque
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat, Logger, configure

from agents.configs import TrainConfig
from agents.keeper import Keeper

_RECENT_EPISODES = 200


class Reporter(BaseCallback):
    """Progress bar with time left, training statistics."""

    def __init__(self, model: BaseAlgorithm, config: TrainConfig, keeper: Keeper) -> None:
        super().__init__()
        self.model = model
        self._config, self._keeper = config, keeper
        self._episodes: deque[dict[str, Any]] = deque(maxlen=_RECENT_EPISODES)
        self._bar = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=None),  # it gives way to the words
            MofNCompleteColumn(),
            TextColumn("{task.fields[told]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=Console(file=sys.stderr),
            refresh_per_second=2,
        )

    def _on_training_start(self) -> None:
        self._bar.start()
        if not self._bar.tasks:  # else it goes on from cloning
            self._task = self._bar.add_task(self._config.algo, total=self._config.total_steps, told="")

    def _on_step(self) -> bool:
        self._episodes.extend(info for info in self.locals["infos"] if "is_success" in info)
        self._bar.update(self._task, completed=self.num_timesteps, told=self._record())
        return True

    def _record(self) -> str:
        """Log the means of the last episodes; return what the bar tells of them and of the held-out ones."""
        score = self._keeper.score
        if not self._episodes:
            return "" if score is None else f"held out {score}"
        keys = ("is_success", "position_error_m", "heading_error_rad")
        success, position, heading = (float(np.mean([episode[key] for episode in self._episodes])) for key in keys)
        self.logger.record("episodes/success_rate", success)
        self.logger.record("episodes/position_error_mm", 1e3 * position)
        self.logger.record("episodes/heading_error_deg", math.degrees(heading))
        if score is not None:  # all would not go into a line
            return f"{success:.0%}, held out {score}"
        return f"success {success:.0%} {1e3 * position:.1f} mm {math.degrees(heading):.1f} deg"

    def close(self) -> None:
        """Stop drawing the bar, tell the logs where the training ended."""
        told = self._record()
        if self._bar.tasks:  # none where it ended before it began
            self._bar.update(self._task, told=told)
        self._bar.stop()
        self.logger.record("time/total_timesteps", self.model.num_timesteps)
        self.logger.dump(self.model.num_timesteps)
        self.logger.close()


def logger(config: TrainConfig, begun: int) -> Logger:
    """Return the logger of a run, begun at a step count.

    What stood in the progress.csv of the run gone on with, up to there, stands first in its own.
    """
    past = config.resume / "progress.csv" if config.resume is not None else None
    rows: list[dict[str, Any]] = []
    if past is not None and past.is_file():
        with past.open(newline="") as file:
            # None: what is beyond the columns, or what a row lacks.
            whole = [row for row in csv.DictReader(file) if None not in row and None not in row.values()]
        read = [{key: _number(value) for key, value in row.items() if value} for row in whole]
        rows = [row for row in read if _steps(row) <= begun]  # what came after the checkpoint is trained anew
    logger = configure(str(config.folder), _log_formats())
    for output in logger.output_formats:
        if isinstance(output, CSVOutputFormat):
            for row in rows:
                output.write(row, dict.fromkeys(row, ()))
    return logger


def _steps(row: dict[str, Any]) -> float:
    """Return a row's step count; that of a damaged row is infinite."""
    steps = row.get("time/total_timesteps")
    return steps if isinstance(steps, (int, float)) else math.inf


def _number(text: str) -> str | float | int:
    """Return a number where the text is one, as it was written."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _log_formats() -> list[str]:
    try:
        import torch.utils.tensorboard  # noqa: F401
    except ImportError:
        return ["csv"]
    return ["csv", "tensorboard"]
