"""What a training keeps: judged at every checkpoint, the best stored; one that diverged stops and spoils nothing."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from tiny_runs import PPO_CONFIG, SAVED, MakeConfig, both, files_of, going_on, rows_of, steps_of, tensors_of

from agents.checkpoints import BEST, MODEL, checkpoints, save_model
from agents.evaluation import HeldOut, Score
from agents.keeper import DivergedError
from agents.learned import Learned
from agents.learning import train
from agents.store import CARD, POLICY, load_card
from magenv.command import friendly

pytestmark = pytest.mark.usefixtures("elsewhere")


def scores(patch: pytest.MonkeyPatch, *success: float) -> None:
    """Let held-out episodes succeed as told, one share per evaluation."""
    left = iter(success)
    patch.setattr(HeldOut, "score", lambda *_: Score(next(left), 1.0, 5.0, 1.0))


def policy_of(folder: Path) -> dict[str, torch.Tensor]:
    """Return all tensors of a model's policy."""
    return load_file(folder / POLICY)


# Judged.


@both
def test_judging_does_not_change_what_is_learned(make_config: MakeConfig, tmp_path: Path, algo: str) -> None:
    train(make_config(algo))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HeldOut, "score", lambda *_: Score(0.0, 1.0, 1.0, 0.0))
        train(make_config(algo, out=tmp_path / "unjudged"))
    judged, unjudged = tensors_of(make_config().out), tensors_of(tmp_path / "unjudged")
    assert judged.keys() == unjudged.keys()
    assert all(torch.equal(judged[name], unjudged[name]) for name in judged)


@both
def test_scores_are_logged_and_the_best_policy_is_stored(make_config: MakeConfig, algo: str) -> None:
    told: list[Score] = []
    train(make_config(algo), watch=told.append)
    out, (*_, last) = make_config().out, rows_of(make_config().out)
    final = load_card(checkpoints(out)[-1]).score
    assert final is not None
    assert load_card(out / MODEL).score == final
    assert [float(last[f"eval/{name}"]) for name in vars(final)] == pytest.approx(list(vars(final).values()), rel=1e-5)
    best = load_card(out / BEST)
    assert best.score == max([*told, final], key=lambda score: score.merit)
    assert best.steps in range(1, make_config(algo).total_steps + 1)
    assert sorted(path.name for path in (out / BEST).iterdir()) == [CARD, POLICY]
    settings, agent = make_config(algo).settings, Learned(out / BEST)
    again = HeldOut(settings).score(lambda observations: agent.predict(observations)[0])
    assert again.merit == pytest.approx(best.score.merit, rel=1e-4)  # numpy's and SB3's normalisation round otherwise


def test_the_best_is_the_policy_judged_best_and_the_model_the_last(make_config: MakeConfig) -> None:
    with pytest.MonkeyPatch.context() as patch:
        scores(patch, 0.2, 0.6, 0.6, 0.3, 0.5)
        train(make_config())
    out = make_config().out
    best, last = load_card(out / BEST), load_card(out / MODEL)
    assert (best.steps, best.score) == (256, Score(0.6, 1.0, 5.0, 1.0)), "of equal ones the first"
    assert (last.steps, last.score) == (512, Score(0.5, 1.0, 5.0, 1.0))
    name = "policy.action_net.bias"
    assert not torch.equal(policy_of(out / BEST)[name], policy_of(out / MODEL)[name])


def test_a_run_gone_on_with_keeps_its_best_until_a_better_one_comes(make_config: MakeConfig) -> None:
    out = make_config().out
    with pytest.MonkeyPatch.context() as patch:
        scores(patch, 0.2, 0.6, 0.6, 0.3, 0.5)
        train(make_config())
        before = files_of(out / BEST)
        scores(patch, 0.6, 0.1)
        train(going_on(out, steps=640))
        assert files_of(out / BEST) == before
        scores(patch, 0.7, 0.1)
        train(going_on(out, steps=768))
    assert (load_card(out / BEST).steps, load_card(out / MODEL).steps) == (768, 768)
    assert load_card(out / BEST).score == Score(0.7, 1.0, 5.0, 1.0)


