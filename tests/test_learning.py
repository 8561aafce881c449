"""Training: an agent learns, a run can be repeated, and what it leaves; bad configurations."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tiny_runs import PPO_CONFIG, Interrupter, MakeConfig, both, going_on, rows_of, steps_of, tensors_of, total_steps

from agents.checkpoints import MODEL, checkpoints, save_model
from agents.configs import PPOConfig, SACConfig, TrainConfig
from agents.learned import Learned
from agents.learning import build, train
from agents.rollout import run
from agents.store import CARD, POLICY, load_card, load_policy, load_training
from magenv.params import PLANTS, Body, Plant

pytestmark = pytest.mark.usefixtures("elsewhere")

# It learns.


def test_an_agent_learns_a_tiny_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time under control grows from a fifth of a second to half a minute and more; so it does with other seeds."""
    monkeypatch.setitem(PLANTS, "tiny", Plant(body=Body(drag_linear_nspm=0.15, drag_rotational_nmsprad=5e-5)))
    settings = PPOConfig(n_envs=64, n_steps=32, batch_size=512, n_epochs=8, learning_rate=1e-3, log_std_init=-1.6)
    tiny = TrainConfig(
        action="home",
        scenario="approach-100",
        plant="tiny",
        control_hz=10.0,
        steps=49_152,
        out=tmp_path / "run",
        ppo=settings,
    )
    save_model(tmp_path / "untrained", *build(tiny), tiny, False, "")
    folder, finished = train(tiny)
    assert finished
    held_s = {}
    for name, path in (("untrained", tmp_path / "untrained"), ("trained", folder / "model")):
        records = run(Learned(path), "approach-100", "tiny", control_hz=10.0, episodes=6, seed=100)
        held_s[name] = np.array([record.time_s[-1] for record in records])
    assert held_s["untrained"].max() < 1.0
    assert held_s["trained"].min() > 10.0
    told = [float(row["rollout/ep_rew_mean"]) for row in rows_of(tiny.out) if row["rollout/ep_rew_mean"]]
    assert told[-1] > 3 * told[0]


def test_the_same_seed_gives_the_same_weights(tmp_path: Path) -> None:
    runs = []
    for name, seed in (("one", 3), ("two", 3), ("three", 4)):
        train(dataclasses.replace(PPO_CONFIG, steps=256, seed=seed, out=tmp_path / name))
        runs.append(tensors_of(tmp_path / name))
        torch.rand(3)  # whatever has happened in the process before
        np.random.rand(3)  # noqa: NPY002
    one, two, three = runs
    assert one.keys() == two.keys()
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert not any(torch.equal(one[name], three[name]) for name in one if name.endswith("weight"))


# What a run leaves.


@both
def test_a_run_leaves_model_checkpoints_and_progress(make_config: MakeConfig, algo: str) -> None:
    wanted = make_config(algo)
    folder, finished = train(wanted, "python train.py --tiny")
    assert finished
    assert folder == wanted.out
    folder = folder / "model"
    assert sorted(path.name for path in folder.iterdir()) == [CARD, POLICY]
    card = load_card(folder)
    assert (card.algo, card.steps, card.command) == (algo, wanted.total_steps, "python train.py --tiny")
    assert steps_of(wanted.out)[-1] == wanted.total_steps
    assert len(checkpoints(wanted.out)) == 2
    rows = rows_of(wanted.out)
    assert total_steps(rows)[-1] == wanted.total_steps
    assert float(rows[-1]["train/learning_rate"]) > 0.0
    assert float(rows[-1]["episodes/success_rate"]) == 0.0
    assert Learned(folder).predict(np.zeros(63, np.float32))[0].shape == (10,)


def test_the_model_is_the_last_checkpoint(make_config: MakeConfig) -> None:
    train(make_config())
    last = load_file(checkpoints(make_config().out)[-1] / POLICY)
    model = tensors_of(make_config().out)
    assert last.keys() == model.keys()
    assert all(torch.equal(last[name], model[name]) for name in model)


def test_checkpoints_come_ten_times_a_run_or_more() -> None:
    assert TrainConfig().checkpoint_steps == 100_000
    assert TrainConfig(algo="sac").checkpoint_steps == 20_000
    assert TrainConfig(steps=5).checkpoint_steps == 1
    assert TrainConfig(checkpoint_every=7).checkpoint_steps == 7


def test_velocities_are_learned_from_errors_and_poses_from_all_there_is() -> None:
    assert TrainConfig().settings.observation == "errors"
    assert TrainConfig(expert="steered").settings.observation == "errors"
    assert TrainConfig(residual="steered").settings.observation == "full"
    assert TrainConfig(expert="predictive-home").settings.observation == "full"
    assert TrainConfig(action="home").settings.observation == "full"
    assert TrainConfig(observation="full").settings.observation == "full"


