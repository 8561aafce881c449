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


def _check(kind: type, low: float, high: float, **values: object) -> None:
    """Raise ``ValueError`` unless all values are finite numbers of the kind, above ``low`` and at most ``high``."""
    kinds = (int, float) if kind is float else kind
    whole, most = "whole " if kind is int else "", "" if high == math.inf else f", at most {high:g}"
    must_be = f"a {'positive ' if low == 0 else ''}{whole}number{'' if low == 0 else f' above {low:g}'}{most}"
    for name, value in values.items():
        number = isinstance(value, kinds) and not isinstance(value, bool)
        require(number and math.isfinite(value) and low < value <= high, name, must_be, value)  # type: ignore[arg-type,operator]


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
        _check(int, 0, 65_536, n_envs=self.n_envs, n_steps=self.n_steps, n_epochs=self.n_epochs)
        _check(int, 1, math.inf, batch_size=self.batch_size)
        _check(float, 0, math.inf, learning_rate=self.learning_rate)
        _check(float, 0, 1, gamma=self.gamma, gae_lambda=self.gae_lambda)
        _check(float, -20, 2, log_std_init=self.log_std_init)
        require(self.n_envs * self.n_steps > 1, "n_steps", "over 1 for a single episode", self.n_steps)


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
        _check(int, 0, 65_536, n_envs=self.n_envs, gradient_steps=self.gradient_steps, batch_size=self.batch_size)
        _check(int, 0, 10_000_000, buffer_size=self.buffer_size)
        _check(int, -1, math.inf, learning_starts=self.learning_starts)
        _check(float, 0, math.inf, learning_rate=self.learning_rate)
        _check(float, 0, 1, gamma=self.gamma)


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
    out: Path | None = None
    """Folder for model, checkpoints, progress.csv and report; by default runs/train, or that of --resume."""
    resume: Path | None = None
    """Folder of a run to go on with; its configuration counts, but for --steps and --out."""
    checkpoint_every: int = 250_000
    """Steps between checkpoints."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    sac: SACConfig = field(default_factory=SACConfig)

    def __post_init__(self) -> None:
        require(self.algo in STEPS, "algo", " or ".join(STEPS), self.algo)
        if self.steps is not None:
            _check(int, 0, math.inf, steps=self.steps)
        _check(int, -1, 2**32 - 1, seed=self.seed)
        _check(int, 0, math.inf, checkpoint_every=self.checkpoint_every)

    @property
    def folder(self) -> Path:
        """The run's folder: ``out``, or that of the run gone on with."""
        return self.out or self.resume or Path("runs/train")

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
