"""Policies that correct a controller: what they see, what comes of both actions, training, going on, use."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from messages import refusal
from numpy.typing import NDArray
from tiny_runs import CONFIGS, MakeConfig, both, going_on, steps_of, tensors_of

from agents.checkpoints import checkpoints, save_model, stored_config
from agents.classical import classical
from agents.configs import TrainConfig
from agents.controller import Idle
from agents.evaluation import EPISODES_CORRECTED, SEED, HeldOut, Score
from agents.learned import Learned
from agents.learning import build, train
from agents.player import normalise
from agents.residual import Corrected, Correction, corrected, with_base
from agents.residual_vec import ResidualVecEnv
from agents.rollout import controller_seed, run
from agents.sb3_vec import TwoRobotsVecEnv
from agents.store import load_card, load_policy
from magenv.episodes import Episodes, Settings
from magenv.task import ERRORS_SIZE

pytestmark = pytest.mark.usefixtures("elsewhere")

SIZE, ACTIONS = 63, 10
POSE = Settings(action="pose")
Observations = NDArray[np.float32]


class Counting(Idle):
    """Remembers how many steps an episode has lasted, and acts by it."""

    def predict(
        self,
        observation: Observations,
        state: Any | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        assert observation.shape[-1] == SIZE
        steps = np.zeros(len(observation)) if state is None else state + 1
        if episode_start is not None:
            steps[episode_start] = 0
        return np.repeat(np.float32(0.01) * steps[:, None], ACTIONS, axis=1).astype(np.float32), steps


def residual(algo: str = "ppo", controller: str = "tuned", **changes: Any) -> TrainConfig:
    """Return a tiny training of a policy that corrects a controller."""
    return dataclasses.replace(
        CONFIGS[algo], **({"action": None, "residual": controller, "residual_scale": 0.05} | changes)
    )


def stored(folder: Path, config: TrainConfig, silent: bool = False) -> Path:
    """Store an untrained policy of some weights, or of none in its last layer: ``silent``."""
    model, env = build(config)
    with torch.no_grad():
        for name, value in model.policy.named_parameters():
            value.copy_(torch.zeros_like(value) if silent and name.startswith("action_net") else 3.0 * value)
    save_model(folder, model, env, config, False, "")
    return folder


def first_observations(n: int, settings: Settings = POSE) -> Observations:
    """Return the first observations (n, 63) of some episodes."""
    episodes = Episodes(n, settings)
    for row in range(n):
        episodes.seed(row, np.random.default_rng(row))
    return episodes.start(np.ones(n, np.bool_))


# The environments of a training.


def test_the_policy_sees_what_the_controller_is_about_to_do_and_corrects_it() -> None:
    """The environments go as with the sum of both as action; the controller's memory ends with an episode."""
    n, scale, rng = 6, 0.3, np.random.default_rng(0)
    env = ResidualVecEnv(TwoRobotsVecEnv(n, Settings(), 7), Counting(), scale)
    bare = TwoRobotsVecEnv(n, Settings(), 7)
    assert env.observation_space.shape == (SIZE + ACTIONS,)
    assert env.action_space == bare.action_space
    told, plain, steps = env.reset(), bare.reset(), np.zeros(n)
    ends = 0
    for _ in range(60):
        base = np.repeat(np.float32(0.01) * steps[:, None], ACTIONS, axis=1).astype(np.float32)
        np.testing.assert_array_equal(told, np.concatenate([plain, base], axis=1))
        assert env.observation_space.contains(told[0])
        action = rng.uniform(-1.0, 1.0, (n, ACTIONS)).astype(np.float32)
        told, rewards, dones, infos = env.step(action)
        plain, theirs, ended, their_infos = bare.step(np.clip(base + np.float32(scale) * action, -1.0, 1.0))
        np.testing.assert_array_equal(rewards, theirs)
        np.testing.assert_array_equal(dones, ended)
        for row in np.flatnonzero(dones):
            ends += 1
            last = infos[row]["terminal_observation"]
            np.testing.assert_array_equal(last, [*their_infos[row]["terminal_observation"], *base[row]])
        steps = np.where(dones, 0, steps + 1)
    assert ends > n, "episodes are to end"


