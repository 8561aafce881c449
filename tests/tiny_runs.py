"""Tiny trainings, and what their folders hold."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from agents.checkpoints import checkpoints, stored_config
from agents.configs import PPOConfig, SACConfig, TrainConfig
from agents.sb3_vec import TwoRobotsVecEnv
from agents.store import POLICY, load_card

MakeConfig = Callable[..., TrainConfig]

OPTIONS = [
    *("--ppo.n-envs", "8", "--ppo.n-steps", "16", "--ppo.batch-size", "64", "--ppo.n-epochs", "1"),
    *("--ppo.net", "16", "16", "--action", "home"),
]
"""What makes a training tiny on the command line."""
PPO_CONFIG = TrainConfig(
    action="home",
    ppo=PPOConfig(n_envs=8, n_steps=16, batch_size=64, n_epochs=2, net=(16, 16)),
    steps=512,
    checkpoint_every=128,
)
"""Four rollouts of 128 steps, a checkpoint after each."""
SAC_CONFIG = TrainConfig(
    algo="sac",
    action="home",
    sac=SACConfig(n_envs=8, batch_size=32, buffer_size=2000, learning_starts=64, gradient_steps=2, net=(16, 16)),
    steps=320,
    checkpoint_every=160,
)
CONFIGS = {"ppo": PPO_CONFIG, "sac": SAC_CONFIG}
SAVED = {
    "ppo": TrainConfig(
        action="home", ppo=PPOConfig(n_envs=8, n_steps=16, batch_size=64, n_epochs=1, net=(16, 8)), steps=128
    ),
    "sac": TrainConfig(
        algo="sac",
        action="home",
        sac=SACConfig(n_envs=8, batch_size=32, buffer_size=1000, learning_starts=64, gradient_steps=1, net=(16, 8)),
        steps=128,
    ),
}
"""Trainings of an agent that is only saved; layers of two widths."""
both = pytest.mark.parametrize("algo", ["ppo", "sac"])


def going_on(run_folder: Path, **changes: Any) -> TrainConfig:
    """Return the configuration with which to go on with a run, with changes."""
    return dataclasses.replace(stored_config(run_folder), **changes)


def tensors_of(run_folder: Path) -> dict[str, torch.Tensor]:
    """Return all tensors of a run's model."""
    return load_file(run_folder / "model" / POLICY)


def steps_of(run_folder: Path) -> list[int]:
    """Return the step counts of a run's checkpoints."""
    return [load_card(folder).steps for folder in checkpoints(run_folder)]


def rows_of(run_folder: Path) -> list[dict[str, str]]:
    """Return the rows of a run's progress.csv."""
    with (run_folder / "progress.csv").open(newline="") as file:
        return list(csv.DictReader(file, strict=True))


def total_steps(rows: list[dict[str, str]]) -> list[int]:
    """Return the column of environment steps."""
    return [int(row["time/total_timesteps"]) for row in rows]


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class Interrupter:
    """Presses Ctrl-C in the ``at``-th step, or in the first reset (0), of the environments."""

    def __init__(self, patch: pytest.MonkeyPatch, at: int) -> None:
        self._left, self._patch = at, patch
        name = "step_wait" if at else "reset"
        original = getattr(TwoRobotsVecEnv, name)

        def interrupted(env: TwoRobotsVecEnv) -> Any:
            self._left -= 1
            if self._left <= 0:
                raise KeyboardInterrupt
            return original(env)

        patch.setattr(TwoRobotsVecEnv, name, interrupted)