def test_a_run_gone_on_with_elsewhere_takes_its_best_along(make_config: MakeConfig, tmp_path: Path) -> None:
    out, there = make_config().out, tmp_path / "there"
    with pytest.MonkeyPatch.context() as patch:
        scores(patch, 0.2, 0.6, 0.6, 0.3, 0.5)
        train(make_config())
        before = files_of(out)
        scores(patch, 0.6, 0.1)
        train(going_on(out, steps=640, out=there))
    assert files_of(out) == before
    assert load_card(there / BEST) == load_card(out / BEST)
    assert all(torch.equal(value, policy_of(there / BEST)[name]) for name, value in policy_of(out / BEST).items())


def test_a_run_of_a_version_without_scores_can_be_gone_on_with(make_config: MakeConfig) -> None:
    train(make_config())
    out = make_config().out
    shutil.rmtree(out / BEST)
    for folder in (*checkpoints(out), out / MODEL):
        card = json.loads((folder / CARD).read_text())
        del card["score"]
        (folder / CARD).write_text(json.dumps(card))
    assert load_card(out / MODEL).score is None
    train(going_on(out, steps=640))
    assert load_card(out / BEST).score is not None


def test_what_a_new_run_finds_is_not_its_best(make_config: MakeConfig) -> None:
    with pytest.MonkeyPatch.context() as patch:
        scores(patch, 0.9, 0.9)
        train(make_config(steps=128))
        for name in ("checkpoints", MODEL):  # as if killed before the first checkpoint
            shutil.rmtree(make_config().out / name)
        scores(patch, 0.1, 0.1)
        train(make_config(steps=128))
    assert load_card(make_config().out / BEST).score == Score(0.1, 1.0, 5.0, 1.0)


def test_what_stands_in_the_place_of_the_best_and_is_no_model_is_left_alone(make_config: MakeConfig) -> None:
    precious = make_config().out / BEST / "thesis.txt"
    precious.parent.mkdir(parents=True)
    precious.write_text("ten years")
    with pytest.raises(ValueError, match=r"^Input out must be a place for a model"):
        train(make_config())
    assert precious.read_text() == "ten years"


@pytest.mark.parametrize("score", [5, {"success_rate": 2.0}, {"success_rate": 0.5}, [0.5, 1.0, 1.0, 1.0]])
def test_a_card_with_an_impossible_score_is_refused(checkpoint: Path, score: Any) -> None:
    card = json.loads((checkpoint / CARD).read_text())
    (checkpoint / CARD).write_text(json.dumps(card | {"score": score}))
    with pytest.raises(ValueError, match=r"^Input .+ must .+; instead received .+"):
        load_card(checkpoint)


# Diverged.


@pytest.fixture
def after_update(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[PPO], None]], None]:
    """Let something happen to the agent after its third update, the one before 512 steps are done."""

    def spoil(how: Callable[[PPO], None]) -> None:
        original, updates = PPO.train, iter(range(100))

        def trained(model: PPO) -> None:
            original(model)
            if next(updates) == 2:
                how(model)

        monkeypatch.setattr(PPO, "train", trained)

    return spoil


def poisoned(model: BaseAlgorithm) -> None:
    with torch.no_grad():
        next(iter(model.policy.parameters()))[0] = math.nan


def blown_up(model: BaseAlgorithm) -> None:
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.copy_(torch.full_like(parameter, 3e38) * (-1.0) ** torch.arange(parameter.shape[-1]))


def overflown(model: BaseAlgorithm) -> None:
    model.policy.optimizer.state_dict()["state"][1]["exp_avg_sq"][0] = math.inf


def without_loss(model: BaseAlgorithm) -> None:
    model.logger.record("train/value_loss", math.nan)


