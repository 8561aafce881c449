"""Runs broken off, by Ctrl-C or killed: what is left is sound, and to go on from."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tiny_runs import Interrupter, MakeConfig, both, going_on, rows_of, steps_of, total_steps

from agents.checkpoints import BEST, MODEL, checkpoints
from agents.configs import PPOConfig, TrainConfig
from agents.evaluation import HeldOut, Score
from agents.learned import Learned
from agents.learning import train
from agents.store import TRAINING, load_card

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

KILLED_PPO = PPOConfig(n_envs=8, n_steps=16, batch_size=64, n_epochs=1, net=(8,))
KILLED = """
import os, signal, sys
from pathlib import Path
import agents.store
from agents.configs import PPOConfig, TrainConfig
from agents.evaluation import HeldOut, Score
from agents.learning import train

last, moments, judged = 0, 0, 0
save_file, replace = agents.store.save_file, os.replace

def killed_here():
    global moments
    moments += 1
    if moments == last:
        print(flush=True)
        os.kill(os.getpid(), signal.SIGKILL)

def saving(tensors, path):
    save_file(tensors, path)
    os.truncate(path, 100)
    killed_here()
    save_file(tensors, path)

def replacing(old, new):
    killed_here()
    replace(old, new)
    if Path(old).name == "new":
        print(Path(new).name, end=" ", flush=True)

def better(*_):
    global judged
    judged += 1
    return Score(judged / 10, 1.0, 1.0, 1.0)

ppo = PPOConfig(n_envs=8, n_steps=16, batch_size=64, n_epochs=1, net=(8,))
train(TrainConfig(action="home", ppo=ppo, steps=128, out=Path(sys.argv[1]) / "0"))  # loads what all need
agents.store.save_file, os.replace, HeldOut.score = saving, replacing, better
status = -1
while status != 0:
    last += 1
    child = os.fork()
    if child == 0:
        out = Path(sys.argv[1]) / str(last)
        train(TrainConfig(action="home", ppo=ppo, steps=256, checkpoint_every=128, out=out))
        print(flush=True)
        os._exit(0)
    status = os.waitpid(child, 0)[1]
    assert status in (0, signal.SIGKILL), status
"""
"""The same training again and again, each killed one moment later than the one before, until one comes to its end.

Moments are a file of tensors half written, and each move of a file or folder into place or out of the way. Each policy
is better than the one before. A line tells what of a training had been put in place when it was killed.
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, list[str]]:
    """Return the folders of trainings killed at every moment, each with what had been put in place, in this order."""
    folder = tmp_path_factory.mktemp("killed")
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(folder)],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return {folder / str(k + 1): line.split() for k, line in enumerate(done.stdout.splitlines())}


def test_a_run_killed_at_any_moment_loses_at_most_what_came_after_its_last_checkpoint(
    killed: dict[Path, list[str]],
) -> None:
    first, second = "step-000000000128", "step-000000000256"
    *_, whole = killed.values()
    assert whole == ["best", first, "best", second, "best", "model", second]
    assert len(killed) > 2 * len(whole)
    for run, stored in killed.items():
        steps = steps_of(run)
        # Where a checkpoint takes the place of one after as many steps, that one may be gone, but not the one before.
        kept = [128 * (k + 1) for k, name in enumerate((first, second)) if name in stored]
        assert steps == kept or (steps == kept[:-1] and stored[-1] == MODEL)
        for folder in checkpoints(run):
            Learned(folder)
            assert (folder / TRAINING).is_file()
        if not steps:  # no checkpoint was due yet
            assert train(TrainConfig(action="home", ppo=KILLED_PPO, steps=128, out=run)) == (run, True)
            continue
        with pytest.MonkeyPatch.context() as patch:  # no policy is better than those before
            patch.setattr(HeldOut, "score", lambda *_: Score(0.0, 1.0, 1.0, 0.0))
            assert train(going_on(run, steps=384)) == (run, True)
        best = load_card(run / BEST).score
        assert best is not None
        assert best.success_rate >= stored.count("best") / 10
        Learned(run / BEST)
        assert load_card(run / MODEL).steps == 384
        assert total_steps(rows_of(run))[0] == 128
        left = {path.name for path in run.iterdir() if not path.name.startswith("events.")}
        assert left == {".lock", "best", "checkpoints", "model", "progress.csv"}, "something half done is left over"
        assert all(path.name[5:].isdigit() for path in (run / "checkpoints").iterdir())


def test_after_a_kill_progress_tells_only_what_counts(make_config: MakeConfig) -> None:
    train(make_config())
    shutil.rmtree(checkpoints(make_config().out)[-1])  # as if killed after the last rollout, before its checkpoint
    log = make_config().out / "progress.csv"
    told = log.read_text()
    columns = len(told.splitlines()[0].split(","))
    numbers = ",".join(map(str, range(1, columns + 2)))
    log.write_text(told + numbers + "\n" + numbers[:-6] + "\n")  # damaged, and half written
    train(going_on(make_config().out))
    steps = total_steps(rows_of(make_config().out))
    assert steps == sorted(steps)
    assert steps[-1] == 512
    updates = [int(row["train/n_updates"]) for row in rows_of(make_config().out) if row["train/n_updates"]]
    assert updates == sorted(updates)
