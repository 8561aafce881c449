"""Settings and fixtures shared by all tests."""

from __future__ import annotations

import os

# Before anything imports torch, pygame or matplotlib: one thread, no window.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["SDL_AUDIODRIVER"] = "dummy"
os.environ["MPLBACKEND"] = "Agg"

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

import magenv
from magenv.env import TwoRobots
from magenv.params import PLANTS, Body, Plant

if TYPE_CHECKING:
    from climbs import Climbed, Outcomes, Told
    from rollouts import MakeEnv
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecNormalize
    from tiny_runs import MakeConfig

    from agents.configs import TrainConfig
    from agents.ladder import Rung

Floats = NDArray[np.float64]
Rotation = Callable[[float], Floats]

pytest.register_assert_rewrite(
    "lane", "messages", "planned", "rollouts", "tiny_runs", "walks"
)  # so that they tell values


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20230)


@pytest.fixture
def make_env() -> Iterator[MakeEnv]:
    """Make the registered environment without its wrappers; all are closed afterwards."""
    made: list[TwoRobots] = []

    def make(**arguments: Any) -> TwoRobots:
        env = gymnasium.make(magenv.ENV_ID, **arguments).unwrapped
        assert isinstance(env, TwoRobots)
        made.append(env)
        return env

    yield make
    for env in made:
        env.close()


@pytest.fixture
def stuck_plant(monkeypatch: pytest.MonkeyPatch) -> str:
    """Name of a plant in which drag holds the robots where they are put, so that a test can lead them."""
    monkeypatch.setitem(PLANTS, "stuck", Plant(body=Body(drag_linear_nspm=1e9, drag_rotational_nmsprad=1e6)))
    return "stuck"


@pytest.fixture
def rotations(rng: np.random.Generator) -> Floats:
    """Twenty rotations of space, matrices (20, 3, 3)."""
    q, _ = np.linalg.qr(rng.normal(size=(20, 3, 3)))
    q[..., 0] *= np.linalg.det(q)[:, None]
    return np.asarray(q)


@pytest.fixture
def turn_about_z() -> Rotation:
    """Return the matrix that turns by an angle (rad) about the vertical."""

    def matrix(angle: float) -> Floats:
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    return matrix


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave pygame no display to open: only what asks for a window may need one."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "no-such-driver")


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in a folder of the test's own, so that default folders are not the project's."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def make_config(tmp_path: Path) -> MakeConfig:
    """Return a tiny training's configuration with changes, its run in the folder ``run``."""
    from tiny_runs import CONFIGS  # which imports torch; most tests do without

    def make(algo: str = "ppo", **changes: Any) -> TrainConfig:
        return dataclasses.replace(CONFIGS[algo], **({"out": tmp_path / "run"} | changes))

    return make


@pytest.fixture(scope="session")
def trained() -> dict[str, tuple[BaseAlgorithm, VecNormalize]]:
    """Return agents of both algorithms after a few gradient steps."""
    from tiny_runs import SAVED

    from agents.learning import build

    made = {}
    for algo, config in SAVED.items():
        model, env = build(config)
        model.learn(128)
        env.training = False
        made[algo] = (model, env)
    return made


@pytest.fixture
def checkpoint(tmp_path: Path, trained: dict[str, tuple[BaseAlgorithm, VecNormalize]]) -> Path:
    """Return a sound PPO checkpoint."""
    from tiny_runs import SAVED

    from agents.checkpoints import save_model

    path = tmp_path / "checkpoints" / "step-000000000128"
    save_model(path, *trained["ppo"], SAVED["ppo"], True, "python train.py")
    return path


@pytest.fixture
def rollout(monkeypatch: pytest.MonkeyPatch) -> Told:
    """Let a ladder's episodes end as told instead of running them; its pictures, which take time, are empty."""
    from climbs import Told

    from agents import ladder_run, sharing  # which take their time; most tests do without

    instead = Told()
    monkeypatch.setattr(sharing, "run", instead)
    monkeypatch.setattr(ladder_run, "draw", lambda _: None)
    monkeypatch.setattr(ladder_run, "png", lambda _: b"")
    return instead


@pytest.fixture
def climbed(rollout: Told) -> Climbed:
    """Climb down a ladder whose episodes end as told."""
    from agents.catalogue import controller  # which takes its time
    from agents.ladder import Ladder, climb

    def climb_down(outcomes: Outcomes | None = None, name: str = "tuned", **setting: Any) -> list[Rung]:
        rollout.outcomes = outcomes or {}
        return climb(controller(name), Ladder(**setting))

    return climb_down
