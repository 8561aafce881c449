"""Settings and fixtures shared by all tests."""

from __future__ import annotations

import os

# Before anything imports torch, pygame or matplotlib: one thread, no window.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["SDL_AUDIODRIVER"] = "dummy"
os.environ["MPLBACKEND"] = "Agg"

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

import magenv
from magenv.env import TwoRobots
from magenv.params import PLANTS, Body, Plant

Floats = NDArray[np.float64]
MakeEnv = Callable[..., TwoRobots]
Rotation = Callable[[float], Floats]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20230)


@pytest.fixture
def make_env() -> Iterator[MakeEnv]:
    """Make the registered environment without its wrappers; all are closed afterwards."""
    made: list[TwoRobots] = []

    def make(**arguments: Any) -> TwoRobots:
        env = gymnasium.make(magenv.ENV_ID, **arguments).unwrapped
        assert isinstance(env, TwoRobots)
        made.append(env)
        return env

    yield make
    for env in made:
        env.close()


@pytest.fixture
def stuck_plant(monkeypatch: pytest.MonkeyPatch) -> str:
    """Name of a plant in which drag holds the robots where they are put, so that a test can lead them."""
    monkeypatch.setitem(PLANTS, "stuck", Plant(body=Body(drag_linear_nspm=1e9, drag_rotational_nmsprad=1e6)))
    return "stuck"


@pytest.fixture
def rotations(rng: np.random.Generator) -> Floats:
    """Twenty rotations of space, matrices (20, 3, 3)."""
    q, _ = np.linalg.qr(rng.normal(size=(20, 3, 3)))
    q[..., 0] *= np.linalg.det(q)[:, None]
    return np.asarray(q)


@pytest.fixture
def turn_about_z() -> Rotation:
    """Return the matrix that turns by an angle (rad) about the vertical."""

    def matrix(angle: float) -> Floats:
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    return matrix
