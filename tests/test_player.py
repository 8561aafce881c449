"""Stored policies played in numpy: the actions are those of Stable-Baselines3, and nothing of it is loaded."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from messages import refusal
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.ppo.policies import MlpPolicy as PPOPolicy
from stable_baselines3.sac.policies import SACPolicy
from tiny_runs import SAVED, both

from agents.catalogue import controller
from agents.configs import Activation
from agents.learned import Learned
from agents.networks import flatten, load_weights, policy_kwargs
from agents.player import normalise, shapes_of
from agents.store import Card, Normalisation, load_policy, save
from magenv.episodes import Episodes, Settings

ROOT = Path(__file__).parents[1]
SHIPPED = ROOT / "agents" / "data" / "home-ppo"
NETS = [(16, 8), (32,), (8, 8, 12)]


def sb3_policy(algo: str, net: tuple[int, ...], activation: Activation = "relu") -> BasePolicy:
    """Return the untrained policy of Stable-Baselines3 in the default environment."""
    spaces = Episodes(1, Settings())
    kind: Any = PPOPolicy if algo == "ppo" else SACPolicy
    policy: BasePolicy = kind(
        spaces.observation_space, spaces.action_space, lr_schedule=lambda _: 0.0, **policy_kwargs(net, activation)
    )
    policy.set_training_mode(False)
    return policy


def card_of(algo: str, net: tuple[int, ...], clip: float = 10.0, activation: Activation = "relu") -> Card:
    """Return the card of an untrained policy with these layers, whose observations are cut there."""
    config = dataclasses.replace(SAVED[algo], clip_observation=clip)
    own: Any = dataclasses.replace(config.own, net=net, activation=activation)
    return Card.of(dataclasses.replace(config, **{algo: own}), 0)


def some_policy(
    folder: Path, algo: str, net: tuple[int, ...], size: float, clip: float = 10.0, activation: Activation = "relu"
) -> tuple[BasePolicy, Normalisation]:
    """Store a policy with random weights and statistics in a folder, and return it."""
    rng, policy = np.random.default_rng(len(net)), sb3_policy(algo, net, activation)
    with torch.no_grad():
        for value in policy.parameters():
            drawn = rng.normal(0.0, size / value.shape[-1] ** 0.5, value.shape)
            value.copy_(torch.from_numpy(np.clip(drawn, -2.0, 2.0)))
    statistics = Normalisation(rng.normal(size=63), rng.uniform(0.1, 4.0, 63), 1e4)
    save(folder, card_of(algo, net, clip, activation), flatten(dict(policy.state_dict())), statistics)
    return policy, statistics


def observations(n: int) -> NDArray[np.float32]:
    """Return observations (n, 63), some beyond what normalisation clips."""
    return np.random.default_rng(1).normal(0.0, 5.0, (n, 63)).astype(np.float32)


@both
@pytest.mark.parametrize("net", NETS)
def test_the_shapes_are_those_of_the_networks_that_learn(algo: str, net: tuple[int, ...]) -> None:
    theirs = {name: tuple(value.shape) for name, value in sb3_policy(algo, net).state_dict().items()}
    assert shapes_of(algo, net, 63, 10) == theirs


@both
@pytest.mark.parametrize("net", NETS)
@pytest.mark.parametrize("activation", get_args(Activation))
@pytest.mark.parametrize(("size", "rounding", "clip"), [(0.3, 1e-6, 10.0), (1.5, 5e-6, 5.0)])
def test_actions_are_those_of_stable_baselines(
    algo: str, net: tuple[int, ...], size: float, rounding: float, clip: float, activation: Activation, tmp_path: Path
) -> None:
    """But for the rounding of single precision there, which grows with the weights."""
    policy, statistics = some_policy(tmp_path / "model", algo, net, size, clip, activation)
    agent, told = Learned(tmp_path / "model"), observations(200)
    seen = normalise(told, statistics, clip)
    assert (np.abs(seen) == clip).any()
    expected, _ = policy.predict(seen, deterministic=True)
    actions, state = agent.predict(told)
    assert state is None
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1.0
    assert len(np.unique(actions)) > 100
    assert (np.abs(actions) > 0.97).any() == (size > 1.0), "bounds are to be come near to by some and not by others"
    np.testing.assert_allclose(actions, expected, rtol=0.0, atol=rounding)
    rows = np.stack([agent.predict(row)[0] for row in told])
    np.testing.assert_allclose(rows, actions, rtol=0.0, atol=1e-7)


def test_the_shipped_agent_acts_as_in_stable_baselines() -> None:
    agent = Learned(SHIPPED)
    policy = sb3_policy("ppo", agent.card.net, agent.card.activation)
    weights, statistics = load_policy(SHIPPED)
    load_weights(policy, weights)
    told = statistics.mean + np.sqrt(statistics.variance) * np.random.default_rng(2).normal(size=(500, 63))
    told = told.astype(np.float32)
    expected, _ = policy.predict(normalise(told, statistics, agent.card.clip_observation), deterministic=True)
    np.testing.assert_allclose(agent.predict(told)[0], expected, rtol=0.0, atol=1e-6)


def test_a_decision_is_fast() -> None:
    agent, told, took = controller("home-ppo"), observations(1), []
    for _ in range(200):
        before = time.perf_counter()
        agent.predict(told)
        took.append(time.perf_counter() - before)
    assert min(took) < 3e-4


@pytest.mark.parametrize(
    "code",
    [
        """
from agents.catalogue import controller
from agents.rollout import run
assert len(run(controller("home-ppo"), "approach-60", episodes=1)[0].step_ms) == 200
""",
        """
import runpy
sys.argv = ["evaluate.py", "--list"]
runpy.run_path("evaluate.py", run_name="__main__")
""",
    ],
    ids=["play", "list"],
)
def test_what_does_not_learn_loads_no_torch(code: str) -> None:
    told = "print(sorted({name.split('.')[0] for name in sys.modules} & {'torch', 'stable_baselines3'}))"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", f"import sys\n{code}\n{told}"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    assert done.stdout.splitlines()[-1] == "[]"


# Bad input.


@pytest.mark.parametrize(
    ("algo", "name"),
    [("ppo", "mlp_extractor.policy_net.0.weight"), ("ppo", "action_net.weight"), ("sac", "actor.latent_pi.2.bias")],
)
def test_weights_that_may_overflow_are_refused(algo: str, name: str, tmp_path: Path) -> None:
    some_policy(tmp_path / "sound", algo, (16, 8), 1.0)
    weights, statistics = load_policy(tmp_path / "sound")
    weights[name] = np.full_like(weights[name], 3e38)
    save(tmp_path / "model", card_of(algo, (16, 8)), weights, statistics)
    assert "weights that give finite actions" in refusal(lambda: Learned(tmp_path / "model"))


@pytest.mark.parametrize("shape", [(), (62,), (2, 70), (2, 2, 63)])
def test_an_observation_of_another_environment_is_refused(shape: tuple[int, ...]) -> None:
    line = refusal(lambda: Learned(SHIPPED).predict(np.zeros(shape, np.float32)))
    assert f"of shape (63,) or (n, 63); instead received {shape}" in line
