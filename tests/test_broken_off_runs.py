"""Runs broken off, by Ctrl-C or killed: what is left is sound, and to go on from."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tiny_runs import Interrupter, MakeConfig, both, going_on, rows_of, steps_of, total_steps

from agents.checkpoints import checkpoints
from agents.configs import TrainConfig
from agents.learned import Learned
from agents.learning import train
from agents.store import load_card

pytestmark = pytest.mark.usefixtures("elsewhere")


@both
def test_ctrl_c_leaves_a_model_and_a_checkpoint_to_go_on_from(
    make_config: MakeConfig, algo: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = make_config(algo)
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
    make_config: MakeConfig, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    with monkeypatch.context() as patch:
        Interrupter(patch, at)
        with pytest.raises(KeyboardInterrupt):
            train(make_config())
    assert not (make_config().out / "model").exists()
    assert train(make_config()) == (make_config().out, True)


def test_ctrl_c_right_after_a_resume_keeps_what_was_there(
    make_config: MakeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(make_config())
    with monkeypatch.context() as patch:
        Interrupter(patch, at=0)
        with pytest.raises(KeyboardInterrupt):
            train(going_on(make_config().out, steps=640))
    assert steps_of(make_config().out)[-1] == 512
    train(going_on(make_config().out, steps=640))
    assert steps_of(make_config().out)[-1] == 640


# Killed.

KILLED = """
import os, signal, sys
from pathlib import Path
from safetensors.numpy import save_file
import agents.store
from agents.configs import PPOConfig, TrainConfig
from agents.learning import train

files = 0

def killing(tensors, path):
    global files
    files += 1
    save_file(tensors, path)
    if files == int(sys.argv[2]):
        os.truncate(path, 100)
        os.kill(os.getpid(), signal.SIGKILL)

agents.store.save_file = killing
ppo = PPOConfig(n_envs=8, n_steps=16, batch_size=64, n_epochs=2, net=(16, 16))
train(TrainConfig(ppo=ppo, steps=512, checkpoint_every=128, out=Path(sys.argv[1])))
"""


def train_killed(config: TrainConfig, files: int) -> None:
    """Train in a process of its own, killed when half of its ``files``-th file of tensors is written."""
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(config.out), str(files)],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()


def test_a_run_killed_before_its_first_checkpoint_leaves_its_folder_free(make_config: MakeConfig) -> None:
    folder = make_config().out
    train_killed(make_config(), 1)
    assert not checkpoints(folder)
    assert train(make_config()) == (folder, True)


def test_a_run_killed_while_it_writes_a_checkpoint_goes_on_from_the_one_before(make_config: MakeConfig) -> None:
    folder = make_config().out
    train_killed(make_config(), 4)  # the optimisers of the second checkpoint
    assert steps_of(folder) == [128]
    Learned(checkpoints(folder)[-1])
    _, finished = train(going_on(folder))
    assert finished
    assert load_card(folder / "model").steps == 512
    assert total_steps(rows_of(folder))[0] == 128
    assert all(path.name[5:].isdigit() for path in (folder / "checkpoints").iterdir()), "the half one is left over"


def test_after_a_kill_progress_tells_only_what_counts(make_config: MakeConfig) -> None:
    train(make_config())
    shutil.rmtree(checkpoints(make_config().out)[-1])  # as if killed after the last rollout, before its checkpoint
    log = make_config().out / "progress.csv"
    log.write_text(
        log.read_text() + "1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24\n"
    )  # and half written
    train(going_on(make_config().out))
    steps = total_steps(rows_of(make_config().out))
    assert steps == sorted(steps)
    assert steps[-1] == 512
    updates = [int(row["train/n_updates"]) for row in rows_of(make_config().out) if row["train/n_updates"]]
    assert updates == sorted(updates)
