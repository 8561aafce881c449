"""The work of the study: a tiny training from its beginning to its record; broken off and gone on with; kept."""

from __future__ import annotations

import dataclasses
import itertools
import sys
from pathlib import Path

import joblib
import numpy as np
import pytest
from messages import refusal
from tiny_runs import PPO_CONFIG, SAC_CONFIG, Interrupter, files_of, rows_of

from agents.catalogue import controller
from agents.metrics import measure
from agents.rollout import run
from agents.study import entries, work
from agents.study.__main__ import main
from agents.study.entries import CURVE_POINTS, Entry
from agents.study.trainings import TRAININGS, Training, as_told
from magenv.command import friendly

SCENARIO = "approach-30"
TINY = Training("tiny", "a tiny one", dataclasses.replace(PPO_CONFIG, action="pose"), (0, 1), scenarios=(SCENARIO,))
TINY_USUAL = dataclasses.replace(
    TINY, name="tiny-usual", config=dataclasses.replace(PPO_CONFIG, action=None, residual="idle")
)
"""Its action mode is that of what it corrects."""
TINY_SAC = dataclasses.replace(TINY, name="tiny-sac", config=SAC_CONFIG)
FILE = Path("docs/study/tiny/seed-1.json")
FOLDER = Path("runs/study/tiny/seed-1")

pytestmark = pytest.mark.usefixtures("elsewhere", "tiny")


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the study know tiny trainings."""
    monkeypatch.setattr("agents.study.trainings.TRAININGS", (*TRAININGS, TINY, TINY_USUAL, TINY_SAC))


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    """Call the command."""
    monkeypatch.setattr(sys, "argv", ["study", *arguments])
    main()


def run_tiny(monkeypatch: pytest.MonkeyPatch, name: str = "tiny") -> Entry:
    call(monkeypatch, "run", name, "--seeds", "1", "--episodes", "2")
    return entries.load(Path("docs/study") / name / FILE.name)


def test_a_training_comes_to_its_record(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    entry = run_tiny(monkeypatch)
    assert capsys.readouterr().out == f"stored: {FILE}\n"
    made = entry.training
    assert made is not None
    assert (entry.name, entry.plant, entry.n_epm, entry.control_hz, entry.action) == ("tiny", "paper", 2, 2.0, "pose")
    assert (made.seed, made.steps, made.config) == (1, 512, as_told(TINY.of_seed(1)))
    assert made.command.startswith("python train.py --action pose --steps 512 --seed 1")
    assert made.origins == (f"{entry.commit} on {entry.machine}",)
    again = run(controller(str(FOLDER / "model")), SCENARIO, episodes=2)
    assert entry.outcomes == {SCENARIO: entries.outcomes_of(again)}
    for record, error in zip(again, entry.outcomes[SCENARIO].position_error_mm, strict=True):
        assert error == pytest.approx(measure(record).position_error_mm, rel=1e-4)
    told = [row for row in rows_of(FOLDER) if row["time/time_elapsed"] and row["episodes/success_rate"]]
    assert [str(step) for step in made.curve.steps] == [row["time/total_timesteps"] for row in told]
    assert made.curve.heading_error_deg[-1] == pytest.approx(float(told[-1]["episodes/heading_error_deg"]), rel=1e-4)


def test_what_is_kept_is_not_done_again(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    run_tiny(monkeypatch)
    before = files_of(Path())
    monkeypatch.setattr(work, "train", None)
    monkeypatch.setattr(work, "run_shared", None)
    capsys.readouterr()
    run_tiny(monkeypatch)
    assert capsys.readouterr().out == f"kept: {FILE}\n"
    assert files_of(Path()) == before


@pytest.mark.parametrize("name", ["tiny", "tiny-usual"])
def test_a_training_broken_off_goes_on(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        Interrupter(patch, 40)
        with pytest.raises(KeyboardInterrupt):
            run_tiny(monkeypatch, name)
    assert not (Path("docs/study") / name).exists()
    begun = work.checkpoints(Path("runs/study") / name / "seed-1")[-1].name
    assert 0 < int(begun.removeprefix("step-")) < 512
    entry = run_tiny(monkeypatch, name)
    assert entry.training is not None
    assert entry.training.steps >= 512
    assert entry.training.curve.steps[0] < int(begun.removeprefix("step-")), "what was before the break is told too"


def test_a_measurement_broken_off_needs_no_training_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(work, "run_shared", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_tiny(patch)
    monkeypatch.setattr(work, "train", None)
    assert run_tiny(monkeypatch).training is not None


def test_a_run_without_its_model_is_measured_by_its_last_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where the process was killed between the two."""
    whole = run_tiny(monkeypatch)
    FILE.unlink()
    for path in (FOLDER / "model").iterdir():
        path.unlink()
    (FOLDER / "model").rmdir()
    monkeypatch.setattr(work, "train", None)
    assert run_tiny(monkeypatch) == whole