@pytest.mark.parametrize("learned", [False, True])
def test_a_standard_deviation_that_is_not_learned_stays(make_config: MakeConfig, learned: bool) -> None:
    """As it began, and through a resume, where its optimiser has nothing to go on with."""
    ppo = dataclasses.replace(PPO_CONFIG.ppo, learn_std=learned)
    train(make_config(ppo=ppo))
    train(going_on(make_config().out, steps=1024))
    last = load_policy(make_config().out / MODEL)[0]["log_std"]
    assert (last == np.float32(ppo.log_std_init)).all() == (not learned)


# The learning rate.


def learning_rate(checkpoint: Path) -> float:
    """Return the learning rate of the last gradient step before a PPO checkpoint."""
    return load_training(checkpoint)["policy.optimizer.param_groups.0.lr"].item()


def rates_of(run_folder: Path) -> list[tuple[int, float]]:
    """Return the learning rates in progress.csv, each with the steps of its row."""
    rows = [row for row in rows_of(run_folder) if row["train/learning_rate"]]
    return [(steps, float(row["train/learning_rate"])) for steps, row in zip(total_steps(rows), rows, strict=True)]


@pytest.mark.parametrize("steps", [1, 100, 512, 600])
def test_the_learning_rate_falls_to_a_tenth_and_no_further(make_config: MakeConfig, steps: int) -> None:
    """Steps come in whole rollouts: a run may end beyond the steps asked for."""
    train(make_config(steps=steps))
    last = checkpoints(make_config().out)[-1]
    assert load_card(last).steps == -(-steps // 128) * 128
    assert learning_rate(last) == pytest.approx(0.1 * PPO_CONFIG.ppo.learning_rate)


def test_the_learning_rate_goes_on_falling_after_a_resume(make_config: MakeConfig) -> None:
    with pytest.MonkeyPatch.context() as patch:
        Interrupter(patch, at=40)
        train(make_config())
    before = rates_of(make_config().out)
    train(going_on(make_config().out))
    rates = [rate for _, rate in rates_of(make_config().out)]
    assert rates == sorted(rates, reverse=True)
    assert len(rates) > len(before)
    assert rates[0] == pytest.approx((0.1 + 0.9 * (1 - 128 / 512)) * PPO_CONFIG.ppo.learning_rate)
    assert learning_rate(checkpoints(make_config().out)[-1]) == pytest.approx(0.1 * PPO_CONFIG.ppo.learning_rate)


def test_a_longer_run_has_the_learning_rates_of_one_planned_so_long(make_config: MakeConfig) -> None:
    train(make_config())
    train(going_on(make_config().out, steps=1024))
    planned = [(0.1 + 0.9 * (1 - steps / 1024)) * PPO_CONFIG.ppo.learning_rate for steps in (640, 768, 896, 1024)]
    rates = [rate for steps, rate in rates_of(make_config().out) if steps > 640]
    assert rates[:3] == pytest.approx(planned[:3])
    assert rates[3:] in ([], pytest.approx(planned[3:]))


# Bad input.


@pytest.mark.parametrize(
    "changes",
    [
        {"scenario": "nowhere"},
        {"plant": "moon"},
        {"n_epm": 0},
        {"n_epm": 4},
        {"action": "jump"},
        {"observation": "all"},
        {"frame": "lab"},
        {"control_hz": 0.0},
    ],
)
def test_an_unsound_configuration_is_refused_before_anything_is_written(make_config: MakeConfig, changes: Any) -> None:
    with pytest.raises(ValueError, match=r"^Input .+ must .+; instead received .+"):
        train(make_config(**changes))
    assert not make_config().out.exists()


@pytest.mark.parametrize(
    "make",
    [
        lambda: TrainConfig(algo="dqn"),  # type: ignore[arg-type]
        lambda: TrainConfig(steps=0),
        lambda: TrainConfig(seed=-1),
        lambda: TrainConfig(checkpoint_every=0),
        lambda: TrainConfig(clip_observation=0.0),
        lambda: TrainConfig(clip_observation=float("inf")),
        lambda: PPOConfig(n_envs=0),
        lambda: PPOConfig(net=()),
        lambda: PPOConfig(net=(64, 0)),
        lambda: PPOConfig(learning_rate=float("nan")),
        lambda: PPOConfig(gamma=1.5),
        lambda: PPOConfig(activation="elu"),  # type: ignore[arg-type]
        lambda: PPOConfig(learn_std="no"),  # type: ignore[arg-type]
        lambda: PPOConfig(gae_lambda=-0.1),
        lambda: PPOConfig(log_std_init=float("inf")),
        lambda: PPOConfig(n_envs=1, n_steps=1, batch_size=1),
        lambda: SACConfig(gamma=-1.0),
        lambda: SACConfig(buffer_size=0),
        lambda: SACConfig(learning_starts=-1),
    ],
)
def test_impossible_numbers_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match=r"^Input .+ must be .+; instead received .+"):
        make()