def test_a_reset_begins_the_controllers_memory_anew_and_a_seed_its_random_numbers() -> None:
    env = ResidualVecEnv(TwoRobotsVecEnv(2, Settings(), 7), classical("random"), 0.1)
    streams = []
    for seed in (1, 1, 2):
        env.seed(seed)
        seen = [env.reset()] + [env.step(np.zeros((2, ACTIONS), np.float32))[0] for _ in range(3)]
        streams.append(np.stack(seen)[..., SIZE:])
    np.testing.assert_array_equal(streams[0], streams[1])
    assert not np.array_equal(streams[0], streams[2])
    counting = ResidualVecEnv(TwoRobotsVecEnv(2, Settings(), 7), Counting(), 0.1)
    counting.reset()
    counting.step(np.zeros((2, ACTIONS), np.float32))
    assert (counting.reset()[:, SIZE:] == 0.0).all()


def test_actions_stay_within_their_bounds() -> None:
    base, correction = np.array([0.95, -0.95, 0.5], np.float32), np.array([1.0, -1.0, -1.0], np.float32)
    both_actions = corrected(base, correction, 0.1)
    assert both_actions.dtype == np.float32
    np.testing.assert_array_equal(both_actions, np.array([1.0, -1.0, 0.4], np.float32))
    np.testing.assert_array_equal(corrected(base, np.zeros(3, np.float32), 0.7), base)


@pytest.mark.parametrize("observation", ["full", "errors"])
def test_a_controller_that_sees_errors_alone_sees_them_of_whatever_the_policy_sees(observation: Any) -> None:
    """Training with corrections of nothing goes as the controller by itself."""
    settings = Settings(action="velocity", observation=observation)
    env = ResidualVecEnv(TwoRobotsVecEnv(3, settings, 7), Correction("steered", 0.1).base(settings), 0.1)
    alone = TwoRobotsVecEnv(3, dataclasses.replace(settings, observation="errors"), 7)
    told, errors = env.reset(), alone.reset()
    for _ in range(5):
        own, _ = classical("steered").predict(errors)
        np.testing.assert_array_equal(told[:, :ERRORS_SIZE], errors)
        np.testing.assert_array_equal(told[:, -6:], own)
        told, errors = env.step(np.zeros((3, 6), np.float32))[0], alone.step(own)[0]


# A stored one.


@pytest.mark.parametrize("controller", ["tuned", "random", "predictive", "steered"])
def test_a_policy_that_says_nothing_leaves_its_controller_as_it_is(controller: str, tmp_path: Path) -> None:
    agent = Learned(stored(tmp_path / "model", residual(controller=controller), silent=True))
    own = run(agent, "approach-60", episodes=1, seed=3)
    alone = run(classical(controller), "approach-60", episodes=1, seed=3)
    assert agent.name == own[0].controller == f"{controller}-ppo"
    for one, other in zip(own, alone, strict=True):
        told, wanted = vars(one), vars(other)
        for name in told.keys() - {"controller", "step_ms"}:
            np.testing.assert_array_equal(told[name], wanted[name], err_msg=name)


@both
def test_a_stored_policy_acts_as_its_controller_and_a_share_of_its_own(algo: str, tmp_path: Path) -> None:
    config = residual(algo)
    model, env = build(config)
    save_model(tmp_path / "model", model, env, config, False, "")
    agent, base = Learned(tmp_path / "model"), classical("tuned")
    observations = first_observations(3)
    for whole in (agent, base):
        whole.seed(5)
    state = told_state = None
    for start in ([True] * 3, [False] * 3, [False, True, False]):
        starts = np.array(start)
        actions, state = agent.predict(observations, state, starts)
        own, told_state = base.predict(observations, told_state, starts)
        seen = normalise(with_base(observations, own), load_policy(tmp_path / "model")[1], config.clip_observation)
        theirs, _ = model.predict(seen, deterministic=True)
        assert np.abs(theirs).max() > 0.0
        np.testing.assert_allclose(actions, np.clip(own + 0.05 * theirs, -1.0, 1.0), rtol=0.0, atol=1e-6)
        np.testing.assert_array_equal(state.solver, told_state.solver)
    agent.seed(5)
    single, _ = agent.predict(observations[0])
    assert single.shape == (ACTIONS,)


def test_random_numbers_of_the_controller_are_fixed_by_the_seed(tmp_path: Path) -> None:
    agent, observation = Learned(stored(tmp_path / "model", residual(controller="random"))), np.zeros(63, np.float32)
    drawn = []
    for seed in (1, 2, 1):
        agent.seed(seed)
        drawn.append(agent.predict(observation)[0])
    np.testing.assert_array_equal(drawn[0], drawn[2])
    assert not np.array_equal(drawn[0], drawn[1])


