"""The same episodes for every controller: an episode is fixed by scenario, plant and seed, whoever acts in it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from agents.controller import Controller
from agents.records import Record
from magenv import ENV_ID
from magenv.actions import PLANAR
from magenv.episodes import Settings
from magenv.outcome import NO_SOLVER
from magenv.params import TaskParams, require
from magenv.trajectories import draw
from magenv.world import LOSSES

_CONTROLLER_STREAM = 1
_MEASURED = (
    "position_error_m",
    "heading_error_rad",
    "position_error_end_m",
    "heading_error_end_rad",
    "separation_min_m",
    "substeps",
    "projected",
)


def controller_seed(seed: int) -> int:
    """Return the number that a controller is seeded with for the episode of ``seed``.

    It tells nothing of what the environment draws from ``seed``: a controller's random numbers are not the plant's.
    """
    return int(np.random.SeedSequence(seed, spawn_key=(_CONTROLLER_STREAM,)).generate_state(1)[0])


def run(
    controller: Controller,
    scenario: str,
    plant: str = "paper",
    n_epm: int = 2,
    control_hz: float = 2.0,
    episodes: int = 20,
    seed: int = 0,
    progress: Callable[[Record], object] | None = None,
) -> list[Record]:
    """Run episodes of seeds ``seed``, ``seed + 1``, ... and return their records.

    Parameters
    ----------
    controller : Controller
        Made for the same number of EPMs and control rate.
    scenario, plant, n_epm, control_hz
        As the environment takes them.
    episodes : int
        How many.
    seed : int
        Of the first.
    progress : callable, optional
        Called with each record as soon as its episode has ended.
    """
    for name, value, least in (("episodes", episodes, 1), ("seed", seed, 0)):
        whole = isinstance(value, int) and not isinstance(value, bool) and value >= least
        require(whole, name, f"a whole number of at least {least}", value)
    settings = Settings(scenario, plant, n_epm, controller.action, controller.observation, controller.frame, control_hz)
    env = gymnasium.make(ENV_ID, disable_env_checker=True, **asdict(settings))
    try:
        _warm_up(env, controller, seed)
        records = []
        for k in range(episodes):
            records.append(run_episode(env, controller, settings, seed + k))
            if progress is not None:
                progress(records[-1])
        return records
    finally:
        env.close()


def _warm_up(env: gymnasium.Env[Any, Any], controller: Controller, seed: int) -> None:
    """Let the controller predict twice, so that compiling and loading are not counted as its time."""
    observation, _ = env.reset(seed=seed)
    controller.seed(controller_seed(seed))
    state = None
    for start in (True, False):
        _, state = controller.predict(observation[None], state, np.array([start]), deterministic=True)


def run_episode(env: gymnasium.Env[Any, Any], controller: Controller, settings: Settings, seed: int) -> Record:
    """Run the episode of ``seed`` in an environment made with ``settings`` and return its record."""
    observation, info = env.reset(seed=seed)
    controller.seed(controller_seed(seed))
    states, holds, step_ms = [info], [], []
    state, ended, start, solver = None, False, np.ones(1, np.bool_), []
    while not ended:
        before = time.perf_counter()
        actions, state = controller.predict(observation[None], state, start, deterministic=True)
        step_ms.append(1e3 * (time.perf_counter() - before))
        start = np.zeros(1, np.bool_)
        observation, _, terminated, truncated, info = env.step(actions[0])
        ended = terminated or truncated
        solver.append(info["solver"] if controller.action in PLANAR else _solver(state))
        states.append(info)
        holds.append(info)
    time_s = _stack(states, "time_s")
    tracked = holds[-1]["separation_tracked_m"]
    return Record(
        controller=controller.name,
        scenario=settings.scenario,
        plant=settings.plant,
        n_epm=settings.n_epm,
        control_hz=settings.control_hz,
        action=settings.action,
        seed=seed,
        success=info["is_success"],
        loss=LOSSES[holds[-1]["loss"]],
        loss_time_s=float(time_s[-1]) if terminated else None,
        separation_tracked_m=None if math.isnan(tracked) else tracked,
        time_s=time_s,
        robots=_stack(states, "robots")[:, :, :3],
        epm_pose=_stack(states, "epm_pose"),
        reference=_reference(settings, seed),
        **{name: _stack(holds, name) for name in _MEASURED},
        solver=np.array(solver),
        step_ms=np.array(step_ms),
    )


def _solver(state: Any) -> int:
    """Return what a controller's state tells of how its solver ended."""
    told = getattr(state, "solver", None)
    return NO_SOLVER if told is None else int(told[0])


def _stack(infos: list[dict[str, Any]], name: str) -> NDArray[Any]:
    return np.array([info[name] for info in infos])


def _reference(settings: Settings, seed: int) -> NDArray[np.float64]:
    """Return the reference (M+1, 2, 3) of the whole episode, which the environment tells only up to its end.

    The trajectory is the first thing that an episode draws.
    """
    trajectory = draw(settings.scenario, seeding.np_random(seed)[0])
    period_s = TaskParams(control_hz=settings.control_hz).period_s
    steps = math.ceil(trajectory.duration_s / period_s - 1e-9)
    return np.stack([trajectory.at(step * period_s) for step in range(steps + 1)])
