"""Typed configuration of a training; the text under a field is its help on the command line."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from agents.classical import CLASSICAL
from agents.history import check_history
from agents.residual import Correction, teacher
from magenv.actions import ActionMode
from magenv.episodes import Settings
from magenv.params import require
from magenv.task import Frame, ObservationMode
from magenv.trajectories import FAMILY_MOST_MM, family_separation

Algo = Literal["ppo", "sac"]
Activation = Literal["relu", "tanh"]
_WIDTH_MAX, _DEPTH_MAX = 4096, 8


def check_net(net: tuple[int, ...]) -> None:
    """Raise ``InputError`` unless ``net`` is a sensible sequence of layer widths."""
    fits = 1 <= len(net) <= _DEPTH_MAX and all(type(w) is int and 1 <= w <= _WIDTH_MAX for w in net)
    require(fits, "net", f"1 to {_DEPTH_MAX} widths from 1 to {_WIDTH_MAX}", net)


def check_activation(activation: object) -> None:
    """Raise ``InputError`` unless it is a function that hidden layers may have."""
    require(activation in get_args(Activation), "activation", " or ".join(get_args(Activation)), activation)


def check_clip(clip: float) -> None:
    """Raise ``InputError`` unless observations can be cut at so many standard deviations."""
    _number(0, 1e6, clip_observation=clip)


def _whole(least: int, most: float, **values: object) -> None:
    """Raise ``InputError`` unless all values are whole numbers from ``least`` to ``most``."""
    for name, value in values.items():
        fits = isinstance(value, int) and not isinstance(value, bool) and least <= value <= most
        limits = f"of at least {least}" if most == math.inf else f"from {least} to {most:.0f}"
        require(fits, name, f"a whole number {limits}", value)


def _number(above: float, most: float, **values: object) -> None:
    """Raise ``InputError`` unless all values are finite numbers above ``above`` and at most ``most``."""
    for name, value in values.items():
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        fits = number and math.isfinite(value) and above < value <= most  # type: ignore[arg-type,operator]
        limits = f"above {above:g}" + ("" if most == math.inf else f", at most {most:g}")
        require(fits, name, f"a number {limits}", value)


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
    learning_rate: float = 5e-4
    """At the start; it falls linearly to a tenth."""
    gamma: float = 0.9
    """Discount per control step: what a command does shows within few holds."""
    gae_lambda: float = 0.9
    """Weight of long returns in the advantage."""
    log_std_init: float = -2.5
    """Logarithm of the policy's standard deviation at the start."""
    learn_std: bool = False
    """Whether it is learned as well; it then falls, and errors with it: answers to greater ones are forgotten."""
    net: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers of policy and value function."""
    activation: Activation = "relu"
    """Function of the hidden layers: relu, or tanh, which answers errors greater than usual no more than usual ones."""

    def __post_init__(self) -> None:
        check_net(self.net)
        check_activation(self.activation)
        _whole(1, 65_536, n_envs=self.n_envs, n_steps=self.n_steps, n_epochs=self.n_epochs)
        _whole(2, math.inf, batch_size=self.batch_size)
        require(type(self.learn_std) is bool, "learn_std", "true or false", self.learn_std)
        _number(0, math.inf, learning_rate=self.learning_rate)
        _number(0, 1, gamma=self.gamma, gae_lambda=self.gae_lambda)
        _number(-20, 2, log_std_init=self.log_std_init)
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
    activation: Activation = "relu"
    """Function of the hidden layers: relu or tanh."""

    def __post_init__(self) -> None:
        check_net(self.net)
        check_activation(self.activation)
        _whole(1, 65_536, n_envs=self.n_envs, gradient_steps=self.gradient_steps, batch_size=self.batch_size)
        _whole(1, 10_000_000, buffer_size=self.buffer_size)
        _whole(0, math.inf, learning_starts=self.learning_starts)
        _number(0, math.inf, learning_rate=self.learning_rate)
        _number(0, 1, gamma=self.gamma)


@dataclass(frozen=True)
class CloningConfig:
    """Hyperparameters of cloning a controller."""

    rounds: int = 10
    """After each, the policy is fitted to all that the controller has answered so far."""
    steps: int = 64
    """Of each environment in a round; episodes go on into the next."""
    led: int = 5
    """Rounds in which the controller still acts in some episodes: in all of the first, then in ever fewer."""
    epochs: int = 10
    """Passes over the answers after each round."""
    batch_size: int = 256
    """Samples of a gradient step."""
    learning_rate: float = 1e-3
    """In the first round; each of the others takes as much off, such that a tenth is left after the last."""

    def __post_init__(self) -> None:
        _whole(1, 65_536, rounds=self.rounds, epochs=self.epochs)
        _whole(1, 65_536, **{"cloning.steps": self.steps})
        _whole(0, 65_536, led=self.led)
        _whole(2, math.inf, batch_size=self.batch_size)
        _number(0, math.inf, learning_rate=self.learning_rate)


STEPS: dict[Algo, int] = {"ppo": 1_000_000, "sac": 200_000}
"""Environment steps of a training where none are asked for."""


@dataclass(frozen=True)
class TrainConfig:
    """Train an agent, then compare it with the paper's controller on the same episodes."""

    algo: Algo = "ppo"
    """Learning algorithm."""
    scenario: str = "random"
    """Trajectories trained on: random (the seeded family, robots come to 20 to 100 mm of each other), random-<s> (its
    like, from s mm on), or a shape as in evaluate.py."""
    curriculum: float | None = None
    """Separation (mm) that robots keep at first on a random family; it falls evenly to the family's own, where it comes
    after half of all steps, those of a run gone on with included."""
    plant: str = "paper"
    """Plant trained on; parameters may be changed, as in arm:latency_s=0.05,mismatch=0."""
    n_epm: int = 2
    """Number of external magnets, 2 or 3."""
    action: ActionMode | None = None
    """What an action means: home, pose, step, wrench or velocity; by default velocity, or as of the controller of
    --residual or --expert."""
    observation: ObservationMode | None = None
    """What the agent sees: full or errors; by default errors where its actions are velocities, full where they are
    others or correct a controller."""
    frame: Frame = "robots"
    """Frame of the observation: robots or global."""
    control_hz: float = 2.0
    """Control rate."""
    history: int = 1
    """How many of its episode's last observations the agent sees, side by side; one with --residual or --expert. SAC's
    buffer keeps as many of each step."""
    clip_observation: float = 10.0
    """Observations, less the mean of all so far, are cut at so many of their standard deviations."""
    residual: str | None = None
    """Name of the controller that the policy corrects (of those of evaluate.py, no learned one)."""
    residual_scale: float = 0.1
    """How far the policy may correct it, of the bounds of an action: above 0, at most 1."""
    expert: str | None = None
    """Name of a controller that the policy is cloned from before it learns by itself (of those of evaluate.py, no
    learned one; ppo alone)."""
    steps: int | None = None
    """Environment steps, those of cloning included; by default a million (ppo) or 200,000 (sac)."""
    seed: int = 0
    """Of networks and episodes: the same seed gives the same weights on the same machine."""
    out: Path | None = None
    """Folder for models, checkpoints, progress.csv and report; by default runs/train (runs/train-2, ... where it holds
    a run), that of --resume, or with --tune runs/tune."""
    resume: Path | None = None
    """Folder of a run to go on with, as it was configured; --steps, --out and --checkpoint-every may change."""
    checkpoint_every: int | None = None
    """Steps between checkpoints, at each of which the policy is judged on held-out episodes; by default a tenth of all,
    at most 250,000."""
    tune: bool = False
    """Search for hyperparameters of the algorithm instead, by trials with a tenth of the steps; needs Optuna."""
    trials: int | None = None
    """Trials of --tune; by default 20."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    sac: SACConfig = field(default_factory=SACConfig)
    cloning: CloningConfig = field(default_factory=CloningConfig)

    def __post_init__(self) -> None:
        require(self.algo in STEPS, "algo", " or ".join(STEPS), self.algo)
        if self.steps is not None:
            _whole(1, math.inf, steps=self.steps)
        _whole(0, 2**32 - 1, seed=self.seed)
        if self.checkpoint_every is not None:
            _whole(1, math.inf, checkpoint_every=self.checkpoint_every)
        require(not self.tune or self.resume is None, "tune", "given without --resume", str(self.resume))
        if self.trials is not None:
            require(self.tune, "trials", "given with --tune", self.trials)
            _whole(1, math.inf, trials=self.trials)
        check_history(self.history)
        check_clip(self.clip_observation)
        if self.curriculum is not None:
            own = family_separation(self.scenario)
            require(own is not None, "scenario", "a random family with --curriculum", self.scenario)
            assert own is not None
            _number(1e3 * own, FAMILY_MOST_MM, curriculum=self.curriculum)
        _ = self.correction  # which checks what it is made of
        alone = self.residual is None and self.expert is None
        require(alone or self.history == 1, "history", "1 with --residual or --expert", self.history)
        if self.expert is not None:
            require(self.expert in CLASSICAL, "expert", f"one of {', '.join(CLASSICAL)}", self.expert)
            require(self.algo == "ppo", "algo", "ppo with --expert", self.algo)
            require(self.residual is None, "expert", "given without --residual", self.residual)
            teacher(self.expert, self.settings, "cloned")
            asked = self.cloning.rounds * self.cloning.steps * self.ppo.n_envs
            enough = self.total_steps >= asked or self.resume is not None  # which has asked before
            require(enough, "steps", f"at least {asked}, those of cloning", self.total_steps)

    @property
    def correction(self) -> Correction | None:
        """What the policy corrects; None where it acts by itself."""
        return None if self.residual is None else Correction(self.residual, self.residual_scale)

    @property
    def own(self) -> PPOConfig | SACConfig:
        """Hyperparameters of the algorithm."""
        return self.ppo if self.algo == "ppo" else self.sac

    @property
    def curriculum_m(self) -> tuple[float, float]:
        """The least separation (m) at first, and in the end; of a training with a curriculum."""
        own = family_separation(self.scenario)
        assert own is not None
        assert self.curriculum is not None
        return 1e-3 * self.curriculum, own

    @property
    def folder(self) -> Path:
        """The run's folder: ``out``, or that of the run gone on with."""
        folder = self.out or self.resume
        assert folder is not None
        return folder

    @property
    def resolved(self) -> TrainConfig:
        """The same training with its modes of action and observation told, whichever they are by default."""
        return replace(self, action=self.settings.action, observation=self.settings.observation)

    @property
    def settings(self) -> Settings:
        """The environment."""
        shown = self.expert or self.residual
        action = self.action or ("velocity" if shown is None else CLASSICAL[shown].action)
        observation = self.observation or ("errors" if action == "velocity" and self.residual is None else "full")
        return Settings(self.scenario, self.plant, self.n_epm, action, observation, self.frame, self.control_hz)

    @property
    def checkpoint_steps(self) -> int:
        """Environment steps between checkpoints."""
        return self.checkpoint_every or max(1, min(250_000, self.total_steps // 10))

    @property
    def total_steps(self) -> int:
        """Environment steps of the whole training."""
        return self.steps if self.steps is not None else STEPS[self.algo]


def command_of(config: TrainConfig) -> str:
    """Return the command that trains so."""
    return shlex.join(["python", "train.py", *_options(config, TrainConfig(), "--")])


def _options(config: Any, default: Any, prefix: str) -> Iterator[str]:
    """Yield the options in which a configuration differs from the default."""
    for name in (one.name for one in fields(config)):
        value, usual, option = getattr(config, name), getattr(default, name), prefix + name.replace("_", "-")
        if value == usual:
            continue
        if is_dataclass(value):
            yield from _options(value, usual, f"{option}.")
        elif value is True:
            yield option
        else:
            yield from (option, *(map(str, value) if isinstance(value, tuple) else (str(value),)))
