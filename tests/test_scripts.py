"""The two commands as a user meets them: what they write, how they end, what they tell."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tiny_runs import OPTIONS

from agents.checkpoints import checkpoints, stored_config
from agents.classical import CLASSICAL
from agents.learned import Learned
from agents.learning import train
from agents.store import load_card
from magenv.command import friendly
from magenv.params import InputError

ROOT = Path(__file__).parents[1]
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "COLUMNS": "80"}
SHORT = """
import sys
sys.argv[0] = "train.py"
import train
from magenv.command import friendly
train.EPISODES, train.SCENARIOS = 1, ("approach-60",)
friendly(train.main)
"""
"""train.py, its comparison cut short."""


def command(script: str, *arguments: str) -> list[str]:
    """Return the command line of a script, ``short`` being train.py with a short comparison; warnings are errors."""
    code = ["-c", SHORT] if script == "short" else [str(ROOT / script)]
    return [sys.executable, "-W", "error", *code, *arguments]


def environment() -> dict[str, str]:
    """Return the environment of a process that finds the scripts' modules."""
    return ENVIRONMENT | {"PYTHONPATH": str(ROOT)}


def call(folder: Path, script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a script in a folder."""
    return subprocess.run(
        command(script, *arguments),
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start a script in a folder of the test's own; it is ended afterwards."""
    processes = []

    def begin(script: str, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            command(script, *arguments),
            cwd=tmp_path,
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        processes.append(process)
        return process

    yield begin
    for process in processes:
        process.kill()
        process.communicate()


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    """Wait until something is so, for a minute at most, while the process runs."""
    deadline = time.monotonic() + 60
    while not condition():
        if process.poll() is not None or time.monotonic() > deadline:
            pytest.fail(f"exit code {process.poll()}: {process.communicate()[1] if process.poll() is not None else ''}")
        time.sleep(0.02)


def summary(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of a report's summary."""
    rows: list[dict[str, Any]] = json.loads((folder / "summary.json").read_text())["rows"]
    return rows


# As a process.


def test_evaluate_writes_the_report(tmp_path: Path) -> None:
    out = tmp_path / "report"
    asked = ["--controllers", "idle", "baseline", "--scenarios", "approach-30-anti"]
    done = call(tmp_path, "evaluate.py", *asked, "--episodes", "1", "--seed", "7", "--out", str(out))
    assert done.returncode == 0, done.stderr
    rows = summary(out)
    assert [(row["controller"], row["scenario"]) for row in rows] == [
        ("idle", "approach-30-anti"),
        ("baseline", "approach-30-anti"),
    ]
    for row in rows:
        assert (row["plant"], row["n_epm"], row["control_hz"]) == ("paper", 2, 2.0)
        assert (row["seed"], row["episodes"]) == (7, 1)
    written = {path.name for path in out.iterdir()}
    assert {
        "report.md",
        "episodes.csv",
        "records",
        "replay-approach-30-anti.gif",
        "paths-approach-30-anti.png",
    } <= written
    assert "evaluate.py --controllers idle baseline" in (out / "report.md").read_text()
    assert "baseline" in done.stdout
    assert str(out / "report.md") in done.stdout.replace("\n", "")


def test_evaluate_lists_its_controllers(tmp_path: Path) -> None:
    done = call(tmp_path, "evaluate.py", "--list")
    assert (done.returncode, done.stderr) == (0, "")
    listed = done.stdout.splitlines()
    assert listed[: len(CLASSICAL)] == list(CLASSICAL)
    assert {"ppo", "home-ppo", "steered-ppo"} <= set(listed)
    assert len(set(listed)) == len(listed)
    assert not list(tmp_path.iterdir())


def test_evaluate_leaves_out_agents_made_for_another_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    asked = ["--n-epm", "3", "--episodes", "1", "--scenarios", "approach-60"]
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *asked])
    runpy.run_path(str(ROOT / "evaluate.py"), run_name="__main__")
    names = [row["controller"] for row in summary(tmp_path / "runs" / "evaluate")]
    assert names == ["baseline", "tuned", "steered-ppo-three"]
    assert re.search(r"left out: ppo \(Input n_epm for ppo must be 2.*received 3", capfd.readouterr().err)


def test_train_trains_compares_and_goes_on(tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = call(tmp_path, "short", *OPTIONS, "--steps", "256", "--checkpoint-every", "128", "--out", str(out))
    assert done.returncode == 0, done.stderr
    assert load_card(out / "model").steps == 256
    assert load_card(out / "model").command.startswith("python train.py --ppo.n-envs 8")
    assert {row["controller"] for row in summary(out)} == {"ppo", "baseline", "idle", "random"}
    assert (out / "progress.csv").read_text().count("\n") >= 3
    assert "ppo" in done.stdout
    assert "256/256" in done.stderr
    before = (out / "progress.csv").read_text()
    again = call(tmp_path, "short", "--resume", str(out), "--steps", "384")
    assert again.returncode == 0, again.stderr
    assert load_card(out / "model").steps == 384
    assert len((out / "progress.csv").read_text()) > len(before)
    assert [path.name for path in tmp_path.iterdir()] == ["run"], "the run has gone on in another folder"


def test_ctrl_c_in_train_leaves_a_model_and_a_checkpoint(
    tmp_path: Path, start: Callable[..., subprocess.Popen[str]]
) -> None:
    out = tmp_path / "run"
    process = start("train.py", *OPTIONS, "--steps", "10000000", "--checkpoint-every", "256", "--out", str(out))
    wait_for(lambda: bool(checkpoints(out)), process)
    process.send_signal(signal.SIGINT)
    told, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert f"--resume {out}" in told
    assert Learned(out / "model").card.steps == load_card(checkpoints(out)[-1]).steps >= 256
    rows = (out / "progress.csv").read_text().splitlines()
    assert len(rows) >= 2
    assert not (out / "summary.json").exists()
    _, finished = train(dataclasses.replace(stored_config(out), steps=load_card(out / "model").steps + 128))
    assert finished
    assert (out / "progress.csv").read_text().count("\n") > len(rows)


def test_ctrl_c_in_evaluate_leaves_a_report_of_what_was_done(
    tmp_path: Path, start: Callable[..., subprocess.Popen[str]]
) -> None:
    controllers = ("idle", "baseline")
    process = start("evaluate.py", "--controllers", *controllers, "--scenarios", "approach-60")
    out = tmp_path / "runs" / "evaluate"
    wait_for(out.exists, process)
    time.sleep(2.0)  # idle loses all its episodes at once; then baseline takes its time
    process.send_signal(signal.SIGINT)
    told, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    done = {row["controller"]: row["episodes"] for row in summary(out)}
    assert done["idle"] >= 1
    assert sum(done.values()) < 40
    assert (out / "report.md").is_file()
    assert "idle" in told


@pytest.mark.parametrize("arguments", [["--controllers", "idle", "--scenarios", "approach-5"], ["--episodes", "many"]])
def test_bad_input_ends_the_process_with_one_line(tmp_path: Path, arguments: list[str]) -> None:
    done = call(tmp_path, "evaluate.py", *arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


# Errors and help.


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("Input action must be finite; instead received [[nan\n 1.]]."), 2, r"error: .*\[\[nan 1\.\]\]\.\n"),
        (OSError(28, "No space left on device", "/full"), 2, "error: .*No space left.*\n"),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_an_end_by_error_is_told_in_one_line(
    error: BaseException, code: int, line: str, capfd: pytest.CaptureFixture[str]
) -> None:
    def main() -> None:
        raise error

    with pytest.raises(SystemExit) as end:
        friendly(main)
    assert end.value.code == code
    assert re.fullmatch(line, capfd.readouterr().err)


@pytest.mark.parametrize("kind", [RuntimeError, ValueError])
def test_a_fault_of_our_own_keeps_its_traceback(kind: type[Exception]) -> None:
    def main() -> None:
        raise kind("a fault")

    with pytest.raises(kind, match="a fault"):
        friendly(main)


@pytest.mark.parametrize("script", ["train.py", "evaluate.py"])
def test_help_tells_every_option(
    script: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [script, "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(ROOT / script), run_name="__main__")
    told = capfd.readouterr()
    assert end.value.code in (0, None)
    assert told.err == ""
    for option in ("--n-epm", "--plant", "--control-hz", "--seed", "--out"):
        assert option in told.out
