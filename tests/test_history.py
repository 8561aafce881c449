"""Policies that see the last observations of their episode: what they see, training, going on, use."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from messages import refusal
from numpy.typing import NDArray
from tiny_runs import CONFIGS, both, going_on, steps_of, tensors_of

from agents.checkpoints import checkpoints, save_model, stored_config
from agents.configs import TrainConfig, command_of
from agents.controller import Observations
from agents.evaluation import EPISODES, HeldOut, Score
from agents.history import LONGEST, Recalling, recalled
from agents.history_vec import HistoryVecEnv
from agents.keeper import Keeper
from agents.learned import Learned
from agents.learning import build, train
from agents.player import normalise
from agents.rollout import run
from agents.sb3_vec import TwoRobotsVecEnv
from agents.store import CARD, load_card, load_policy
from magenv.episodes import Settings

pytestmark = pytest.mark.usefixtures("elsewhere")

SIZE, ACTIONS, HISTORY = 63, 10, 3


def remembering(algo: str = "ppo", **changes: Any) -> TrainConfig:
    """Return a tiny training of a policy that remembers."""
    return dataclasses.replace(CONFIGS[algo], **({"history": HISTORY} | changes))


def stored(folder: Path, config: TrainConfig) -> Path:
    """Store an untrained policy."""
    model, env = build(config)
    save_model(folder, model, env, config, False, "")
    return folder


def last_of(episode: list[Observations], history: int) -> Observations:
    """Return what is seen (history * d,) of an episode's observations so far, from the definition."""
    return np.concatenate([episode[max(0, len(episode) - 1 - back)] for back in reversed(range(history))])


def test_the_policy_sees_the_last_observations_of_the_episode_and_of_no_other() -> None:
    n, history, rng = 6, 4, np.random.default_rng(0)
    env, bare = HistoryVecEnv(TwoRobotsVecEnv(n, Settings(), 7), history), TwoRobotsVecEnv(n, Settings(), 7)
    assert env.observation_space.shape == (history * SIZE,)
    assert env.action_space == bare.action_space
    told, plain, ends = env.reset(), bare.reset(), 0
    seen = [[one] for one in plain]
    for _ in range(60):
        np.testing.assert_array_equal(told, [last_of(episode, history) for episode in seen])
        assert env.observation_space.contains(told[0])
        action = rng.uniform(-1.0, 1.0, (n, ACTIONS)).astype(np.float32)
        told, rewards, dones, infos = env.step(action)
        plain, theirs, ended, their_infos = bare.step(action)
        np.testing.assert_array_equal(rewards, theirs)
        np.testing.assert_array_equal(dones, ended)
        for row in range(n):
            if dones[row]:
                ends += 1
                seen[row].append(their_infos[row]["terminal_observation"])
                np.testing.assert_array_equal(infos[row]["terminal_observation"], last_of(seen[row], history))
                seen[row] = []
            seen[row].append(plain[row])
    assert ends > n, "episodes are to end"
    np.testing.assert_array_equal(env.reset(), np.tile(bare.reset(), history))


@both
def test_a_stored_policy_sees_what_it_saw_in_training(algo: str, tmp_path: Path) -> None:
    """The same actions as Stable-Baselines3's for the environments' own observations, episodes beginning and ending."""
    config = remembering(algo)
    model, env = build(config)
    save_model(tmp_path / "model", model, env, config, False, "")
    agent, statistics = Learned(tmp_path / "model"), load_policy(tmp_path / "model")[1]
    whole = HistoryVecEnv(TwoRobotsVecEnv(5, config.settings, 3), HISTORY)
    told, starts, state = whole.reset(), np.ones(5, np.bool_), None
    for _ in range(40):
        actions, state = agent.predict(told[:, -SIZE:], state, starts)
        theirs, _ = model.predict(normalise(told, statistics, config.clip_observation), deterministic=True)
        np.testing.assert_allclose(actions, theirs, rtol=0.0, atol=1e-6)
        told, _, starts, _ = whole.step(np.sign(theirs))  # far from home, where episodes end soon
    single, past = agent.predict(told[0, -SIZE:])
    assert (single.shape, past.shape) == ((ACTIONS,), (1, HISTORY, SIZE))


def test_an_episode_depends_on_no_other(tmp_path: Path) -> None:
    agent = Learned(stored(tmp_path / "model", remembering()))
    several, alone = run(agent, "approach-60", episodes=3, seed=4), run(agent, "approach-60", episodes=1, seed=6)
    np.testing.assert_array_equal(several[2].epm_pose, alone[0].epm_pose)


@both
def test_a_training_runs_goes_on_and_can_be_repeated(algo: str, tmp_path: Path) -> None:
    first = remembering(algo, steps=128, checkpoint_every=64, out=tmp_path / "run")
    train(first)
    assert load_card(tmp_path / "run" / "model").history == HISTORY
    before = tensors_of(tmp_path / "run")
    assert before["observation.mean"].shape == (HISTORY * SIZE,)
    train(dataclasses.replace(first, out=tmp_path / "again"))
    again = tensors_of(tmp_path / "again")
    assert all(torch.equal(before[name], again[name]) for name in before)
    assert stored_config(tmp_path / "run").history == HISTORY
    assert train(going_on(tmp_path / "run", steps=256))[1]
    assert steps_of(tmp_path / "run")[-1] == 256
    assert Learned(checkpoints(tmp_path / "run")[-1]).predict(np.zeros(SIZE, np.float32))[0].shape == (ACTIONS,)
    assert "history" in refusal(lambda: train(going_on(tmp_path / "run", steps=512, history=1)))