@pytest.mark.parametrize(
    ("how", "what"),
    [(poisoned, "parameters"), (blown_up, "actions"), (without_loss, "the loss")],
)
def test_a_training_that_diverges_stops_and_what_was_good_stays(
    make_config: MakeConfig, after_update: Callable[..., None], how: Callable[[PPO], None], what: str
) -> None:
    out = make_config().out
    after_update(how)
    with pytest.raises(DivergedError, match=rf"^The training diverged within 384 steps \({what} .*-0*384\.$"):
        train(make_config())
    assert steps_of(out) == [256, 384]
    assert not (out / MODEL).exists()
    for folder in (*checkpoints(out), out / BEST):
        for path in folder.glob("*.safetensors"):
            assert all(bool(torch.isfinite(value).all()) for value in load_file(path).values())
        Learned(folder)
    _, finished = train(going_on(out))  # its first update is not the third
    assert finished


def test_an_optimiser_that_overflows_is_noticed_before_it_is_stored(
    make_config: MakeConfig, after_update: Callable[..., None]
) -> None:
    after_update(overflown)
    with pytest.raises(DivergedError, match=r"^The training diverged within 512 steps \(optimisers .*-0*384\.$"):
        train(make_config())
    assert steps_of(make_config().out) == [256, 384]


@pytest.mark.parametrize(
    ("algo", "learning_rate", "options"),
    [
        ("ppo", 1e3, {"learn_std": True, "activation": "tanh"}),  # else numbers stay finite
        ("ppo", 1e30, {}),
        ("sac", 1e3, {}),
        ("sac", 1e30, {}),
    ],
)
def test_far_too_large_a_learning_rate_is_told(
    make_config: MakeConfig, algo: str, learning_rate: float, options: dict[str, Any]
) -> None:
    config = make_config(algo)
    own = dataclasses.replace(config.own, learning_rate=learning_rate, **options)
    with pytest.raises(DivergedError, match=r"^The training diverged within \d+ steps .*lower learning rate"):
        train(dataclasses.replace(config, steps=2048, checkpoint_every=32, **{algo: own}))
    assert not (config.out / MODEL).exists()
    for folder in checkpoints(config.out):
        Learned(folder)


def test_a_last_update_that_diverges_is_no_model(make_config: MakeConfig, after_update: Callable[..., None]) -> None:
    after_update(poisoned)
    with pytest.raises(DivergedError):
        train(make_config(steps=384))
    assert steps_of(make_config().out) == [256, 384]
    assert not (make_config().out / MODEL).exists()


def test_a_fault_that_is_none_of_the_numbers_is_not_called_so(
    make_config: MakeConfig, after_update: Callable[..., None]
) -> None:
    def fault(_: PPO) -> None:
        raise ValueError("a fault")

    after_update(fault)
    with pytest.raises(ValueError, match=r"^a fault$"):
        train(make_config())


def test_nothing_that_is_not_finite_is_stored(tmp_path: Path, trained: dict[str, Any], checkpoint: Path) -> None:
    model, env = trained["ppo"]
    before, kept = files_of(checkpoint), model.policy.log_std.detach().clone()
    model.policy.log_std.data[0] = math.inf
    try:
        with pytest.raises(ValueError, match=r"^Input model must be of finite numbers"):
            save_model(checkpoint, model, env, SAVED["ppo"], True, "")
    finally:
        model.policy.log_std.data.copy_(kept)
    assert files_of(checkpoint) == before


def test_divergence_ends_the_command_with_one_line(make_config: MakeConfig, capfd: pytest.CaptureFixture[str]) -> None:
    config = make_config(ppo=dataclasses.replace(PPO_CONFIG.ppo, learning_rate=1e30))
    with pytest.raises(SystemExit) as end:
        friendly(lambda: print(train(config)))
    assert end.value.code == 1
    told = capfd.readouterr()
    assert told.out == ""
    assert told.err.splitlines()[-1].startswith("error: The training diverged within 128 steps")
    assert "Traceback" not in told.err
