"""Trainings that begin with robots far apart."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from messages import refusal
from tiny_runs import CONFIGS, both, going_on, tensors_of

from agents.checkpoints import stored_config
from agents.configs import CloningConfig, TrainConfig, command_of
from agents.curriculum import nearest_m
from agents.learning import train
from agents.sb3_vec import TwoRobotsVecEnv
from magenv.episodes import Settings
from magenv.trajectories import draw, family_separation

pytestmark = pytest.mark.usefixtures("elsewhere")


def gap(env: TwoRobotsVecEnv) -> float:
    """Return the least separation (m) of all references that an environment's episodes follow now."""
    world = env._episodes.world
    at = [[world.trajectory(row).at(time) for time in np.linspace(0.0, 100.0, 101)] for row in range(env.num_envs)]
    places = np.array(at)[..., :2]
    return float(np.linalg.norm(places[:, :, 1] - places[:, :, 0], axis=-1).min())


@pytest.fixture
def nearest(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What trainings let robots come to, in mm, from one change to the next."""
    told: list[float] = []
    original = TwoRobotsVecEnv.set_nearest

    def noted(env: TwoRobotsVecEnv, nearest_m: float) -> None:
        told.append(1e3 * nearest_m)
        original(env, nearest_m)

    monkeypatch.setattr(TwoRobotsVecEnv, "set_nearest", noted)
    return told


def easy_first(algo: str = "ppo", **changes: Any) -> TrainConfig:
    """Return a tiny training with a curriculum: 512 steps of PPO, a rollout of 128 at a time."""
    return dataclasses.replace(CONFIGS[algo], **({"curriculum": 60.0} | changes))


def test_episodes_that_begin_from_now_on_keep_the_separation() -> None:
    env = TwoRobotsVecEnv(60, Settings(), 0)
    env.set_nearest(0.06)
    env.reset()
    assert gap(env) == pytest.approx(0.06, abs=3e-3)
    env.set_nearest(0.02)
    env.reset()
    assert 0.0199 < gap(env) < 0.03


def test_a_family_comes_to_its_separation() -> None:
    """``random`` is the one that comes to 20 mm."""
    for seed in range(20):
        one, other = (draw(name, np.random.default_rng(seed)) for name in ("random", "random-20"))
        np.testing.assert_array_equal(one.coefficients, other.coefficients)
    closest = []
    for seed in range(60):
        places = np.array([draw("random-45.5", np.random.default_rng(seed)).at(t)[:, :2] for t in range(101)])
        closest.append(float(np.linalg.norm(places[:, 1] - places[:, 0], axis=-1).min()))
    assert 0.0454 < min(closest) < 0.05
    assert 0.07 < max(closest) < 0.1


def test_the_separation_falls_until_half_of_the_training_is_done(nearest: list[float], tmp_path: Path) -> None:
    """Evenly, with every step of the eight environments; before the first one, it is what the curriculum tells."""
    train(easy_first(out=tmp_path / "run"))
    assert nearest == pytest.approx([max(60.0 - 40.0 * steps / 256, 20.0) for steps in range(0, 513, 8)])


def test_steps_of_cloning_count(nearest: list[float], tmp_path: Path) -> None:
    cloning = CloningConfig(rounds=4, steps=16, epochs=1)
    config = easy_first(expert="idle", cloning=cloning, steps=1024, checkpoint_every=512, out=tmp_path / "run")
    train(config)
    assert nearest == pytest.approx([max(60.0 - 40.0 * steps / 512, 20.0) for steps in range(0, 1025, 8)])


def test_a_run_gone_on_with_is_as_far_as_its_steps_are_of_all(nearest: list[float], tmp_path: Path) -> None:
    train(easy_first(steps=128, out=tmp_path / "run"))
    assert stored_config(tmp_path / "run").curriculum == 60.0
    nearest.clear()
    train(going_on(tmp_path / "run", steps=1024))
    assert nearest == pytest.approx([max(60.0 - 40.0 * steps / 512, 20.0) for steps in range(128, 1025, 8)])
    assert "curriculum" in refusal(lambda: train(going_on(tmp_path / "run", steps=2048, curriculum=None)))


@both
def test_it_can_be_repeated_and_makes_a_difference(algo: str, tmp_path: Path) -> None:
    size = {"steps": 256} if algo == "ppo" else {"steps": 160}
    runs = []
    for name, curriculum in (("one", 60.0), ("again", 60.0), ("other", None)):
        train(easy_first(algo, out=tmp_path / name, curriculum=curriculum, **size))
        runs.append(tensors_of(tmp_path / name))
    one, again, other = runs
    assert all(bool((one[name] == again[name]).all()) for name in one)
    assert not all(bool((one[name] == other[name]).all()) for name in one)


def test_it_ends_with_the_scenarios_own_separation() -> None:
    config = TrainConfig(scenario="random-33.3", curriculum=71.7, steps=1000)
    path = [nearest_m(config, steps) for steps in range(0, 1001, 25)]
    assert path[0] == pytest.approx(0.0717)
    assert path == sorted(path, reverse=True)
    assert path[20:] == [family_separation("random-33.3")] * 21
    assert nearest_m(TrainConfig(scenario="random-14.3", curriculum=80.0), 0) == 0.08, "no more by rounding"
    assert command_of(config) == "python train.py --scenario random-33.3 --curriculum 71.7 --steps 1000"


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: TrainConfig(curriculum=20.0), "curriculum must be a number above 20, at most 80; instead received 20"),
        (lambda: TrainConfig(curriculum=81.0), "curriculum must be a number above 20, at most 80"),
        (lambda: TrainConfig(curriculum=float("nan")), "curriculum must be a number above 20"),
        (lambda: TrainConfig(scenario="random-30", curriculum=25.0), "curriculum must be a number above 30"),
        (lambda: TrainConfig(scenario="approach-30", curriculum=60.0), "scenario must be a random family"),
        (lambda: TwoRobotsVecEnv(1, Settings(), 0).set_nearest(0.019), "nearest_m must be from 0.02"),
        (lambda: TwoRobotsVecEnv(1, Settings(), 0).set_nearest(float("nan")), "nearest_m must be from 0.02"),
        (lambda: TwoRobotsVecEnv(1, Settings(), 0).set_nearest("near"), "nearest_m must be from 0.02"),  # type: ignore[arg-type]
        (lambda: TwoRobotsVecEnv(1, Settings("still-30"), 0).set_nearest(0.05), "scenario must be a random family"),
        (lambda: TwoRobotsVecEnv(1, Settings("random-11"), 0), "scenario must be random, approach-<s>"),
        (lambda: TwoRobotsVecEnv(1, Settings("random-80.1"), 0), "or random-<s> with s from 12 to 80"),
        (
            lambda: TwoRobotsVecEnv(1, Settings("random-30", "paper:workspace_radius_m=0.08"), 0),
            "scenario must be such",
        ),
        (lambda: TwoRobotsVecEnv(1, Settings("random-"), 0), "scenario must be random"),
        (lambda: TwoRobotsVecEnv(1, Settings("random-30-anti"), 0), "scenario must be random"),
    ],
)
def test_what_is_no_curriculum_is_refused(make: Callable[[], object], told: str) -> None:
    assert told in refusal(make)
