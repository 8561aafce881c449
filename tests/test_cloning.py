"""Cloning a controller: what is fitted to what, a run that is broken off while it clones, what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from messages import refusal
from safetensors.numpy import load_file, save_file
from stable_baselines3 import PPO
from tiny_runs import PPO_CONFIG, going_on, rows_of, tensors_of

from agents import cloning
from agents.checkpoints import checkpoints, stored_config
from agents.cloning import ANSWERS, Answers
from agents.configs import CloningConfig, PPOConfig, TrainConfig
from agents.evaluation import Score
from agents.learned import Learned
from agents.learning import build, train
from agents.residual import seen_by, teacher
from agents.sb3_vec import TwoRobotsVecEnv
from agents.steered import Steered
from agents.store import load_policy

pytestmark = pytest.mark.usefixtures("elsewhere")

ROUND = 8 * 16
"""Steps of a round of the tiny training."""
TINY = dataclasses.replace(
    PPO_CONFIG,
    action=None,
    observation="full",
    expert="steered",
    cloning=CloningConfig(rounds=3, steps=16, led=1, epochs=2),
    steps=4 * ROUND,
    checkpoint_every=ROUND,
)


class BrokenOffError(Exception):
    """Ends a training."""


def broken_off(config: TrainConfig, after: int) -> None:
    """Train until so many scores have been told."""
    told: list[Score] = []

    def watch(score: Score) -> None:
        told.append(score)
        if len(told) == after:
            raise BrokenOffError

    with pytest.raises(BrokenOffError):
        train(config, watch=watch)


def test_a_clone_does_what_the_controller_would(tmp_path: Path) -> None:
    config = TrainConfig(
        expert="steered",
        ppo=PPOConfig(n_envs=256, n_steps=2, batch_size=64, n_epochs=1, log_std_init=-4.0, net=(64, 64)),
        cloning=CloningConfig(rounds=4, steps=6, led=2, epochs=20),
        steps=4 * 6 * 256,
        checkpoint_every=100_000,
        out=tmp_path / "run",
    )
    folder, finished = train(config)
    assert finished
    agent, env = Learned(folder / "model"), TwoRobotsVecEnv(32, config.settings, 1234)  # episodes it has never met
    expert, observations, rng = Steered(), env.reset(), np.random.default_rng(0)
    differences, answers = [], []
    for _ in range(10):
        own, _ = agent.predict(observations)
        answer, _ = expert.predict(seen_by(expert, observations))
        differences.append(own - answer)
        answers.append(answer)
        noise = rng.normal(scale=0.2, size=own.shape)
        observations, *_ = env.step(np.clip(own + noise, -1.0, 1.0).astype(np.float32))
    assert np.std(differences) < 0.6 * np.std(answers)


def test_cloning_counts_as_training_and_is_told(tmp_path: Path) -> None:
    folder, _ = train(dataclasses.replace(TINY, out=tmp_path / "run"))
    rows = rows_of(folder)
    cloned = [int(row["time/total_timesteps"]) for row in rows if row["train/clone_loss"]]
    assert cloned == [ROUND, 2 * ROUND, 3 * ROUND]
    assert int(rows[-1]["time/total_timesteps"]) == 4 * ROUND
    kept = load_file(folder / ANSWERS)
    assert kept["observations"].shape == (3 * ROUND, 63)
    assert kept["actions"].shape == (3 * ROUND, 6)


def test_every_answer_is_the_controllers_own(tmp_path: Path) -> None:
    folder, _ = train(dataclasses.replace(TINY, out=tmp_path / "run"))
    kept, expert = Answers.load(folder, 63, 6), Steered()
    answers, _ = expert.predict(seen_by(expert, kept.observations))
    np.testing.assert_array_equal(answers, kept.actions)


def test_a_run_broken_off_while_it_clones_asks_no_round_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken_off(dataclasses.replace(TINY, out=tmp_path / "run"), 2)  # at the last step of the second round
    assert Answers.load(tmp_path / "run", 63, 6).rounds == 1
    asked = []
    usual = Steered.predict

    def counted(self: Steered, observation: Any, *rest: Any, **more: Any) -> Any:
        asked.append(len(observation))
        return usual(self, observation, *rest, **more)

    monkeypatch.setattr(Steered, "predict", counted)
    train(going_on(tmp_path / "run", steps=5 * ROUND))
    assert sum(asked) == 2 * ROUND
    assert Answers.load(tmp_path / "run", 63, 6).rounds == 3
    assert stored_config(tmp_path / "run").cloning == TINY.cloning
    asked.clear()
    train(going_on(tmp_path / "run", steps=6 * ROUND))
    assert not asked


def test_the_same_seed_clones_to_the_same_bits(tmp_path: Path) -> None:
    one, other = (train(dataclasses.replace(TINY, out=tmp_path / name))[0] for name in "ab")
    first, second = tensors_of(one), tensors_of(other)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_what_a_killed_run_left_is_none_of_a_new_one(tmp_path: Path) -> None:
    fresh, _ = train(dataclasses.replace(TINY, out=tmp_path / "fresh"))
    left = tmp_path / "anew"
    left.mkdir()
    Answers(np.ones((ROUND, 63), np.float32), np.ones((ROUND, 6), np.float32), TINY.cloning.rounds).save(left)
    anew, _ = train(dataclasses.replace(TINY, out=left))
    first, second = tensors_of(fresh), tensors_of(anew)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_a_run_gone_on_with_elsewhere_takes_its_answers_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train(dataclasses.replace(TINY, out=tmp_path / "run"))
    train(going_on(tmp_path / "run", out=tmp_path / "there", steps=5 * ROUND))
    assert (tmp_path / "there" / ANSWERS).read_bytes() == (tmp_path / "run" / ANSWERS).read_bytes()
    monkeypatch.setattr(cloning, "_fit", None)  # nothing is left to do
    train(going_on(tmp_path / "there", steps=6 * ROUND))


def test_a_checkpoint_never_lacks_a_fit_that_its_run_holds_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However rare checkpoints are: else a run killed after cloning would go on with a policy that was not cloned."""
    alone, _ = train(dataclasses.replace(TINY, steps=3 * ROUND, out=tmp_path / "alone"))
    monkeypatch.setattr(PPO, "learn", lambda *_, **__: (_ for _ in ()).throw(BrokenOffError))
    for every, name in ((10**6, "rare"), (ROUND + 8, "odd")):
        with pytest.raises(BrokenOffError):
            train(dataclasses.replace(TINY, checkpoint_every=every, out=tmp_path / name))
        weights, _ = load_policy(checkpoints(tmp_path / name)[-1])
        wanted, _ = load_policy(alone / "model")
        assert all(np.array_equal(weights[key], wanted[key]) for key in wanted)