def test_a_model_trained_otherwise_is_measured_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = run_tiny(monkeypatch)
    FILE.unlink()
    for model in (FOLDER, FOLDER / "model"):
        call(monkeypatch, "evaluate", "tiny", "--model", str(model), "--seed", "1", "--episodes", "2")
        assert entries.load(FILE) == whole
        FILE.unlink()
    FOLDER.joinpath("begun.txt").unlink()
    call(monkeypatch, "evaluate", "tiny", "--model", str(FOLDER), "--seed", "1", "--episodes", "2")
    assert whole.training is not None
    unknown = dataclasses.replace(whole, training=dataclasses.replace(whole.training, origins=()))
    assert entries.load(FILE) == unknown


def test_what_is_of_another_training_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    run_tiny(monkeypatch)
    setting = work.Setting(Path("docs/study"), 2)
    assert "seed 2" in refusal(lambda: work.evaluate(TINY, 2, FOLDER, setting))
    assert "action 'home'" in refusal(lambda: work.evaluate(TRAININGS[0], 1, FOLDER, setting))
    changed = dataclasses.replace(TINY, config=dataclasses.replace(TINY.config, frame="global"))
    monkeypatch.setattr("agents.study.trainings.TRAININGS", (changed,))
    assert str(FILE) in refusal(lambda: list(work.run("tiny", [1], setting)))
    FILE.unlink()
    assert str(FOLDER / "model") in refusal(lambda: list(work.run("tiny", [1], setting)))


def test_an_off_policy_training_comes_to_its_record(monkeypatch: pytest.MonkeyPatch) -> None:
    call(monkeypatch, "run", "tiny-sac", "--seeds", "0", "--episodes", "1")
    made = entries.load(Path("docs/study/tiny-sac/seed-0.json")).training
    assert made is not None
    assert made.config["algo"] == "sac"
    assert "ppo" not in made.config


