"""Environments, scalar and batched, under random actions, and the comparison of what they give."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, get_args

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

import magenv
from magenv.actions import ActionMode
from magenv.env import TwoRobots
from magenv.vector_env import TwoRobotsVector

MakeEnv = Callable[..., TwoRobots]
Step = tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]
Arrays = dict[str, Any]
Record = tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], Arrays]

MODES: tuple[ActionMode, ...] = get_args(ActionMode)
AUTORESETS = list(AutoresetMode)
N = 4
"""Episodes of a batch."""


def still(env: TwoRobots) -> NDArray[np.float32]:
    return np.zeros(env.action_space.shape or (), np.float32)


def rollout(env: TwoRobots, seed: int | None, action_seed: int, steps: int = 40) -> Iterator[Step]:
    """Random actions, episode after episode; the first begins with ``seed``, the others go on."""
    rng = np.random.default_rng(action_seed)
    observation, info = env.reset(seed=seed)
    yield observation, 0.0, False, False, info
    for _ in range(steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        result: Step = env.step(action)
        yield result
        if result[2] or result[3]:
            observation, info = env.reset()
            yield observation, 0.0, False, False, info


def vector(n: int = N, autoreset: AutoresetMode = AutoresetMode.NEXT_STEP, **arguments: Any) -> TwoRobotsVector:
    env = gymnasium.make_vec(
        magenv.ENV_ID,
        num_envs=n,
        vectorization_mode="vector_entry_point",
        autoreset_mode=autoreset,
        **arguments,
    )
    assert isinstance(env.unwrapped, TwoRobotsVector)
    return env.unwrapped


def record(env: VectorEnv[Any, Any, Any], steps: int, action_seed: int = 0, seed: int | None = 10) -> Iterator[Record]:
    """Seeded reset, then random actions; in ``Disabled`` mode ended episodes are reset by mask."""
    rng, n = np.random.default_rng(action_seed), env.num_envs
    observations, info = env.reset(seed=seed)
    none = np.zeros(n)
    yield observations, none, none > 0, none > 0, info
    for _ in range(steps):
        actions = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        result = env.step(actions)
        yield result
        ended = result[2] | result[3]
        if env.metadata["autoreset_mode"] == AutoresetMode.DISABLED and ended.any():
            observations, info = env.reset(options={"reset_mask": ended.copy()})
            yield observations, none, none > 0, none > 0, info


def assert_same_bits(a: Any, b: Any) -> None:
    if isinstance(a, dict):
        assert isinstance(b, dict)
        assert a.keys() == b.keys()
        for key in a:
            assert_same_bits(a[key], b[key])
    else:
        one, two = np.asarray(a), np.asarray(b)
        assert one.dtype == two.dtype
        assert one.shape == two.shape
        assert one.tobytes() == two.tobytes()


def assert_same_rollouts(a: Iterator[Step], b: Iterator[Step]) -> None:
    for one, two in zip(a, b, strict=True):
        for x, y in zip(one, two, strict=True):
            assert_same_bits(x, y)


def info_of(info: Arrays, row: int) -> Arrays:
    """Return what an info says about one episode, by Gymnasium's masks."""
    found: Arrays = {}
    for name, value in info.items():
        if name.startswith("_") or not info[f"_{name}"][row]:
            continue
        found[name] = info_of(value, row) if isinstance(value, dict) else value[row]
    return found


def assert_same_info(a: Arrays, b: Arrays) -> None:
    assert a.keys() == b.keys()
    for name, value in a.items():
        if isinstance(value, dict):
            assert_same_info(value, b[name])
        else:
            one, two = np.asarray(value), np.asarray(b[name])
            assert one.dtype.kind == two.dtype.kind, name
            assert one.tobytes() == two.tobytes(), name