def test_returns_are_discounted_sums_up_to_the_end_of_an_episode() -> None:
    model, _ = build(TINY)
    assert isinstance(model, PPO)
    rng = np.random.default_rng(0)
    rewards = rng.normal(size=(6, 2)).astype(np.float32)
    dones = np.zeros((6, 2), np.bool_)
    dones[3, 0] = True
    last = rng.normal(size=(2, 63)).astype(np.float32)
    with torch.no_grad():
        beyond = model.policy.predict_values(torch.from_numpy(last)).numpy()[:, 0]
    found = cloning._returns(model, rewards, dones, last)
    for row in range(2):
        for t in range(6):
            end = 4 if row == 0 and t < 4 else 6
            wanted = sum(model.gamma ** (k - t) * rewards[k, row] for k in range(t, end))
            wanted += model.gamma ** (6 - t) * beyond[row] if end == 6 else 0.0
            assert found[t, row] == pytest.approx(wanted, rel=1e-5)


def test_damaged_answers_are_refused(tmp_path: Path) -> None:
    broken_off(dataclasses.replace(TINY, out=tmp_path / "run"), 2)
    path = tmp_path / "run" / ANSWERS
    kept, whole = load_file(path), path.read_bytes()
    path.write_bytes(whole[:50])
    assert "must be a run with sound answers.safetensors" in refusal(lambda: train(going_on(tmp_path / "run")))
    save_file(kept | {"actions": kept["actions"][:, :5].copy()}, path)
    told = refusal(lambda: train(going_on(tmp_path / "run")))
    assert f"of shapes (m, 63) and (m, 6); instead received (({ROUND}, 63), ({ROUND}, 5))" in told
    for bad in (
        kept | {"rounds": np.array([-1])},
        kept | {"rounds": np.array([0.5])},
        kept | {"actions": kept["actions"].astype(np.float64)},
        kept | {"observations": np.full_like(kept["observations"], np.nan)},
        {name: array for name, array in kept.items() if name != "rounds"},
        {name: np.array(0.0) for name in kept},
    ):
        save_file(bad, path)
        assert ANSWERS in refusal(lambda: train(going_on(tmp_path / "run")))
    path.unlink()
    assert "must be a run with sound answers.safetensors" in refusal(lambda: train(going_on(tmp_path / "run")))
    assert checkpoints(tmp_path / "run")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"expert": "ppo"}, "Input expert must be one of baseline, "),
        ({"expert": "steered", "steps": 1000}, "Input steps must be at least 81920, those of cloning"),
        ({"expert": "steered", "algo": "sac"}, "Input algo must be ppo with --expert; instead received 'sac'"),
        ({"expert": "steered", "residual": "steered"}, "Input expert must be given without --residual"),
        ({"expert": "steered", "action": "home"}, "Input action must be 'velocity', as of steered, which is cloned"),
        (
            {"expert": "tuned", "observation": "errors"},
            "Input observation must be 'full', as of tuned, which is cloned",
        ),
    ],
)
def test_what_cannot_be_cloned_is_refused(options: dict[str, Any], told: str) -> None:
    assert told in refusal(lambda: TrainConfig(**options))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"rounds": 0}, "Input rounds must be a whole number from 1"),
        ({"led": -1}, "Input led must be a whole number from 0"),
        ({"steps": 0}, "Input cloning.steps must be a whole number from 1"),
        ({"learning_rate": 0.0}, "Input learning_rate must be a number above 0"),
    ],
)
def test_hyperparameters_of_cloning_are_checked(options: dict[str, Any], told: str) -> None:
    assert told in refusal(lambda: CloningConfig(**options))


def test_the_action_mode_is_that_of_what_is_cloned() -> None:
    assert TrainConfig(expert="tuned").settings.action == "pose"
    assert TrainConfig(expert="steered").settings.action == "velocity"
    assert teacher("tuned", TrainConfig(expert="tuned").settings, "cloned").name == "tuned"
