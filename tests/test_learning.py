"""Training: an agent learns, a run can be repeated, broken off and gone on with, and keeps what it has."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from agents.checkpoints import checkpoints, restore, save_model, stored_config
from agents.configs import PPOConfig, SACConfig, TrainConfig
from agents.learned import Learned
from agents.learning import build, train
from agents.rollout import run
from agents.sb3_vec import TwoRobotsVecEnv
from agents.store import CARD, POLICY, TRAINING, load_card, load_policy, load_training
from magenv.params import PLANTS, Body, Plant

PPO_CONFIG = TrainConfig(
    ppo=PPOConfig(n_envs=8, n_steps=16, batch_size=64, n_epochs=2, net=(16, 16)), steps=512, checkpoint_every=128
)
"""Four rollouts of 128 steps, a checkpoint after each."""
SAC_CONFIG = TrainConfig(
    algo="sac",
    sac=SACConfig(n_envs=8, batch_size=32, buffer_size=2000, learning_starts=64, gradient_steps=2, net=(16, 16)),
    steps=320,
    checkpoint_every=160,
)
OPTIMISERS = {"ppo": ["policy.optimizer"], "sac": ["actor.optimizer", "critic.optimizer", "ent_coef_optimizer"]}
CONFIGS = {"ppo": PPO_CONFIG, "sac": SAC_CONFIG}
both = pytest.mark.parametrize("algo", ["ppo", "sac"])

MakeConfig = Callable[..., TrainConfig]


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in a folder of the test's own, so that default folders are not the project's."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def config(tmp_path: Path) -> MakeConfig:
    """Return a tiny training's configuration with changes, its run in the folder ``run``."""

    def make(algo: str = "ppo", **changes: Any) -> TrainConfig:
        return dataclasses.replace(CONFIGS[algo], **({"out": tmp_path / "run"} | changes))

    return make


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


# It learns.


