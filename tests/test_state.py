"""The state as one argument of kernels: the arrays stay numpy's, and live as long as kernels see them."""

from __future__ import annotations

import copy
import gc
import weakref
from typing import Any

import numpy as np
import pytest

from magenv.env import TwoRobots
from magenv.episodes import Episodes, Settings
from magenv.state import State, packed
from magenv.steps import begin_episodes


def state_of(n: int) -> State:
    episodes = Episodes(n, Settings("approach-60"))
    episodes.start(np.ones(n, np.bool_))
    return episodes.state


def test_kernels_write_into_the_arrays() -> None:
    state = state_of(3)
    state.robots[:] = 9.0
    state.used[:] = 0
    begin_episodes(0, 3, state.every, packed(state), np.empty((3, 63), np.float32))
    np.testing.assert_array_equal(state.robots[..., :3], state.measured)
    np.testing.assert_array_equal(state.used, 1)


def test_a_packed_state_keeps_its_arrays() -> None:
    """Kernels do not own them: whoever holds the packed state does."""
    state = state_of(2)
    kept = weakref.ref(state.robots)
    one = packed(state)
    del state
    gc.collect()
    assert kept() is not None
    del one
    gc.collect()
    assert kept() is None


def test_copies_of_episodes_have_arrays_of_their_own() -> None:
    episodes = Episodes(2, Settings("approach-60"))
    episodes.start(np.ones(2, np.bool_))
    other = copy.deepcopy(episodes)
    assert other.world.robots is other.state.robots
    assert not any(
        np.shares_memory(a, b)
        for a, b in zip(episodes.state, other.state, strict=True)
        if isinstance(a, np.ndarray) and isinstance(b, np.ndarray)
    )


@pytest.mark.parametrize(
    "given",
    [
        lambda action: action.astype(np.float64),
        lambda action: action.tolist(),
        lambda action: tuple(action.tolist()),
        lambda action: np.repeat(action, 2)[::2],
        lambda action: action.astype(">f4"),
        lambda action: np.ma.masked_array(action),
    ],
)
def test_an_action_is_taken_in_any_form(given: Any) -> None:
    action = np.linspace(-0.9, 0.9, 10).astype(np.float32)
    told = []
    for form in (np.asarray, given):
        env = TwoRobots(scenario="approach-60", control_hz=20.0)
        env.reset(seed=0)
        told.append(env.step(form(action))[0])
    np.testing.assert_array_equal(*told)
