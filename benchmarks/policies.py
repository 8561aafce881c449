"""The actions under which environments are measured: none, random ones, and such that keep control."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from agents.baseline import tuned_baseline
from magenv import ENV_ID
from magenv.episodes import Settings

Policy = Literal["control", "zero", "random"]
POLICIES: tuple[Policy, ...] = get_args(Policy)
Actions = NDArray[np.float32]
Vector = VectorEnv[Any, Any, Any]


@dataclass(frozen=True)
class Script:
    """Actions fixed beforehand, and the environment and seeds they are for."""

    settings: Settings
    seeds: list[int]
    """Of the environments' episodes."""
    actions: Actions
    """(steps, environments, size)."""


def make_batch(settings: Settings, envs: int, threads: int = 1) -> Vector:
    """Return the batched environment, reset in the same step."""
    chosen: dict[str, Any] = asdict(settings) | {"autoreset_mode": "SameStep", "threads": threads}
    return gymnasium.make_vec(ENV_ID, num_envs=envs, vectorization_mode="vector_entry_point", **chosen)


def script(policy: Policy, settings: Settings, envs: int, steps: int, recorded: int) -> Script:
    """Return the actions of a policy for ``envs`` environments.

    ``zero`` leaves the magnets at home, ``random`` draws them from the whole action space: both lose the robots within
    a hold or two. ``control`` is the tuned PID with its allocation, recorded in ``recorded`` episodes that the
    environments share among them; the same seeds and actions give the same episodes, so that the robots are kept when
    the record is played back, and the controller's own time does not count.
    """
    seeds = [i % recorded for i in range(envs)]
    size = 5 * settings.n_epm
    if policy == "zero":
        return Script(settings, seeds, np.zeros((steps, envs, size), np.float32))
    if policy == "random":
        draws = np.random.default_rng(0).uniform(-1.0, 1.0, (steps, envs, size))
        return Script(settings, seeds, draws.astype(np.float32))
    controller = tuned_baseline(settings.n_epm, settings.control_hz)
    settings = replace(settings, action=controller.action, frame=controller.frame)
    few = make_batch(settings, recorded)
    observations, _ = few.reset(seed=0)  # row i takes seed i
    controller.seed(0)
    state, starts, actions = None, np.ones(recorded, np.bool_), []
    for _ in range(steps):
        action, state = controller.predict(observations, state, starts)
        observations, _, terminated, truncated, _ = few.step(action)
        starts = terminated | truncated
        actions.append(action)
    few.close()
    return Script(settings, seeds, np.ascontiguousarray(np.stack(actions)[:, seeds]))  # as a policy's are