def test_it_is_judged_with_what_it_remembers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the held-out episodes, which all begin together, it sees what came before; training does not notice."""
    config, seen = remembering(scenario="approach-60", steps=128), []
    original = Keeper._policy

    def noted(keeper: Keeper, observations: Observations) -> NDArray[np.float32]:
        seen.append(observations)
        return original(keeper, observations)

    with monkeypatch.context() as patch:
        patch.setattr(Keeper, "_policy", noted)
        train(dataclasses.replace(config, out=tmp_path / "run"))
    first = [np.array_equal(one, np.tile(one[:, :SIZE], HISTORY)) for one in seen]
    assert sum(first) == 2, "of a checkpoint, and of the end"
    assert {one.shape for one in seen} == {(EPISODES, HISTORY * SIZE)}
    for before, now, begins in zip(seen, seen[1:], first[1:], strict=False):
        assert begins or np.array_equal(now[:, :-SIZE], before[:, SIZE:])
    with monkeypatch.context() as patch:
        patch.setattr(HeldOut, "score", lambda *_: Score(0.0, 1.0, 1.0, 1.0))
        train(dataclasses.replace(config, out=tmp_path / "unjudged"))
    judged, unjudged = tensors_of(tmp_path / "run"), tensors_of(tmp_path / "unjudged")
    assert all(torch.equal(judged[name], unjudged[name]) for name in judged)


def test_the_command_tells_the_history() -> None:
    assert command_of(TrainConfig(history=4)) == "python train.py --history 4"


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: TrainConfig(history=0), f"history must be a whole number from 1 to {LONGEST}; instead received 0"),
        (lambda: TrainConfig(history=LONGEST + 1), f"from 1 to {LONGEST}"),
        (lambda: TrainConfig(history=2.0), "instead received 2.0"),  # type: ignore[arg-type]
        (lambda: TrainConfig(history=True), "instead received True"),
        (lambda: TrainConfig(history=2, residual="tuned"), "history must be 1 with --residual or --expert"),
        (lambda: TrainConfig(history=2, expert="steered"), "history must be 1 with --residual or --expert"),
    ],
)
def test_what_cannot_be_remembered_is_refused(make: Callable[[], object], told: str) -> None:
    assert told in refusal(make)


@pytest.mark.parametrize(
    ("history", "told"),
    [
        (HISTORY - 1, f"model's history must be {HISTORY}, as in its training; instead received {HISTORY - 1}"),
        (0, "history must be a whole number"),
        ("three", "history must be a whole number"),
        (None, "history must be a whole number"),
    ],
)
def test_a_card_that_tells_another_history_is_refused(history: object, told: str, tmp_path: Path) -> None:
    """And where all of it does, the weights do not fit."""
    folder = stored(tmp_path / "model", remembering())
    card = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(card | {"history": history}))
    assert told in refusal(lambda: Learned(folder))
    (folder / CARD).write_text(json.dumps(card | {"history": 2, "config": card["config"] | {"history": 2}}))
    message = refusal(lambda: Learned(folder))
    assert f"sizes [{2 * SIZE}, {ACTIONS}]" in message
    assert "it sees 2 observations" in message
    assert f"received weights for [{HISTORY * SIZE}, {ACTIONS}]" in message


def test_a_card_with_a_history_that_nobody_uses_is_refused(tmp_path: Path) -> None:
    folder = stored(tmp_path / "model", dataclasses.replace(CONFIGS["ppo"], action=None, residual="tuned"))
    card = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(card | {"history": 3, "config": card["config"] | {"history": 3}}))
    assert "model's history must be 1 where it corrects a controller; instead received 3" in refusal(
        lambda: Learned(folder)
    )


@pytest.mark.parametrize(
    ("state", "starts", "told"),
    [
        (np.zeros((2, HISTORY, SIZE), np.float32), None, f"of 3 episodes, of shape (3, {HISTORY}, {SIZE})"),
        (np.zeros((3, HISTORY - 1, SIZE), np.float32), None, "state must be what was seen of 3 episodes"),
        ((1, 2), None, "state must be what was seen of 3 episodes"),
        (None, np.ones(2, np.bool_), "episode_start must be of shape (3,); instead received (2,)"),
    ],
)
def test_memories_of_other_episodes_are_refused(state: Any, starts: Any, told: str) -> None:
    policy = Recalling(lambda seen: seen[:, :1], HISTORY)
    assert told in refusal(lambda: policy.predict(np.zeros((3, SIZE), np.float32), state, starts))


def test_starts_may_be_any_truth_values_and_there_may_be_no_episode() -> None:
    policy, ones = Recalling(lambda seen: seen[:, :1], HISTORY), np.ones((2, SIZE), np.float32)
    _, past = policy.predict(0.0 * ones)
    actions, _ = policy.predict(ones, past, np.array([1, 0]))
    np.testing.assert_array_equal(actions, [[1.0], [0.0]])
    actions, past = policy.predict(ones[:0])
    assert (actions.shape, past.shape) == ((0, 1), (0, HISTORY, SIZE))


def test_what_is_remembered_is_not_changed_behind_ones_back() -> None:
    past = recalled(None, np.zeros((2, 1), np.float32), HISTORY)
    kept = past.copy()
    recalled(past, np.ones((2, 1), np.float32), HISTORY, np.array([True, False]))
    np.testing.assert_array_equal(past, kept)