def test_an_agent_learns_a_tiny_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time under control grows from a fifth of a second to half a minute and more; so it does with other seeds."""
    monkeypatch.setitem(PLANTS, "tiny", Plant(body=Body(drag_linear_nspm=0.15, drag_rotational_nmsprad=5e-5)))
    settings = PPOConfig(n_envs=64, n_steps=32, batch_size=512, n_epochs=8, learning_rate=1e-3)
    tiny = TrainConfig(
        scenario="approach-100", plant="tiny", control_hz=10.0, steps=49_152, out=tmp_path / "run", ppo=settings
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
def test_a_run_leaves_model_checkpoints_and_progress(config: MakeConfig, algo: str) -> None:
    wanted = config(algo)
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


def test_the_model_is_the_last_checkpoint(config: MakeConfig) -> None:
    train(config())
    last = load_file(checkpoints(config().out)[-1] / POLICY)
    model = tensors_of(config().out)
    assert last.keys() == model.keys()
    assert all(torch.equal(last[name], model[name]) for name in model)


def learning_rate(checkpoint: Path) -> float:
    """Return the learning rate of the last gradient step before a PPO checkpoint."""
    return load_training(checkpoint)["policy.optimizer.param_groups.0.lr"].item()


@pytest.mark.parametrize("steps", [1, 100, 512, 600])
def test_the_learning_rate_falls_to_a_tenth_and_no_further(config: MakeConfig, steps: int) -> None:
    """Steps come in whole rollouts: a run may end beyond the steps asked for."""
    train(config(steps=steps))
    last = checkpoints(config().out)[-1]
    assert load_card(last).steps == -(-steps // 128) * 128
    assert learning_rate(last) == pytest.approx(0.1 * PPO_CONFIG.ppo.learning_rate)


# Going on.


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
        assert state["state"][0]["step"] >= 2
        assert state["state"][0]["exp_avg"].abs().max() > 0
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
def test_a_resumed_run_goes_on_where_it_stood(config: MakeConfig, algo: str) -> None:
    first = config(algo)
    train(first)
    before, past = load_training(checkpoints(first.out)[-1]), rows_of(first.out)
    _, finished = train(going_on(first.out, steps=2 * first.total_steps))
    assert finished
    assert steps_of(first.out)[-1] == load_card(first.out / "model").steps == 2 * first.total_steps
    after = load_training(checkpoints(first.out)[-1])
    (name,) = (key for key in before if key.endswith("optimizer.state.0.step") and key.startswith(("policy", "actor")))
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


def rates_of(run_folder: Path) -> list[tuple[int, float]]:
    """Return the learning rates in progress.csv, each with the steps of its row."""
    rows = [row for row in rows_of(run_folder) if row["train/learning_rate"]]
    return [(steps, float(row["train/learning_rate"])) for steps, row in zip(total_steps(rows), rows, strict=True)]


def test_the_learning_rate_goes_on_falling_after_a_resume(config: MakeConfig) -> None:
    with pytest.MonkeyPatch.context() as patch:
        Interrupter(patch, at=40)
        train(config())
    before = rates_of(config().out)
    train(going_on(config().out))
    rates = [rate for _, rate in rates_of(config().out)]
    assert rates == sorted(rates, reverse=True)
    assert len(rates) > len(before)
    assert rates[0] == pytest.approx((0.1 + 0.9 * (1 - 128 / 512)) * PPO_CONFIG.ppo.learning_rate)
    assert learning_rate(checkpoints(config().out)[-1]) == pytest.approx(0.1 * PPO_CONFIG.ppo.learning_rate)


def test_a_longer_run_has_the_learning_rates_of_one_planned_so_long(config: MakeConfig) -> None:
    train(config())
    train(going_on(config().out, steps=1024))
    planned = [(0.1 + 0.9 * (1 - steps / 1024)) * PPO_CONFIG.ppo.learning_rate for steps in (640, 768, 896, 1024)]
    rates = [rate for steps, rate in rates_of(config().out) if steps > 640]
    assert rates[:3] == pytest.approx(planned[:3])
    assert rates[3:] in ([], pytest.approx(planned[3:]))


def test_a_resumed_run_does_not_meet_its_first_episodes_again(config: MakeConfig) -> None:
    train(config(steps=128))
    seen = []
    original = TwoRobotsVecEnv.reset

    def watched(env: TwoRobotsVecEnv) -> Any:
        seen.append(original(env))
        return seen[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TwoRobotsVecEnv, "reset", watched)
        train(config(steps=128, out=config().out.parent / "again"))
        train(going_on(config().out, steps=256))
        train(going_on(config().out, steps=384))
    fresh, second, third = seen
    assert not np.array_equal(second, fresh)
    assert not np.array_equal(third, fresh)
    assert not np.array_equal(third, second)


def test_a_run_can_be_gone_on_with_elsewhere(config: MakeConfig, tmp_path: Path) -> None:
    train(config())
    before = {path.name: path.stat().st_mtime_ns for path in config().out.rglob("*")}
    train(going_on(config().out, steps=640, out=tmp_path / "elsewhere"))
    assert {path.name: path.stat().st_mtime_ns for path in config().out.rglob("*")} == before
    assert load_card(tmp_path / "elsewhere" / "model").steps == 640
    assert total_steps(rows_of(tmp_path / "elsewhere"))[0] == 128


def test_a_resumed_sac_fills_its_replay_buffer_by_its_policy_before_it_learns(
    config: MakeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(config("sac"))
    sizes, original = [], SAC.train

    def watched(model: SAC, gradient_steps: int, batch_size: int = 64) -> None:
        assert model.replay_buffer is not None
        sizes.append(model.replay_buffer.size() * model.n_envs)
        assert gradient_steps == SAC_CONFIG.sac.gradient_steps
        original(model, gradient_steps, batch_size)

    monkeypatch.setattr(SAC, "train", watched)
    monkeypatch.setattr("gymnasium.spaces.Box.sample", lambda _: pytest.fail("a random action"))
    train(going_on(config().out, steps=640))
    assert sizes[0] >= SAC_CONFIG.sac.learning_starts
    assert len(sizes) > 20


def test_runs_that_cannot_be_gone_on_with_are_refused(config: MakeConfig, tmp_path: Path) -> None:
    def refused(**changes: Any) -> str:
        with pytest.raises(ValueError, match=r"^Input .+ must .+; instead received .+") as raised:
            train(going_on(**({"run_folder": config().out, "steps": 1024} | changes)))
        assert "\n" not in str(raised.value)
        return str(raised.value)

    assert "resume" in refused(run_folder=tmp_path / "nowhere")
    train(config())
    assert "steps" in refused(steps=512)
    assert "'ppo', as in the run gone on with; instead received 'sac'" in refused(algo="sac")
    assert "n_epm" in refused(n_epm=3)
    assert "ppo" in refused(ppo=PPOConfig(gamma=0.5))
    kept = tmp_path / "kept"
    shutil.copytree(config().out, kept)

    def doctored(file: str, change: Callable[[Path], object]) -> None:
        shutil.rmtree(config().out)
        shutil.copytree(kept, config().out)
        change(checkpoints(config().out)[-1] / file)
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
    doctored(TRAINING, tensors(lambda raw: raw.update({"policy.optimizer.state.0.exp_avg": torch.zeros(3)})))
    doctored(TRAINING, tensors(lambda raw: raw.update({"policy.optimizer.state.99.exp_avg": torch.zeros(3)})))
    doctored(TRAINING, tensors(lambda raw: raw.update({"policy.optimizer.state.x.exp_avg": torch.zeros(3)})))


# Breaking off.


@both
def test_ctrl_c_leaves_a_model_and_a_checkpoint_to_go_on_from(
    config: MakeConfig, algo: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = config(algo)
    with monkeypatch.context() as patch:
        Interrupter(patch, at=26)  # 25 steps of 8 environments are done
        _, finished = train(wanted, "python train.py")
    folder = wanted.out / "model"
    assert not finished
    assert load_card(folder).steps == steps_of(wanted.out)[-1] == 200
    assert Learned(folder).predict(np.zeros(63, np.float32))[0].shape == (10,)
    assert total_steps(rows_of(wanted.out))[-1] == 200
    _, finished = train(going_on(wanted.out))
    assert finished
    assert load_card(folder).steps >= wanted.total_steps
    steps = total_steps(rows_of(wanted.out))
    assert 200 in steps
    assert steps == sorted(steps)


@pytest.mark.parametrize("at", [0, 1])
def test_ctrl_c_before_anything_is_learned_leaves_nothing_that_hinders(
    config: MakeConfig, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    with monkeypatch.context() as patch:
        Interrupter(patch, at)
        with pytest.raises(KeyboardInterrupt):
            train(config())
    assert not (config().out / "model").exists()
    assert train(config()) == (config().out, True)


def test_ctrl_c_right_after_a_resume_keeps_what_was_there(config: MakeConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    train(config())
    with monkeypatch.context() as patch:
        Interrupter(patch, at=0)
        with pytest.raises(KeyboardInterrupt):
            train(going_on(config().out, steps=640))
    assert steps_of(config().out)[-1] == 512
    train(going_on(config().out, steps=640))
    assert steps_of(config().out)[-1] == 640


def files_of(folder: Path) -> dict[Path, bytes]:
    """Return all files below a folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_new_run_never_takes_the_folder_of_an_old_one(config: MakeConfig, tmp_path: Path) -> None:
    train(config())
    before = files_of(config().out)
    for again in (config(seed=1), going_on(config().out, steps=640, out=config().out.parent / "other")):
        (tmp_path / "other" / "model").mkdir(parents=True, exist_ok=True)
        with pytest.raises(ValueError, match=r"^Input out must be a folder without a run"):
            train(again)
    assert files_of(config().out) == before


