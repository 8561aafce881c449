"""Typed configuration of a training; the text under a field is its help on the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from magenv.actions import ActionMode
from magenv.episodes import Settings
from magenv.params import require
from magenv.task import Frame, ObservationMode

Algo = Literal["ppo", "sac"]
_WIDTH_MAX, _DEPTH_MAX = 4096, 8


def check_net(net: tuple[int, ...]) -> None:
    """Raise ``ValueError`` unless ``net`` is a sensible sequence of layer widths."""
    fits = 1 <= len(net) <= _DEPTH_MAX and all(isinstance(w, int) and 1 <= w <= _WIDTH_MAX for w in net)
    require(fits, "net", f"1 to {_DEPTH_MAX} widths from 1 to {_WIDTH_MAX}", net)


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        require(math.isfinite(value) and value > 0, name, "a positive, finite number", value)


@dataclass(frozen=True)
class PPOConfig:
    """Hyperparameters of proximal policy optimisation."""

    n_envs: int = 128
    """Episodes side by side."""
    n_steps: int = 32
    """Steps of each episode between updates."""
    batch_size: int = 1024
    """Samples of a gradient step."""
    n_epochs: int = 6
    """Passes over the samples of an update."""
    learning_rate: float = 6e-4
    """At the start; it falls linearly to a tenth."""
    gamma: float = 0.9
    """Discount per control step: what a command does shows within few holds."""
    gae_lambda: float = 0.9
    """Weight of long returns in the advantage."""
    log_std_init: float = -1.6
    """Logarithm of the policy's standard deviation at the start."""
    net: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers of policy and value function."""

    def __post_init__(self) -> None:
        check_net(self.net)
        _check_positive(
            n_envs=self.n_envs,
            n_steps=self.n_steps,
            batch_size=self.batch_size,
            n_epochs=self.n_epochs,
            learning_rate=self.learning_rate,
        )


@dataclass(frozen=True)
class SACConfig:
    """Hyperparameters of soft actor-critic."""

    n_envs: int = 32
    """Episodes side by side."""
    gradient_steps: int = 8
    """Gradient steps after each step of all episodes."""
    batch_size: int = 256
    """Samples of a gradient step."""
    learning_rate: float = 7e-4
    """Of actor, critic and temperature; it falls linearly to a tenth."""
    gamma: float = 0.9
    """Discount per control step."""
    buffer_size: int = 300_000
    """Transitions kept."""
    learning_starts: int = 5_000
    """Steps before the first gradient step."""
    net: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers of actor and critic."""

    def __post_init__(self) -> None:
        check_net(self.net)
        _check_positive(
            n_envs=self.n_envs,
            gradient_steps=self.gradient_steps,
            batch_size=self.batch_size,
            learning_rate=self.learning_rate,
            buffer_size=self.buffer_size,
        )


STEPS: dict[Algo, int] = {"ppo": 3_000_000, "sac": 200_000}
"""Environment steps of a training where none are asked for."""


@dataclass(frozen=True)
class TrainConfig:
    """Train an agent, then compare it with the paper's controller on the same episodes."""

    algo: Algo = "ppo"
    """Learning algorithm."""
    scenario: str = "random"
    """Trajectories trained on: random (the seeded family), approach-<s>, approach-<s>-anti."""
    plant: str = "paper"
    """Plant trained on."""
    n_epm: int = 2
    """Number of external magnets, 2 or 3."""
    action: ActionMode = "home"
    """What an action means: home, pose, step or wrench."""
    observation: ObservationMode = "full"
    """What the agent sees: full or errors."""
    frame: Frame = "robots"
    """Frame of the observation: robots or global."""
    control_hz: float = 2.0
    """Control rate."""
    steps: int | None = None
    """Environment steps; by default 3 million (ppo) or 200,000 (sac)."""
    seed: int = 0
    """Of networks and episodes: the same seed gives the same weights on the same machine."""
    out: Path = Path("runs/train")
    """Folder for model, checkpoints, progress.csv and report."""
    resume: Path | None = None
    """Folder of a run to go on with; its configuration counts, but for --steps and --out."""
    checkpoint_every: int = 250_000
    """Steps between checkpoints."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    sac: SACConfig = field(default_factory=SACConfig)

    def __post_init__(self) -> None:
        require(self.steps is None or self.steps > 0, "steps", "a positive whole number", self.steps)
        require(self.seed >= 0, "seed", "a whole number of at least 0", self.seed)
        _check_positive(checkpoint_every=self.checkpoint_every)

    @property
    def settings(self) -> Settings:
        """The environment."""
        return Settings(
            self.scenario, self.plant, self.n_epm, self.action, self.observation, self.frame, self.control_hz
        )

    @property
    def total_steps(self) -> int:
        """Environment steps of the whole training."""
        return self.steps if self.steps is not None else STEPS[self.algo]
