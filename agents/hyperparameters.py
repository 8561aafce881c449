"""A search for the hyperparameters of a training: ``python train.py --tune``, with Optuna (extra ``tune``).

Trials are trainings with a tenth of the steps, each in a folder of its own, judged on the held-out episodes; those
below the median of the others are given up on the way. ``trials.csv`` and ``best.json`` are renewed after each. (The
gains of the PID are found by ``agents.tune``.)
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.checkpoints import BEST, is_run
from agents.configs import PPOConfig, SACConfig, TrainConfig, command_of
from agents.evaluation import Score
from agents.folders import new_folder
from agents.keeper import DivergedError
from agents.learning import train
from agents.store import CARD, load_card
from magenv.command import RunError
from magenv.episodes import Episodes
from magenv.files import write_file
from magenv.params import InputError

if TYPE_CHECKING:
    import optuna

DEFAULT_FOLDER = Path("runs/tune")
TABLE, BEST_COMMAND = "trials.csv", "best.json"
TRIALS = 20
"""Where no number is asked for."""
SHARE = 10
"""A trial has one step in so many of the whole training."""
STARTUP_TRIALS, WARMUP_SCORES = 5, 3
"""Trials before any is given up, and scores that each is granted."""


@dataclass(frozen=True)
class Trial:
    """A trial as the table tells it."""

    number: int
    state: str
    """complete, pruned (given up) or diverged."""
    score: Score | None
    """The best on the way; None where it was not judged."""
    parameters: dict[str, float | int]
    """What was tried, in Optuna's terms."""
    command: str
    """Command of the whole training with these hyperparameters."""


def search(config: TrainConfig) -> Path:
    """Try hyperparameters and return the folder of the results; the same seed tries the same ones.

    Ctrl-C ends the search; the results of the trials done stand.

    Raises
    ------
    InputError
        If Optuna is not installed, the configuration is unsound, or ``out`` holds something else.
    RunError
        If all trials diverged.
    """
    optuna = _optuna()
    Episodes(1, config.settings)
    if config.correction is not None:
        config.correction.base(config.settings)
    _shortened(config)
    folder, lock = new_folder(config.out, DEFAULT_FOLDER, _is_taken, "a folder without a search or a run")
    try:
        return _search(optuna, config, folder)
    finally:
        lock.release()


def _optuna() -> Any:
    try:
        import optuna
    except ImportError:
        raise InputError(
            "Input tune must be given where Optuna is installed (python -m pip install -c constraints.txt -e "
            '".[tune]"); instead received none.'
        ) from None
    return optuna


def _is_taken(folder: Path) -> bool:
    return (folder / TABLE).exists() or is_run(folder)


def _search(optuna: Any, config: TrainConfig, folder: Path) -> Path:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        direction="maximize",
        sampler=optuna.samplers.TPESampler(n_startup_trials=STARTUP_TRIALS, seed=config.seed),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=STARTUP_TRIALS, n_warmup_steps=WARMUP_SCORES),
    )
    study.enqueue_trial(DEFAULTS[config.algo])
    done: list[Trial] = []
    best: Trial | None = None
    _write(done, folder)
    total = TRIALS if config.trials is None else config.trials
    for _ in range(total):
        done.append(_try(optuna, study, config, folder))
        _write(done, folder)
        last, best = done[-1], best_of(done)
        told = "" if best is None else f"; best: trial {best.number}, {best.score}"
        print(f"Trial {last.number} ({len(done)} of {total}), {last.state}: {last.score}{told}", flush=True)
    if best is None:
        raise RunError(f"All {total} trials of the search in {folder} diverged: see {TABLE}.")
    print(f"Best: {folder / BEST_COMMAND}, trials: {folder / TABLE}\n{best.command}")
    return folder