def test_two_runs_begun_at_once_have_folders_of_their_own(config: MakeConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    inner, original = [], PPO.learn

    def learn(model: PPO, *arguments: Any, **options: Any) -> PPO:
        if not inner:
            inner.append(None)
            inner[0] = train(config(steps=128, out=None))[0]
        return original(model, *arguments, **options)

    monkeypatch.setattr(PPO, "learn", learn)
    outer, _ = train(config(steps=128, out=None, seed=1))
    assert (outer, inner[0]) == (Path("runs/train"), Path("runs/train-2"))
    assert [load_card(folder / "model").config["seed"] for folder in (outer, inner[0])] == [1, 0]


def test_a_run_in_training_cannot_be_gone_on_with(config: MakeConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    train(config())
    original = PPO.learn
    tried = []

    def learn(model: PPO, *arguments: Any, **options: Any) -> PPO:
        if not tried:
            tried.append(True)
            with pytest.raises(ValueError, match=r"^Input resume must be a run at rest; instead received .+"):
                train(going_on(config().out, steps=1024))
        return original(model, *arguments, **options)

    monkeypatch.setattr(PPO, "learn", learn)
    train(going_on(config().out, steps=640))
    assert tried
    assert steps_of(config().out)[-1] == 640


def test_checkpoints_come_ten_times_a_run_or_more() -> None:
    assert TrainConfig().checkpoint_steps == 250_000
    assert TrainConfig(algo="sac").checkpoint_steps == 20_000
    assert TrainConfig(steps=5).checkpoint_steps == 1
    assert TrainConfig(checkpoint_every=7).checkpoint_steps == 7


def test_a_run_killed_before_its_first_checkpoint_leaves_its_folder_free(config: MakeConfig) -> None:
    folder = config().out
    killed = KILLED.replace("files == 4", "files == 1")
    done = subprocess.run(
        [sys.executable, "-c", killed, str(folder)],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    assert not checkpoints(folder)
    assert train(config()) == (folder, True)


def test_after_a_kill_progress_tells_only_what_counts(config: MakeConfig) -> None:
    train(config())
    shutil.rmtree(checkpoints(config().out)[-1])  # as if killed after the last rollout, before its checkpoint
    log = config().out / "progress.csv"
    log.write_text(
        log.read_text() + "1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24\n"
    )  # and half written
    train(going_on(config().out))
    steps = total_steps(rows_of(config().out))
    assert steps == sorted(steps)
    assert steps[-1] == 512
    updates = [int(row["train/n_updates"]) for row in rows_of(config().out) if row["train/n_updates"]]
    assert updates == sorted(updates)


def test_default_folders_are_counted_up(config: MakeConfig) -> None:
    folders = [train(config(steps=128, out=None))[0] for _ in range(3)]
    assert folders == [Path("runs/train"), Path("runs/train-2"), Path("runs/train-3")]
    assert [load_card(folder / "model").steps for folder in folders] == [128] * 3


def test_going_on_in_the_same_folder_by_another_name(config: MakeConfig) -> None:
    train(config())
    (config().out.parent / "alias").symlink_to(config().out)
    train(going_on(config().out, steps=640, out=config().out.parent / "alias"))
    assert steps_of(config().out)[-1] == 640


KILLED = """
import os, signal, sys
from pathlib import Path
from safetensors.torch import save_file
import agents.store
from agents.configs import PPOConfig, TrainConfig
from agents.learning import train

files = 0

def killing(tensors, path):
    global files
    files += 1
    save_file(tensors, path)
    if files == 4:  # the optimisers of the second checkpoint
        os.truncate(path, 100)
        os.kill(os.getpid(), signal.SIGKILL)

agents.store.save_file = killing
ppo = PPOConfig(n_envs=8, n_steps=16, batch_size=64, n_epochs=2, net=(16, 16))
train(TrainConfig(ppo=ppo, steps=512, checkpoint_every=128, out=Path(sys.argv[1])))
"""


def test_a_run_killed_while_it_writes_a_checkpoint_goes_on_from_the_one_before(config: MakeConfig) -> None:
    folder = config().out
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, str(folder)],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    assert steps_of(folder) == [128]
    Learned(checkpoints(folder)[-1])
    _, finished = train(going_on(folder))
    assert finished
    assert load_card(folder / "model").steps == 512
    assert total_steps(rows_of(folder))[0] == 128
    assert all(path.name[5:].isdigit() for path in (folder / "checkpoints").iterdir()), "the half one is left over"


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
def test_an_unsound_configuration_is_refused_before_anything_is_written(config: MakeConfig, changes: Any) -> None:
    with pytest.raises(ValueError, match=r"^Input .+ must .+; instead received .+"):
        train(config(**changes))
    assert not config().out.exists()


@pytest.mark.parametrize(
    "make",
    [
        lambda: TrainConfig(algo="dqn"),  # type: ignore[arg-type]
        lambda: TrainConfig(steps=0),
        lambda: TrainConfig(seed=-1),
        lambda: TrainConfig(checkpoint_every=0),
        lambda: PPOConfig(n_envs=0),
        lambda: PPOConfig(net=()),
        lambda: PPOConfig(net=(64, 0)),
        lambda: PPOConfig(learning_rate=float("nan")),
        lambda: PPOConfig(gamma=1.5),
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


@pytest.mark.parametrize("kind", ["file", "foreign model"])
def test_an_out_folder_that_cannot_be_used_is_refused_at_once(
    config: MakeConfig, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stable_baselines3.PPO.learn", lambda *_, **__: pytest.fail("training has begun"))
    if kind == "file":
        precious = tmp_path / "run"
    else:
        precious = tmp_path / "run" / "model" / "thesis.txt"
        precious.parent.mkdir(parents=True)
    precious.write_text("ten years")
    with pytest.raises(ValueError, match=r"^Input out must be .+; instead received .+") as raised:
        train(config())
    assert "\n" not in str(raised.value)
    assert precious.read_text() == "ten years"