def test_a_policy_in_training_corrects_by_the_same_law() -> None:
    model, env = build(residual(controller="idle"))
    raw = first_observations(4, Settings())

    def policy(told: Observations) -> NDArray[np.float32]:
        return np.asarray(model.predict(np.asarray(env.normalize_obs(told)), deterministic=True)[0])

    actions, state = Corrected(Idle(), policy, 0.5).predict(raw)
    assert state is None
    np.testing.assert_array_equal(actions, np.float32(0.5) * policy(with_base(raw, np.zeros((4, 10), np.float32))))


# A training.


@both
def test_a_training_runs_goes_on_and_can_be_repeated(algo: str, make_config: MakeConfig, tmp_path: Path) -> None:
    first = residual(algo, "idle" if algo == "sac" else "tuned", steps=128, checkpoint_every=64, out=tmp_path / "run")
    train(first)
    card = load_card(tmp_path / "run" / "model")
    assert card.residual == first.correction
    assert card.settings.action == first.settings.action == ("home" if algo == "sac" else "pose")
    before = tensors_of(tmp_path / "run")
    train(dataclasses.replace(first, out=tmp_path / "again"))
    again = tensors_of(tmp_path / "again")
    assert all(torch.equal(before[name], again[name]) for name in before)
    assert before["observation.mean"].shape == (SIZE + ACTIONS,)
    assert stored_config(tmp_path / "run").correction == first.correction
    assert train(going_on(tmp_path / "run", steps=256))[1]
    assert steps_of(tmp_path / "run")[-1] == 256
    assert Learned(checkpoints(tmp_path / "run")[-1]).predict(first_observations(1)[0])[0].shape == (ACTIONS,)
    assert "residual" in refusal(lambda: train(going_on(tmp_path / "run", steps=512, residual="baseline")))
    assert "residual_scale" in refusal(lambda: train(going_on(tmp_path / "run", steps=512, residual_scale=0.5)))


@pytest.mark.parametrize(("algo", "controller"), [("ppo", "tuned"), ("sac", "random")])
def test_it_is_judged_with_its_controller_which_the_training_does_not_notice(
    algo: str, controller: str, tmp_path: Path
) -> None:
    """The score is that of the stored model, whose controller remembers and draws as it does in the judged episodes."""
    # A scenario that `tuned` holds: networks of torch and numpy differ in the last digit, which decides when it loses.
    config = residual(algo, controller, scenario="approach-60", steps=128, checkpoint_every=64)
    train(dataclasses.replace(config, out=tmp_path / "run"))
    score = load_card(tmp_path / "run" / "model").score
    agent, state = Learned(tmp_path / "run" / "model"), None
    agent.seed(controller_seed(SEED))

    def predict(observations: Observations) -> NDArray[np.float32]:
        nonlocal state
        start = np.full(len(observations), state is None)
        actions, state = agent.predict(observations, state, start)
        return actions

    again = HeldOut(config.settings, EPISODES_CORRECTED).score(predict)
    assert score is not None
    assert again.merit == pytest.approx(score.merit, rel=2e-3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HeldOut, "score", lambda *_: Score(0.0, 1.0, 1.0, 1.0))
        train(dataclasses.replace(config, out=tmp_path / "unjudged"))
    judged, unjudged = tensors_of(tmp_path / "run"), tensors_of(tmp_path / "unjudged")
    assert all(torch.equal(judged[name], unjudged[name]) for name in judged)


# Bad input.


@pytest.mark.parametrize(
    "make",
    [
        lambda: TrainConfig(residual="nobody"),
        lambda: TrainConfig(residual="ppo"),
        lambda: TrainConfig(residual="tuned", residual_scale=0.0),
        lambda: TrainConfig(residual="tuned", residual_scale=1.5),
        lambda: TrainConfig(residual="tuned", residual_scale=float("nan")),
        lambda: Correction("tuned", True),
        lambda: Correction(["tuned"], 0.1),  # type: ignore[arg-type]
    ],
)
def test_what_cannot_be_corrected_is_refused(make: Callable[[], object]) -> None:
    assert "residual" in refusal(make)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"action": "home"}, "action must be 'pose', as of tuned, which is corrected; instead received 'home'"),
        ({"observation": "errors"}, "observation must be 'full', as of tuned, which is corrected"),
        ({"frame": "global"}, "frame must be 'robots', as of tuned, which is corrected"),
        ({"residual": "steered", "frame": "global"}, "frame must be 'robots', as of steered, which is corrected"),
        ({"n_epm": 0}, "n_epm"),
    ],
)
def test_a_controller_of_another_environment_is_refused(changes: Any, told: str) -> None:
    assert told in refusal(lambda: build(residual(**changes)))
