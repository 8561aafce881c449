"""The trainings of the study, an entry each, and how their configurations are told as JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from agents.checkpoints import GOING_ON
from agents.configs import STEPS, CloningConfig, PPOConfig, TrainConfig
from magenv.params import require

SCENARIOS = ("approach-60", "approach-30", "approach-22.5", "crossing-30", "meeting-30", "eight-30", "still-30")
"""On which every agent and controller is measured."""
MAIN = "main"
"""Group of the agents that stand beside the controllers."""


@dataclass(frozen=True)
class Training:
    """One agent of the study."""

    name: str
    shows: str
    """What it is there for, in a line."""
    config: TrainConfig = field(default_factory=TrainConfig)
    """What differs from the default; seed and folder are the study's."""
    seeds: tuple[int, ...] = (0, 1, 2)
    group: str = MAIN
    """``main``, or of which comparison it is a part."""
    compared_with: tuple[str, ...] = ()
    """Trainings that stand beside it there; without any, those of the main group."""
    scenarios: tuple[str, ...] = SCENARIOS
    """Measured on."""

    def of_seed(self, seed: int) -> TrainConfig:
        """Return the configuration of one of its trainings."""
        return dataclasses.replace(self.config, seed=seed)


HOME_PPO = PPOConfig(learning_rate=6e-4, log_std_init=-1.6, learn_std=True, activation="tanh")
"""Poses need more room to explore than velocities."""
CLONE_PPO = PPOConfig(learning_rate=2e-4, log_std_init=-3.5)
"""A clone is near what it looks for."""

LONG, SHORT, HOME_SHORT = 1_500_000, 200_000, 1_000_000
"""Steps of trainings that are compared with each other alone, in velocities and in offsets from home."""

EARLIER_PPO = PPOConfig(learn_std=True, activation="tanh")
EARLIER = partial(TrainConfig, clip_observation=5.0, ppo=EARLIER_PPO)
"""Trainings that were done when these were the defaults; what that costs, `ppo-narrow` and `ppo-clip-5` tell."""

