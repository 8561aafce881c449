"""Bad input to the commands: one line, exit code 2, nothing written."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest
from tiny_runs import OPTIONS, files_of

ROOT = Path(__file__).parents[1]
BAD = {
    "controller": ("evaluate.py", ["--controllers", "nobody"], "baseline.*'nobody'"),
    "no controller": ("evaluate.py", ["--controllers"], "controllers"),
    "controller twice": ("evaluate.py", ["--controllers", "idle", "idle"], "each once.*'idle', 'idle'"),
    "scenario": ("evaluate.py", ["--controllers", "idle", "--scenarios", "approach-60", "line"], "approach.*'line'"),
    "scenario twice": ("evaluate.py", ["--controllers", "idle", "--scenarios", "random", "random"], "each once"),
    "controllers of one file": ("evaluate.py", ["--controllers", "id-le", "id/le"], "'id-le'"),
    "seed too large": ("evaluate.py", ["--controllers", "idle", "--seed", str(2**63 - 1)], "4294967295"),
    "plant": ("evaluate.py", ["--controllers", "idle", "--plant", "moon"], "paper.*'moon'"),
    "episodes": ("evaluate.py", ["--controllers", "idle", "--episodes", "0"], "at least 1.*0"),
    "seed": ("evaluate.py", ["--controllers", "idle", "--seed", "-1"], "from 0 to .*-1"),
    "n_epm 0": ("evaluate.py", ["--controllers", "idle", "--n-epm", "0"], "2 or 3.*0"),
    "n_epm 0 of the baseline": ("evaluate.py", ["--controllers", "baseline", "--n-epm", "0"], "n_epm.*0"),
    "n_epm 1": ("evaluate.py", ["--controllers", "idle", "--n-epm", "1"], "2 or 3.*1"),
    "control_hz": ("evaluate.py", ["--controllers", "idle", "--control-hz", "0"], "control_hz.*0.0"),
    "ladder": ("evaluate.py", ["--controllers", "idle", "--ladder", "down"], "'down'.*parallel"),
    "ladder of a plant": ("evaluate.py", ["--ladder", "anti", "--plant", "moon"], "paper.*'moon'"),
    "jobs": ("evaluate.py", ["--controllers", "idle", "--ladder", "anti", "--jobs", "0"], "jobs.*at least 1.*0"),
    "ladder and robustness": ("evaluate.py", ["--ladder", "anti", "--robustness"], "without --ladder.*'--ladder anti'"),
    "robustness on no scenario": ("evaluate.py", ["--controllers", "idle", "--robustness", "--scenarios"], "each once"),
    "workspace": ("evaluate.py", ["--controllers=idle", "--plant=paper:workspace_radius_m=0.05"], "wall at 50"),
    "figures of no ladder": ("agents/ladder_figures.py", ["runs/nothing"], "ladder.json.*'runs/nothing/ladder.json'"),
    "no model": ("evaluate.py", ["--controllers", "runs/nothing"], "model's folder.*'runs/nothing'"),
    "option": ("evaluate.py", ["--controler", "idle"], "--controler"),
    "number": ("evaluate.py", ["--n-epm", "two"], "n-epm must be a whole number; instead received 'two'"),
    "algorithm": ("train.py", ["--algo", "dqn"], "'dqn'.*ppo.*sac"),
    "train scenario": ("train.py", ["--scenario", "line"], "approach.*'line'"),
    "train plant": ("train.py", ["--plant", "moon"], "paper.*'moon'"),
    "train n_epm": ("train.py", ["--n-epm", "0"], "2 or 3.*0"),
    "train action": ("train.py", ["--action", "jump"], "'jump'.*home"),
    "train residual": ("train.py", ["--residual", "nobody"], "residual must be one of baseline, .*'nobody'"),
    "train residual_scale": (
        "train.py",
        ["--residual", "tuned", "--residual-scale", "0"],
        "residual_scale.*above 0.*0",
    ),
    "train residual action": ("train.py", ["--residual", "tuned", "--action", "home"], "action.*'pose'.*tuned.*'home'"),
    "train residual frame": ("train.py", ["--residual", "tuned", "--frame", "global"], "'robots'.*tuned.*'global'"),
    "train residual errors": ("train.py", ["--residual", "idle", "--observation", "errors"], "'full'.*idle.*'errors'"),
    "train steps": ("train.py", ["--steps", "0"], "error: Input steps must be a whole number of at least 1.*0"),
    "train steps, words": ("train.py", ["--steps", "abc"], "steps must be a whole number; instead received 'abc'"),
    "train seed": ("train.py", ["--seed", "-1"], "from 0 to 4294967295; instead received -1"),
    "train gamma": ("train.py", ["--ppo.gamma", "2"], "error: Input gamma must be .* at most 1.*2"),
    "train net": ("train.py", ["--ppo.net", "0"], "widths.*0"),
    "trials without a search": ("train.py", ["--trials", "3"], "trials must be given with --tune; instead received 3"),
    "no trials": ("train.py", ["--tune", "--trials", "0"], "trials.*at least 1.*0"),
    "search in a run": ("train.py", ["--tune", "--resume", "runs/nothing"], "tune must be given without --resume"),
    "search on no plant": ("train.py", ["--tune", "--plant", "moon"], "paper.*'moon'"),
    "tune candidates": ("agents/tune.py", ["--candidates", "0"], "candidates.*at least 1.*0"),
    "train resume": ("train.py", ["--resume", "runs/nothing"], "checkpoints.*'runs/nothing'"),
}


def refused(
    script: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> str:
    """Run a script in this process, which must end with exit code 2 and one line; return the line."""
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(ROOT / script), run_name="__main__")
    told = capfd.readouterr()
    assert end.value.code == 2
    assert told.out == ""
    assert told.err.endswith("\n")
    assert len(told.err.splitlines()) == 1, told.err
    return told.err


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_told_in_one_line_and_nothing_is_written(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    script, arguments, pattern = BAD[case]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "evaluate").mkdir(parents=True)
    (tmp_path / "runs" / "evaluate" / "summary.json").write_text("{}")
    before = files_of(tmp_path)
    line = refused(script, arguments, monkeypatch, capfd)
    assert re.search(pattern, line), line
    assert files_of(tmp_path) == before


@pytest.mark.parametrize("script", ["train.py", "evaluate.py"])
@pytest.mark.parametrize("kind", ["a file", "below a file", "a file of /proc"])
def test_an_out_folder_that_cannot_be_written_is_refused(
    script: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    precious = tmp_path / "precious"
    precious.write_text("ten years")
    out = {"a file": precious, "below a file": precious / "out", "a file of /proc": Path("/proc/self/out")}[kind]
    arguments = ["--controllers", "idle", "--episodes", "1"] if script == "evaluate.py" else ["--steps", "64", *OPTIONS]
    line = refused(script, [*arguments, "--out", str(out)], monkeypatch, capfd)
    assert "Input out must be" in line
    assert str(out) in line
    assert precious.read_text() == "ten years"


@pytest.mark.parametrize("content", [b"\x80\x04K\x00.", b"{}", b"PK\x03\x04", b""])
def test_a_foreign_model_is_refused(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "card.json").write_bytes(content)
    before = files_of(tmp_path)
    line = refused(
        "evaluate.py", ["--controllers", str(tmp_path / "model"), "--out", str(tmp_path / "out")], monkeypatch, capfd
    )
    assert "Input model must" in line
    assert files_of(tmp_path) == before
    assert not (tmp_path / "out").exists()
