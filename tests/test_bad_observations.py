"""What the predictive controller makes of observations that tell nothing, or what cannot be."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rollouts import MakeEnv
from walks import GOES_ON, Actions, Observations, first, walk

from agents.predictive import CONVERGED, FALLBACK, SOUGHT, UNSOLVED, Predictive
from magenv.actions import pose_to_action
from magenv.observer import MOMENTS
from magenv.outcome import FELL_BACK
from magenv.params import PLANTS, System
from magenv.poses import from_cartesian
from magenv.task import Layout, unpack

_ROBOT_1, _ROBOT_2, _POSE, _EPMS = 8, 12, 4, 49
"""Where the robots' poses are in an observation, how long they are, and where the EPMs are (see ``magenv.task``)."""


def together(observation: Observations) -> Observations:
    """Return the observation with robot 2 told to be where robot 1 is."""
    told = observation.copy()
    told[_ROBOT_2 : _ROBOT_2 + _POSE] = told[_ROBOT_1 : _ROBOT_1 + _POSE]
    return told


def unmoved(observation: Observations) -> Actions:
    """Return the action that leaves the EPMs where an observation says they are."""
    parts = unpack(observation, Layout(System(), PLANTS["paper"].workspace_radius_m, 0.5))
    return pose_to_action(from_cartesian(parts.epm_positions, parts.epm_directions), System()).astype(np.float32)


def test_where_nothing_can_be_foreseen_the_epms_stay(make_env: MakeEnv) -> None:
    observation = together(first(make_env(scenario="approach-60"), 0))
    action, state = Predictive().predict(observation)
    assert state.status[0] == FALLBACK
    assert state.solver[0] == FELL_BACK
    np.testing.assert_array_equal(action, unmoved(observation))


def test_where_no_plan_is_found_the_epms_stay(make_env: MakeEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where they are, and not where they were to go next."""
    env, agent = make_env(scenario="approach-60", action="pose"), Predictive()
    (*_, observation), (*_, last), state = walk(env, agent, 0, 2)
    monkeypatch.setattr(agent._planner, "plan", lambda problem, last, rng: (1.1 * last, math.inf, False))
    action, state = agent.predict(observation, state, GOES_ON)
    assert state.status[0] == FALLBACK
    np.testing.assert_array_equal(action, unmoved(observation))
    np.testing.assert_allclose(action, last, atol=1e-6)


def test_what_could_not_be_foreseen_once_is_over_with_the_next_observation(make_env: MakeEnv) -> None:
    """Robots told to be on the same spot, then where they are."""
    observation, agent = first(make_env(scenario="approach-60"), 0), Predictive()
    state = agent.predict(together(observation))[1]
    action, state = agent.predict(observation, state, GOES_ON)
    assert state.status[0] in (CONVERGED, SOUGHT)
    assert np.isfinite(action).all()


@pytest.mark.parametrize("plant", ["paper", "arm"])
@pytest.mark.parametrize("nothing", [math.nan, -math.inf, 1e30])
def test_what_tells_nothing_moves_nothing_unforeseen(make_env: MakeEnv, plant: str, nothing: float) -> None:
    """At first an action, later the last command; with the next observation it is over."""
    observation, agent = (
        first(make_env(scenario="approach-60", plant=plant, control_hz=10.0), 0),
        Predictive(2, 10.0, plant),
    )
    blind = np.full_like(observation, nothing)
    assert np.isfinite(agent.predict(blind)[0]).all()
    last, state = agent.predict(observation)
    action, state = agent.predict(blind, state, GOES_ON)
    assert state.status[0] == FALLBACK
    np.testing.assert_allclose(action, last, atol=1e-6)
    action, state = agent.predict(observation, state, GOES_ON)
    assert np.isfinite(action).all()
    assert state.status[0] != FALLBACK


@pytest.mark.parametrize("plant", ["paper", "moving", "arm"])
@pytest.mark.parametrize("seed", [11, 15])
def test_whatever_is_observed_there_is_an_action(make_env: MakeEnv, plant: str, seed: int) -> None:
    """Zeros, then observations drawn from the whole space, parts of them zero, as if they belonged together."""
    env, rng = make_env(scenario="approach-60", plant=plant, control_hz=10.0), np.random.default_rng(seed)
    env.observation_space.seed(seed)
    agent, state = Predictive(2, 10.0, plant), None
    for _ in range(12):
        observation = env.observation_space.sample() if state is not None else np.zeros_like(first(env, 0))
        observation[rng.random(observation.shape) < 0.3] = 0.0
        action, state = agent.predict(observation, state)
        assert state.status[0] in (CONVERGED, SOUGHT, UNSOLVED, FALLBACK)
        assert np.isfinite(action).all()
        assert np.abs(action).max() <= 1.0


@pytest.mark.parametrize("plant", ["paper", "moving", "arm"])
@pytest.mark.parametrize("spoilt", [slice(4, 7), slice(3, 4)])
@pytest.mark.parametrize("when", [0, 2])
def test_epms_that_cannot_be_are_not_believed(make_env: MakeEnv, plant: str, spoilt: slice, when: int) -> None:
    """A moment of zero, or a radius: nothing is made of it, and the robots are held."""
    env = make_env(scenario="approach-60", plant=plant, action="pose", control_hz=10.0)
    agent, state, observation = Predictive(2, 10.0, plant), None, first(env, 0)
    for step in range(10):
        if step == when:
            observation[_EPMS:][spoilt] = 0.0
        action, state = agent.predict(observation, state)
        observation, _, terminated, _, _ = env.step(action)
        assert not terminated


def test_robots_that_are_not_seen_once_leave_what_is_known(make_env: MakeEnv) -> None:
    env = make_env(scenario="approach-60", action="pose", plant="arm", control_hz=10.0)
    (*_, observation), _, state = walk(env, Predictive(2, 10.0, "arm"), 0, 20)
    learned = state.rows[0].known[MOMENTS:].copy()
    observation[_ROBOT_1 : _ROBOT_2 + _POSE] = np.nan
    assert np.abs(learned).max() > 0.01
    _, state = Predictive(2, 10.0, "arm").predict(observation, state, GOES_ON)
    np.testing.assert_array_equal(state.rows[0].known[MOMENTS:], learned)
