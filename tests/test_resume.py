"""A run gone on with: the agent restored is the one saved, and the run goes on where it stood."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from messages import refusal
from safetensors.torch import load_file, save_file
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize
from tiny_runs import CONFIGS, PPO_CONFIG, SAC_CONFIG, MakeConfig, both, going_on, rows_of, steps_of, total_steps

from agents.checkpoints import checkpoints, restore, save_model
from agents.configs import PPOConfig
from agents.learning import build, train
from agents.sb3_vec import TwoRobotsVecEnv
from agents.store import CARD, TRAINING, load_card, load_policy, load_training

pytestmark = pytest.mark.usefixtures("elsewhere")

OPTIMISERS = {"ppo": ["policy.optimizer"], "sac": ["actor.optimizer", "critic.optimizer", "ent_coef_optimizer"]}


def live(algo: str) -> tuple[BaseAlgorithm, VecNormalize]:
    """Return an agent after its first gradient steps."""
    model, env = build(CONFIGS[algo])
    model.learn(256)
    return model, env


def assert_equal_state(one: Any, other: Any) -> None:
    """Compare nested dictionaries and lists of tensors and numbers, bit for bit."""
    if isinstance(one, torch.Tensor):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal_state(one[key], other[key])
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_equal_state(a, b)
    else:
        assert one == other


@both
def test_a_restored_agent_is_the_saved_one(algo: str, tmp_path: Path) -> None:
    model, env = live(algo)
    save_model(tmp_path / "saved", model, env, CONFIGS[algo], True, "")
    again, its_env = build(dataclasses.replace(CONFIGS[algo], seed=99))
    restore(tmp_path / "saved", again, its_env, algo)
    assert again.num_timesteps == model.num_timesteps == 256
    assert_equal_state(again.policy.state_dict(), model.policy.state_dict())
    for path in OPTIMISERS[algo]:
        one, other = model, again
        for name in path.split("."):
            one, other = getattr(one, name), getattr(other, name)
        state = one.state_dict()  # type: ignore[attr-defined]
        some = next(iter(state["state"].values()))  # a standard deviation that is not learned has none
        assert some["step"] >= 2
        assert some["exp_avg"].abs().max() > 0
        assert_equal_state(other.state_dict(), state)  # type: ignore[attr-defined]
    if algo == "sac":
        assert torch.equal(again.log_ent_coef, model.log_ent_coef)  # type: ignore[attr-defined]
        assert again.log_ent_coef.requires_grad  # type: ignore[attr-defined]
    for name in ("mean", "var", "count"):
        np.testing.assert_array_equal(getattr(its_env.obs_rms, name), getattr(env.obs_rms, name))


def test_a_restored_agent_learns_from_the_same_data_what_the_saved_one_would(tmp_path: Path) -> None:
    model, env = live("ppo")
    save_model(tmp_path / "saved", model, env, PPO_CONFIG, True, "")
    again, its_env = build(PPO_CONFIG)
    restore(tmp_path / "saved", again, its_env, "ppo")
    again.rollout_buffer = model.rollout_buffer  # type: ignore[attr-defined]
    for agent in (model, again):
        agent.set_logger(model.logger)
        agent._current_progress_remaining = 0.4  # type: ignore[attr-defined]
        np.random.seed(1)  # noqa: NPY002 (SB3 shuffles with it)
        agent.train()  # type: ignore[attr-defined]
    assert_equal_state(again.policy.state_dict(), model.policy.state_dict())


@both
def test_a_resumed_run_goes_on_where_it_stood(make_config: MakeConfig, algo: str) -> None:
    first = make_config(algo)
    train(first)
    before, past = load_training(checkpoints(first.out)[-1]), rows_of(first.out)
    _, finished = train(going_on(first.out, steps=2 * first.total_steps))
    assert finished
    assert steps_of(first.out)[-1] == load_card(first.out / "model").steps == 2 * first.total_steps
    after = load_training(checkpoints(first.out)[-1])
    (name,) = (key for key in before if key.endswith("optimizer.state.1.step") and key.startswith(("policy", "actor")))
    done = before[name].item()
    assert after[name].item() >= 2 * done - 40
    if algo == "ppo":
        assert after[name].item() == 2 * done
    counted = [load_policy(folder)[1].count for folder in checkpoints(first.out)]
    assert counted[-1] == pytest.approx(2 * first.total_steps + 2 * 8, abs=1)  # a first observation per start
    rows = rows_of(first.out)
    assert [{key: row[key] for key in old} for row, old in zip(rows, past, strict=False)] == past
    assert total_steps(rows)[-1] == 2 * first.total_steps
    assert len(rows) > len(past)
    assert not Path("runs").exists()


def test_a_resumed_run_does_not_meet_its_first_episodes_again(make_config: MakeConfig) -> None:
    train(make_config(steps=128))
    seen = []
    original = TwoRobotsVecEnv.reset

    def watched(env: TwoRobotsVecEnv) -> Any:
        seen.append(original(env))
        return seen[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TwoRobotsVecEnv, "reset", watched)
        train(make_config(steps=128, out=make_config().out.parent / "again"))
        train(going_on(make_config().out, steps=256))
        train(going_on(make_config().out, steps=384))
    fresh, second, third = seen
    assert not np.array_equal(second, fresh)
    assert not np.array_equal(third, fresh)
    assert not np.array_equal(third, second)


def test_a_resumed_sac_fills_its_replay_buffer_by_its_policy_before_it_learns(
    make_config: MakeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(make_config("sac"))
    sizes, original = [], SAC.train

    def watched(model: SAC, gradient_steps: int, batch_size: int = 64) -> None:
        assert model.replay_buffer is not None
        sizes.append(model.replay_buffer.size() * model.n_envs)
        assert gradient_steps == SAC_CONFIG.sac.gradient_steps
        original(model, gradient_steps, batch_size)

    monkeypatch.setattr(SAC, "train", watched)
    monkeypatch.setattr("gymnasium.spaces.Box.sample", lambda _: pytest.fail("a random action"))
    train(going_on(make_config().out, steps=640))
    assert sizes[0] >= SAC_CONFIG.sac.learning_starts
    assert len(sizes) > 20


def test_runs_that_cannot_be_gone_on_with_are_refused(make_config: MakeConfig, tmp_path: Path) -> None:
    def refused(**changes: Any) -> str:
        return refusal(lambda: train(going_on(**({"run_folder": make_config().out, "steps": 1024} | changes))))

    assert "resume" in refused(run_folder=tmp_path / "nowhere")
    train(make_config())
    assert "steps" in refused(steps=512)
    assert "'ppo', as in the run gone on with; instead received 'sac'" in refused(algo="sac")
    assert "n_epm" in refused(n_epm=3)
    assert "ppo" in refused(ppo=PPOConfig(gamma=0.5))
    kept = tmp_path / "kept"
    shutil.copytree(make_config().out, kept)

    def doctored(file: str, change: Callable[[Path], object]) -> None:
        shutil.rmtree(make_config().out)
        shutil.copytree(kept, make_config().out)
        change(checkpoints(make_config().out)[-1] / file)
        refused()

    def card(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], object]:
        def apply(path: Path) -> None:
            raw = json.loads(path.read_text())
            change(raw)
            path.write_text(json.dumps(raw))

        return apply

    def tensors(change: Callable[[dict[str, torch.Tensor]], object]) -> Callable[[Path], object]:
        def apply(path: Path) -> None:
            raw = load_file(path)
            change(raw)
            save_file(raw, path)

        return apply

    doctored(CARD, card(lambda raw: raw["config"].pop("ppo")))
    doctored(CARD, card(lambda raw: raw["config"].update(algo="dqn", steps=None)))
    doctored(CARD, card(lambda raw: raw["config"].update(n_epm=3)))
    doctored(CARD, card(lambda raw: raw["config"]["ppo"].update(net=[32, 32])))
    doctored(CARD, card(lambda raw: raw["config"]["ppo"].update(n_envs="many")))
    doctored(TRAINING, lambda path: path.unlink())
    doctored(TRAINING, tensors(lambda raw: raw.pop("policy.optimizer.param_groups.0.lr")))
    doctored(TRAINING, tensors(lambda raw: raw.update({"policy.optimizer.state.1.exp_avg": torch.zeros(3)})))
    doctored(TRAINING, tensors(lambda raw: raw.update({"policy.optimizer.state.99.exp_avg": torch.zeros(3)})))
    doctored(TRAINING, tensors(lambda raw: raw.update({"policy.optimizer.state.x.exp_avg": torch.zeros(3)})))
    doctored(TRAINING, tensors(lambda raw: raw.pop("policy.optimizer.state.1.exp_avg")))
    doctored(TRAINING, tensors(lambda raw: raw.update({"policy.optimizer.state.1.more": torch.zeros(16, 63)})))
    doctored(TRAINING, tensors(lambda raw: [raw.pop(name) for name in list(raw) if ".state.3." in name]))