TRAININGS = (
    Training(
        "ppo-home",
        "PPO by offsets from the home configuration",
        EARLIER(action="home", ppo=HOME_PPO, steps=3_000_000),
    ),
    Training(
        "sac-home",
        "SAC by offsets from the home configuration",
        TrainConfig(algo="sac", action="home", clip_observation=5.0),
    ),
    Training(
        "ppo-velocity",
        "PPO as it comes: pose errors make velocities of the robots, that steering turns into poses",
        seeds=(0, 1, 2, 3, 4),
    ),
    Training(
        "sac-velocity",
        "SAC that sees all there is",
        TrainConfig(algo="sac", observation="full", clip_observation=5.0),
    ),
    Training(
        "residual-steered",
        "PPO that corrects `steered`",
        EARLIER(residual="steered", residual_scale=0.2, steps=500_000),
        seeds=(0, 1, 2, 3, 4),
    ),
    Training(
        "clone-steered",
        "PPO that begins as a clone of `steered`",
        TrainConfig(expert="steered", ppo=CLONE_PPO, steps=300_000),
        seeds=(0, 1, 2, 3, 4),
    ),
    Training(
        "clone-predictive",
        "PPO that begins as a clone of `predictive-home`, in absolute poses",
        EARLIER(
            expert="predictive-home",
            ppo=dataclasses.replace(CLONE_PPO, learn_std=True, activation="tanh"),
            cloning=CloningConfig(steps=32),
            steps=1_000_000,
        ),
        group="ablation: action",
    ),
    Training(
        "ppo-pose",
        "absolute poses of the EPMs",
        EARLIER(action="pose", ppo=HOME_PPO, steps=3_000_000),
        group="ablation: action",
        compared_with=("ppo-home", "ppo-full"),
    ),
    Training(
        "ppo-step",
        "changes of the EPMs' poses",
        EARLIER(action="step", ppo=HOME_PPO, steps=3_000_000),
        group="ablation: action",
    ),
    Training(
        "ppo-wrench",
        "wrenches that an optimiser allocates",
        EARLIER(action="wrench", ppo=dataclasses.replace(EARLIER_PPO, log_std_init=-3.0), steps=300_000),
        group="ablation: action",
    ),
    Training(
        "short",
        "`ppo-full` in fewer steps",
        EARLIER(observation="full", steps=SHORT),
        group="ablation: observation",
        compared_with=("ppo-velocity", "ppo-clip-5"),
    ),
    Training(
        "short-global",
        "the global frame",
        EARLIER(observation="full", frame="global", steps=SHORT),
        group="ablation: observation",
    ),
    Training(
        "short-errors",
        "`ppo-clip-5` in fewer steps",
        EARLIER(steps=SHORT),
        group="ablation: observation",
    ),
    Training(
        "ppo-full",
        "`ppo-clip-5` that sees all there is",
        EARLIER(observation="full", steps=LONG),
        seeds=(0, 1, 2, 3, 4),
        group="ablation: observation",
    ),
    Training(
        "ppo-narrow",
        "tangents as activation, a standard deviation that is learned, half as many steps again",
        TrainConfig(ppo=EARLIER_PPO, steps=LONG),
        seeds=(0, 1, 2, 3),
        group="ablation: network",
    ),
    Training(
        "ppo-clip-5",
        "`ppo-narrow` with observations cut at 5 standard deviations",
        EARLIER(steps=LONG),
        group="ablation: network",
        compared_with=("ppo-velocity",),
    ),
    Training(
        "short-one",
        "one scenario alone, `approach-30`, instead of the random family",
        EARLIER(observation="full", scenario="approach-30", steps=SHORT),
        group="ablation: trajectories",
        compared_with=("short",),
    ),
    Training(
        "short-curriculum",
        "`short` that begins with robots 60 mm apart and more",
        EARLIER(observation="full", curriculum=60.0, steps=SHORT),
        group="ablation: trajectories",
        compared_with=("short",),
    ),
    Training(
        "home-curriculum",
        "`home-short` that begins with robots 60 mm apart and more",
        EARLIER(action="home", ppo=HOME_PPO, curriculum=60.0, steps=HOME_SHORT),
        group="ablation: trajectories",
        compared_with=("home-short",),
    ),
    Training(
        "home-short",
        "`ppo-home` in fewer steps",
        EARLIER(action="home", ppo=HOME_PPO, steps=HOME_SHORT),
        group="ablation: home",
        compared_with=("ppo-home",),
    ),
    Training(
        "home-level",
        "EPMs that stand on a level with the robots at home",
        EARLIER(action="home", ppo=HOME_PPO, steps=HOME_SHORT, plant="paper:home_turn_rad=-0.593"),
        group="ablation: home",
    ),
    Training(
        "home-upright",
        "EPMs that stand above and below the robots at home",
        EARLIER(action="home", ppo=HOME_PPO, steps=HOME_SHORT, plant="paper:home_turn_rad=0.977"),
        group="ablation: home",
    ),
    Training(
        "residual-three",
        "PPO that corrects `steered`",
        EARLIER(residual="steered", residual_scale=0.2, steps=500_000, n_epm=3),
        group="three EPMs",
    ),
    Training(
        "ppo-three", "`short` with three EPMs", EARLIER(observation="full", n_epm=3, steps=SHORT), group="three EPMs"
    ),
    Training(
        "residual-10hz",
        "PPO that corrects `steered`",
        EARLIER(residual="steered", residual_scale=0.2, steps=500_000, control_hz=10.0),
        group="10 Hz",
        scenarios=("approach-30", "approach-22.5", "approach-20"),
    ),
    Training(
        "arm-home",
        "PPO by offsets from the home configuration, trained on `arm`, where all parameters are drawn anew",
        EARLIER(action="home", ppo=HOME_PPO, steps=3_000_000, plant="arm"),
        group="arms",
        scenarios=("approach-60", "approach-30"),
    ),
    Training(
        "arm-history",
        "`arm-home` that sees its last four observations",
        EARLIER(action="home", ppo=HOME_PPO, steps=3_000_000, plant="arm", history=4),
        group="arms",
        scenarios=("approach-60", "approach-30"),
    ),
)
"""All trainings, in the order of tables; a further one is a further entry."""


def names() -> list[str]:
    """Return the names of all trainings."""
    return [training.name for training in TRAININGS]


def training(name: str) -> Training:
    """Return the training of this name, or raise ``InputError`` where there is none."""
    require(name in names(), "name", f"one of the study's trainings ({', '.join(names())})", name)
    return TRAININGS[names().index(name)]


def as_told(config: TrainConfig) -> dict[str, Any]:
    """Return what counts of a configuration, as JSON holds it: with the algorithm's own hyperparameters alone."""
    return told_of(json.loads(json.dumps(dataclasses.asdict(config.resolved), default=str)))


def told_of(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return what counts of a configuration as a model's card holds it, or raise ``InputError`` where it is none."""
    algo: Any = stored.get("algo")
    require(algo in STEPS, "algo", " or ".join(STEPS), algo)
    dropped = (set(GOING_ON) | set(STEPS)) - {algo}
    return {name: value for name, value in stored.items() if name not in dropped} | {
        "steps": stored.get("steps") or STEPS[algo]
    }


def check_told(told: Mapping[str, Any], config: TrainConfig, where: str) -> None:
    """Raise ``InputError`` unless what is told of a configuration is this one.

    What is not told counts as the default: records need not tell options that came later and leave all as it was.
    """
    wanted = as_told(config)
    usual = as_told(TrainConfig(algo=config.algo))
    for name, value in wanted.items():
        found = told.get(name, usual[name])
        if isinstance(value, dict) and isinstance(found, dict):
            found = usual[name] | found
        require(found == value, where, f"a training with {name} {value!r}, as the study has it", found)
    unknown = sorted(set(told) - set(wanted))
    require(not unknown, where, "a training of options that are known", ", ".join(unknown))