def test_controllers_are_measured_and_kept(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    files = [Path("docs/study") / name / "controller.json" for name in ("idle", "ppo")]
    call(monkeypatch, "controllers", "idle", "ppo", "--episodes", "1", "--scenarios", SCENARIO)
    assert capsys.readouterr().out == "".join(f"stored: {file}\n" for file in files)
    for file in files:
        entry = entries.load(file)
        assert entry.training is None
        assert entry.outcomes == {SCENARIO: entries.outcomes_of(run(controller(entry.name), SCENARIO, episodes=1))}
    monkeypatch.setattr(work, "run_shared", None)
    call(monkeypatch, "controllers", "idle", "ppo", "--scenarios", SCENARIO)
    assert capsys.readouterr().out == "".join(f"kept: {file}\n" for file in files)
    assert "as kept in" in refusal(lambda: call(monkeypatch, "controllers", "idle", "--scenarios", "approach-60"))


def test_a_controller_is_kept_once_per_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    there = ("--plant", "arm", "--n-epm", "3", "--control-hz", "5", "--scenarios", SCENARIO, "--episodes", "1")
    call(monkeypatch, "controllers", "idle", "--episodes", "1", "--scenarios", SCENARIO)
    call(monkeypatch, "controllers", "idle", *there)
    usual, other = (Path("docs/study/idle") / name for name in ("controller.json", "controller-arm-3-epms-5hz.json"))
    assert entries.load(usual).where == entries.USUAL
    entry = entries.load(other)
    assert entry.where == entries.Where("arm", 3, 5.0)
    wanted = run(controller("idle", 3, 5.0, "arm"), SCENARIO, "arm", 3, 5.0, episodes=1)
    assert entry.outcomes == {SCENARIO: entries.outcomes_of(wanted)}
    usual.write_bytes(other.read_bytes())
    assert "controller-arm-3-epms-5hz.json" in refusal(lambda: entries.load(usual))


def test_times_are_those_in_training(tmp_path: Path) -> None:
    """Begun, broken off after 30 s, begun again: its clock starts anew, its progress does not."""
    columns = ",".join(work._COLUMNS)
    rows = ["100,10,,,", "200,20,0.5,8.0,40.0", "300,30,0.6,7.0,30.0", "400,5,0.7,6.0,20.0", "500,15,0.8,5.0,10.0"]
    path = tmp_path / "progress.csv"
    path.write_text("\n".join([columns, *rows, "500,,0.9,1.0,1.0", ""]))
    curve = work.read_curve(path)
    assert curve.steps == (200, 300, 400, 500)
    assert curve.seconds == (20.0, 30.0, 35.0, 45.0)
    assert curve.heading_error_deg == (40.0, 30.0, 20.0, 10.0)


def test_curves_are_thinned_but_for_their_ends(tmp_path: Path) -> None:
    path = tmp_path / "progress.csv"
    rows = [f"{k},{k},0.5,1.0,1.0" for k in range(1, 1001)]
    path.write_text("\n".join([",".join(work._COLUMNS), *rows]))
    steps = work.read_curve(path).steps
    assert (len(steps), steps[0], steps[-1]) == (CURVE_POINTS, 1, 1000)
    gaps = np.diff(steps)
    assert max(gaps) <= min(gaps) + 1


@pytest.mark.parametrize("text", [None, "", "a,b\n1,2\n", "\0"])
def test_a_training_without_progress_is_refused(text: str | None, tmp_path: Path) -> None:
    path = tmp_path / "progress.csv"
    if text is not None:
        path.write_text(text)
    assert str(path) in refusal(lambda: work.read_curve(path))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["run", "nobody"], "ppo-home"),
        (["run"], "each once"),
        (["run", "tiny", "tiny"], "each once"),
        (["run", "tiny", "--seeds", "1", "1"], "each once"),
        (["run", "tiny", "--seeds", "-1"], "at least 0"),
        (["run", "tiny", "--episodes", "0"], "at least 1"),
        (["run", "tiny", "--jobs", "0"], "at least 1"),
        (["controllers", "idle", "nobody"], "baseline"),
        (["controllers", "idle", "--scenarios", "approach-5"], "approach-5"),
        (["controllers", "idle", "--scenarios", "approach-60", "approach-60"], "each once"),
        (["controllers", "ppo", "--n-epm", "3"], "3"),
        (["evaluate", "tiny", "--model", "nothing", "--seed", "0"], "nothing"),
        (["evaluate", "nobody", "--model", "nothing", "--seed", "0"], "ppo-home"),
        (["report"], "docs/study"),
        (["dance"], "dance"),
    ],
    ids=" ".join,
)
def test_bad_input_is_refused_in_a_line_and_leaves_nothing(
    arguments: list[str], told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["study", *arguments])
    with pytest.raises(SystemExit) as ended:
        friendly(main)
    assert ended.value.code == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert told in error
    assert list(itertools.islice(Path().iterdir(), 1)) == []


def test_the_command_lists_all_trainings(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    run_tiny(monkeypatch)
    capsys.readouterr()
    call(monkeypatch, "list")
    told = capsys.readouterr().out
    for one in (*TRAININGS, TINY):
        assert f"{one.name} ({one.group}): {one.shows}\n" in told
    assert "\n  seeds 0 1, kept: 1\n" in told


def test_trainings_side_by_side_come_to_the_same_records(monkeypatch: pytest.MonkeyPatch) -> None:
    """One after the other here: processes, each of which loads torch, take too long for a test."""
    monkeypatch.setattr(work, "parallel_config", lambda **_: joblib.parallel_config(backend="sequential"))
    call(monkeypatch, "run", "tiny", "--episodes", "1", "--jobs", "2")
    for seed in TINY.seeds:
        entry = entries.load(Path(f"docs/study/tiny/seed-{seed}.json"))
        model = Path(f"runs/study/tiny/seed-{seed}/model")
        assert entry.outcomes == {SCENARIO: entries.outcomes_of(run(controller(str(model)), SCENARIO, episodes=1))}