def _shortened(config: TrainConfig) -> TrainConfig:
    """Return the training of a trial; raises where so few steps are too few for it."""
    steps = max(1, config.total_steps // SHARE)
    return dataclasses.replace(config, steps=steps, checkpoint_every=None)


def _try(optuna: Any, study: optuna.Study, config: TrainConfig, folder: Path) -> Trial:
    """Train with the hyperparameters that the study asks for next, and tell it what they reach."""
    trial = study.ask()
    own: Any = suggested(trial, config.own)
    whole = dataclasses.replace(config, tune=False, trials=None, out=None, **{config.algo: own})
    out, scores = folder / f"trial-{trial.number:03d}", 0
    short = dataclasses.replace(_shortened(whole), out=out)

    def watch(score: Score) -> None:
        nonlocal scores
        trial.report(score.merit, scores)
        scores += 1
        if trial.should_prune():
            raise optuna.TrialPruned

    state = "complete"
    try:
        _, finished = train(short, command_of(short), watch)
        if not finished:
            raise KeyboardInterrupt
    except optuna.TrialPruned:
        state = "pruned"
    except DivergedError:
        state = "diverged"
    score = load_card(out / BEST).score if (out / BEST / CARD).is_file() else None
    if state == "complete" and score is not None:
        study.tell(trial, score.merit)
    else:
        study.tell(trial, state=optuna.trial.TrialState.PRUNED)
    return Trial(trial.number, state, score, dict(trial.params), command_of(whole))


DEFAULTS: dict[str, dict[str, float | int]] = {
    "ppo": {
        "learning_rate": PPOConfig.learning_rate,
        "discounted": 1.0 - PPOConfig.gamma,
        "gae_lambda": PPOConfig.gae_lambda,
        "log_std_init": PPOConfig.log_std_init,
        "n_steps": PPOConfig.n_steps,
        "minibatches": PPOConfig.n_envs * PPOConfig.n_steps // PPOConfig.batch_size,
        "n_epochs": PPOConfig.n_epochs,
        "width": PPOConfig.net[0],
    },
    "sac": {
        "learning_rate": SACConfig.learning_rate,
        "discounted": 1.0 - SACConfig.gamma,
        "gradient_steps": SACConfig.gradient_steps,
        "batch_size": SACConfig.batch_size,
        "width": SACConfig.net[0],
    },
}
"""The defaults in the terms that are searched: the first trial."""


def suggested(trial: optuna.Trial, own: PPOConfig | SACConfig) -> PPOConfig | SACConfig:
    """Return the hyperparameters that a trial is to have; what is not searched is as configured.

    Discounts are searched by what they lack to one, a PPO's batches by how many share a rollout: all samples count.
    """
    gamma = 1.0 - trial.suggest_float("discounted", 0.01, 0.3, log=True)
    width = trial.suggest_categorical("width", (64, 128, 256))
    learning_rate = trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True)
    if isinstance(own, SACConfig):
        return dataclasses.replace(
            own,
            gamma=gamma,
            net=(width, width),
            learning_rate=learning_rate,
            gradient_steps=trial.suggest_int("gradient_steps", 2, 16, log=True),
            batch_size=trial.suggest_categorical("batch_size", (128, 256, 512)),
        )
    n_steps = trial.suggest_categorical("n_steps", (16, 32, 64, 128))
    return dataclasses.replace(
        own,
        gamma=gamma,
        net=(width, width),
        learning_rate=learning_rate,
        gae_lambda=trial.suggest_float("gae_lambda", 0.8, 1.0),
        log_std_init=trial.suggest_float("log_std_init", -3.0, -0.5),
        n_steps=n_steps,
        batch_size=own.n_envs * n_steps // trial.suggest_categorical("minibatches", (2, 4, 8)),
        n_epochs=trial.suggest_int("n_epochs", 3, 12),
    )


def best_of(trials: list[Trial]) -> Trial | None:
    """Return the best of the complete trials; None where there is none."""
    complete = [(trial.score.merit, trial) for trial in trials if trial.score and trial.state == "complete"]
    return max(complete, key=lambda one: one[0])[1] if complete else None


def _write(trials: list[Trial], folder: Path) -> None:
    """Write the table of the trials and, once there is one, the best."""
    text = io.StringIO(newline="")
    names = list(dict.fromkeys(name for trial in trials for name in trial.parameters))
    scores = [field.name for field in dataclasses.fields(Score)]
    writer = csv.DictWriter(text, ["trial", "state", *scores, *names, "command"])
    writer.writeheader()
    for trial in trials:
        told = {} if trial.score is None else vars(trial.score)
        row = {"trial": trial.number, "state": trial.state, "command": trial.command}
        writer.writerow(row | told | trial.parameters)
    write_file(folder / TABLE, text.getvalue().encode())
    best = best_of(trials)
    if best is not None:
        write_file(folder / BEST_COMMAND, (json.dumps(dataclasses.asdict(best), indent=1) + "\n").encode())
