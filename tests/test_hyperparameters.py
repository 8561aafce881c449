"""The search for hyperparameters: what it tries, judges, gives up and leaves; commands that train what was found."""

from __future__ import annotations

import csv
import dataclasses
import json
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import optuna
import pytest
from messages import refusal
from tiny_runs import MakeConfig, files_of

from agents import hyperparameters
from agents.checkpoints import BEST, MODEL, stored_config
from agents.configs import PPOConfig, SACConfig, TrainConfig
from agents.evaluation import Score
from agents.hyperparameters import BEST_COMMAND, DEFAULTS, TABLE, search, suggested
from agents.keeper import DivergedError
from agents.learning import train
from agents.store import load_card
from magenv.command import RunError, parse

pytestmark = pytest.mark.usefixtures("elsewhere")

OWN: dict[str, PPOConfig | SACConfig] = {"ppo": PPOConfig(), "sac": SACConfig()}


def rows_of(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a search's table."""
    with (folder / TABLE).open(newline="") as file:
        return list(csv.DictReader(file, strict=True))


def parsed(command: str, monkeypatch: pytest.MonkeyPatch) -> TrainConfig:
    """Return the configuration that train.py reads from a command."""
    python, *arguments = shlex.split(command)
    assert python == "python"
    monkeypatch.setattr(sys, "argv", arguments)
    return parse(TrainConfig)


@pytest.fixture
def trainings(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[TrainConfig]]:
    """Let trials end as told instead of training them: each by its scores, or by what is raised."""

    def told(*ends: list[float] | BaseException) -> list[TrainConfig]:
        left, seen = iter(ends), []

        def trained(config: TrainConfig, command: str, watch: Callable[[Score], None]) -> tuple[Path, bool]:
            seen.append(config)
            end = next(left)
            if isinstance(end, BaseException):
                raise end
            best, folder = Score(max(end), 1.0, 1.0, 1.0), config.folder / BEST
            scored[folder] = best
            folder.mkdir(parents=True)
            (folder / "card.json").touch()
            for success in end:
                watch(Score(success, 1.0, 1.0, 1.0))
            return config.folder, True

        scored: dict[Path, Score] = {}
        monkeypatch.setattr(hyperparameters, "train", trained)
        monkeypatch.setattr(hyperparameters, "load_card", lambda folder: SimpleNamespace(score=scored[folder]))
        return seen

    return told


def test_a_search_trains_short_trials_and_tells_the_best(
    make_config: MakeConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = make_config(tune=True, trials=2, steps=1280)
    assert search(config) == config.out
    rows = rows_of(config.out)
    assert [(row["trial"], row["state"]) for row in rows] == [("0", "complete"), ("1", "complete")]
    for k, row in enumerate(rows):
        folder = config.out / f"trial-{k:03d}"
        card = load_card(folder / BEST)
        assert card.score is not None
        assert [float(row[name]) for name in vars(card.score)] == list(vars(card.score).values())
        assert load_card(folder / MODEL).config["steps"] == 128
        whole = parsed(row["command"], monkeypatch)
        assert (whole.total_steps, whole.tune, whole.out) == (1280, False, None)
        assert (
            dataclasses.replace(stored_config(folder), steps=1280, checkpoint_every=128, resume=None) == whole.resolved
        )
        assert parsed(load_card(folder / MODEL).command, monkeypatch).out == folder
    best = json.loads((config.out / BEST_COMMAND).read_text())
    merits = [Score(**{name: float(row[name]) for name in best["score"]}).merit for row in rows]
    assert best["command"] == rows[merits.index(max(merits))]["command"]
    assert best["command"] in capsys.readouterr().out
    assert rows[0]["command"] != rows[1]["command"]


def test_the_same_seed_tries_the_same(make_config: MakeConfig, tmp_path: Path) -> None:
    tables = []
    for name, seed in (("one", 0), ("two", 0), ("three", 1)):
        search(make_config(tune=True, trials=2, steps=1280, out=tmp_path / name, seed=seed))
        tables.append((tmp_path / name / TABLE).read_text())
    one, two, three = tables
    assert one == two
    assert one != three


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_the_first_trial_has_the_defaults(algo: str) -> None:
    assert suggested(optuna.trial.FixedTrial(DEFAULTS[algo]), OWN[algo]) == OWN[algo]  # type: ignore[arg-type]


@pytest.mark.parametrize("own", [*OWN.values(), PPOConfig(n_envs=1), PPOConfig(n_envs=3)])
def test_whatever_is_suggested_can_be_trained(own: PPOConfig | SACConfig) -> None:
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(100):
        one = suggested(study.ask(), own)
        assert type(one) is type(own)
        assert one.n_envs == own.n_envs
        if isinstance(one, PPOConfig):
            assert one.n_envs * one.n_steps % one.batch_size == 0, "batches of two sizes"


def test_trials_below_the_others_are_given_up(
    make_config: MakeConfig, trainings: Callable[..., list[TrainConfig]]
) -> None:
    good = [[0.5 + 0.01 * k] * 10 for k in range(hyperparameters.STARTUP_TRIALS)]
    seen = trainings(*good, [0.1] * 10, [0.9] * 10)
    out = search(make_config(tune=True, trials=len(good) + 2))
    *others, bad, better = rows_of(out)
    assert {row["state"] for row in others} == {"complete"}
    assert (bad["state"], better["state"]) == ("pruned", "complete")
    assert json.loads((out / BEST_COMMAND).read_text())["number"] == len(good) + 1
    assert [config.steps for config in seen] == [51] * len(seen)


def test_trials_that_diverge_do_not_end_the_search(
    make_config: MakeConfig, trainings: Callable[..., list[TrainConfig]]
) -> None:
    trainings([0.1], DivergedError("The training diverged"), [0.3], DivergedError("The training diverged"))
    out = search(make_config(tune=True, trials=4))
    assert [row["state"] for row in rows_of(out)] == ["complete", "diverged", "complete", "diverged"]
    assert json.loads((out / BEST_COMMAND).read_text())["number"] == 2


def test_a_search_in_which_all_diverge_tells_so(
    make_config: MakeConfig, trainings: Callable[..., list[TrainConfig]]
) -> None:
    trainings(*[DivergedError("The training diverged")] * 2)
    with pytest.raises(RunError, match=r"^All 2 trials .* diverged"):
        search(make_config(tune=True, trials=2))
    assert len(rows_of(make_config().out)) == 2
    assert not (make_config().out / BEST_COMMAND).exists()


def test_ctrl_c_leaves_the_trials_done(make_config: MakeConfig, trainings: Callable[..., list[TrainConfig]]) -> None:
    trainings([0.1], KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        search(make_config(tune=True))
    assert len(rows_of(make_config().out)) == 1
    assert json.loads((make_config().out / BEST_COMMAND).read_text())["number"] == 0


def test_a_trial_ended_by_ctrl_c_is_no_result(make_config: MakeConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hyperparameters, "train", lambda config, *_: (config.folder, False))
    with pytest.raises(KeyboardInterrupt):
        search(make_config(tune=True))
    assert rows_of(make_config().out) == []


def test_no_search_takes_the_folder_of_another_or_of_a_run(
    make_config: MakeConfig, trainings: Callable[..., list[TrainConfig]], tmp_path: Path
) -> None:
    trainings([0.1], [0.1], [0.1])
    folders = [search(make_config(tune=True, trials=1, out=None)) for _ in range(2)]
    assert folders == [Path("runs/tune"), Path("runs/tune-2")]
    train(make_config(steps=128, out=tmp_path / "run"))
    for out in (folders[0], tmp_path / "run"):
        before = files_of(out)
        told = refusal(lambda out=out: search(make_config(tune=True, trials=1, out=out)))  # type: ignore[misc]
        assert told.startswith("Input out must be a folder without a search or a run")
        assert files_of(out) == before


def test_without_optuna_it_is_told_how_to_install_it(make_config: MakeConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert 'pip install -c constraints.txt -e ".[tune]"' in refusal(lambda: search(make_config(tune=True)))
    assert not make_config().out.exists()


def test_an_unsound_configuration_is_refused_before_anything_is_written(make_config: MakeConfig) -> None:
    assert "scenario" in refusal(lambda: search(make_config(tune=True, scenario="nowhere")))
    blind = make_config(tune=True, action=None, residual="predictive", observation="errors")
    assert "observation must be 'full', as of predictive" in refusal(lambda: search(blind))
    assert not make_config().out.exists()


def test_trials_too_short_to_clone_are_refused_before_anything_is_written(make_config: MakeConfig) -> None:
    """A tenth of the steps would not do for cloning, though all of them would."""
    told = refusal(lambda: search(make_config(tune=True, expert="idle", steps=6000)))
    assert told.startswith("Input steps must be at least 5120, those of cloning; instead received 600")
    assert not make_config().out.exists()
