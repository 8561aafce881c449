"""Batched episodes: world, actions and task put together. Both environments are shells over this one.

An episode is fixed by scenario, plant and seed: its start, and all else that is drawn, comes from the episode's own
generator before the first action, whatever the controller does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from magenv.actions import ActionMode, Actions
from magenv.kernels import kernel
from magenv.params import PLANTS, InputError, System, TaskParams, choose, require
from magenv.starts import Starts
from magenv.task import REWARD_TERMS, Frame, Layout, ObservationMode, observe_rows, reward_terms
from magenv.trajectories import named_trajectory, trajectory_of
from magenv.workers import Workers
from magenv.world import World, time_of

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_TERMS = tuple(f"reward_{name}" for name in REWARD_TERMS)


@dataclass(frozen=True)
class Settings:
    """What fixes an environment: the keyword arguments of ``gymnasium.make``."""

    scenario: str = "random"
    plant: str = "paper"
    n_epm: int = 2
    action: ActionMode = "home"
    observation: ObservationMode = "full"
    frame: Frame = "robots"
    control_hz: float = 2.0


def check_action(action: object, shape: tuple[int, ...]) -> Floats:
    """Return an action, or a batch of them, as a new array of float64 clipped to [-1, 1].

    Raises
    ------
    ValueError
        If it has another shape or is not finite.
    """
    try:
        numbers = np.array(action, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        raise InputError(f"Input action must be an array of shape {shape}; instead received {action!r}.") from None
    if numbers.shape != shape:
        require(False, "action", f"an array of shape {shape}", numbers.shape)
    if not _clip(numbers.reshape(-1)):
        numbers = np.array(action, dtype=np.float64)
        require(False, "action", "finite", numbers[~np.isfinite(numbers)][:3].tolist())
    return numbers


@kernel
def _clip(numbers: Floats) -> bool:
    """Clip ``numbers`` (k,) to [-1, 1] in place; return whether all were finite."""
    unfit = 0
    for i in range(len(numbers)):
        unfit += 0 if abs(numbers[i]) < math.inf else 1
        numbers[i] = min(max(numbers[i], -1.0), 1.0)
    return unfit == 0


@kernel
def _settle_rows(
    first: int,
    last: int,
    active: Bools,
    robots: Floats,
    commanded: Bools,
    numbers: Floats,
    counts: NDArray[np.int64],
    step: NDArray[np.int64],
    duration: Floats,
    period: float,
    substeps: int,
    terms: Floats,
    measured: Floats,
    before: Floats,
    projected: Bools,
    reward: Floats,
    terminated: Bools,
    truncated: Bools,
) -> None:
    """Measure the robots after a hold; write what it paid and how it ended. Inactive rows: nothing, not ended."""
    for i in range(first, last):
        reward[i], terminated[i], truncated[i] = 0.0, False, False
        if active[i]:
            for robot in range(2):
                for j in range(3):
                    before[i, robot, j] = measured[i, robot, j]
                    measured[i, robot, j] = robots[i, robot, j]
            projected[i] = commanded[i]
            terms[0, i], terms[1, i] = reward_terms(numbers[0, i], numbers[1, i])
            reward[i] = 0.5 * (terms[0, i] + terms[1, i])
            terminated[i] = counts[1, i] > 0
            time = time_of(step[i], counts[0, i], counts[1, i], period, substeps)
            over = time >= duration[trajectory_of(i, len(duration))] - 1e-9 * period
            truncated[i] = over and not terminated[i]


class Episodes:
    """``n`` episodes side by side, each with a generator of its own.

    Attributes
    ----------
    layout : Layout
        Which observation.
    observation_space, action_space : gymnasium.spaces.Box
        Of a single episode.
    world : World
        The true state.
    """

    def __init__(self, n: int, settings: Settings, threads: int = 1) -> None:
        require(settings.n_epm in (2, 3) and not isinstance(settings.n_epm, bool), "n_epm", "2 or 3", settings.n_epm)
        plant = self.plant = choose(PLANTS, "plant", settings.plant)
        trajectory = named_trajectory(settings.scenario)
        self.settings = settings
        self.system = System(n_epm=settings.n_epm)
        self.task = TaskParams(control_hz=settings.control_hz)
        self.layout = Layout(
            self.system, plant.workspace_radius_m, self.task.period_s, settings.observation, settings.frame
        )
        self._workers = Workers(threads)
        self.actions = Actions(settings.action, self.system, self._workers)
        self.world = World(n, self.system, plant, self.task, trajectory, self._workers)
        bounds = self.layout.bounds()
        self.observation_space = spaces.Box(-bounds, bounds, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (self.actions.size,), np.float32)
        self._bounds = bounds
        self._measured: Floats = np.zeros((n, 2, 3))
        self._before: Floats = np.zeros((n, 2, 3))
        self._terms: Floats = np.zeros((len(REWARD_TERMS), n))
        self._projected: Bools = np.zeros(n, np.bool_)
        self._starts = Starts(n, trajectory is None, self.task, self._workers)

    def seed(self, row: int, rng: np.random.Generator) -> None:
        """Draw the episodes of ``row`` from ``rng`` from now on."""
        self._starts.seed(row, rng)

    def start(self, mask: Bools) -> None:
        """Begin a new episode in each row where ``mask`` says, drawn from the row's generator."""
        self._starts.place(mask, self.world, self._measured, self._before)
        self._projected[mask] = False
        self.actions.start(mask, self._measured, self.world.epms)
        self.world.begin(mask)

    def observe(self) -> NDArray[np.float32]:
        """Return the observations (n, d), newly allocated."""
        w = self.world
        out = np.empty((len(self._measured), self.layout.size), np.float32)
        self._workers.run(
            observe_rows,
            len(out),
            self._measured,
            self._before,
            w.coefficients,
            w.duration_s,
            w.step_count,
            w.epms,
            w.period_s,
            self.system.r_max_m,
            self.settings.frame == "robots",
            self._bounds,
            out,
        )
        return out

    def step(self, actions: Floats, active: Bools) -> tuple[Floats, Bools, Bools]:
        """Act (n, size), checked, for one control period in the active rows; return reward, terminated, truncated."""
        w, n = self.world, len(active)
        targets, commanded = self.actions.to_epms(actions, self._measured, w.epms, active)
        m = w.step(targets, active)
        reward, terminated, truncated = np.empty(n), np.empty(n, np.bool_), np.empty(n, np.bool_)
        self._workers.run(
            _settle_rows,
            n,
            active,
            w.robots,
            commanded,
            m.numbers,
            m.counts,
            w.step_count,
            w.duration_s,
            w.period_s,
            w.substeps,
            self._terms,
            self._measured,
            self._before,
            self._projected,
            reward,
            terminated,
            truncated,
        )
        return reward, terminated, truncated

    def state_info(self) -> dict[str, NDArray[Any]]:
        """Return the true state for records and pictures, arrays of length n, newly allocated."""
        time, references, poses = self.world.describe()
        return {"time_s": time, "robots": self.world.robots.copy(), "reference": references, "epm_pose": poses}

    def single_info(self) -> dict[str, Any]:
        """Return ``state_info`` and ``step_info`` of a single episode, its numbers as Python's."""
        m, (time, references, poses) = self.world.measurements, self.world.describe()
        info: dict[str, Any] = {
            "time_s": time.item(),
            "robots": self.world.robots[0].copy(),
            "reference": references[0],
            "epm_pose": poses[0],
        }
        info.update(zip(m.NUMBERS, m.numbers.ravel().tolist(), strict=True))
        info.update(zip(m.COUNTS, m.counts.ravel().tolist(), strict=True))
        info.update(zip(_TERMS, self._terms.ravel().tolist(), strict=True))
        info["projected"] = self._projected.item()
        return info

    def step_info(self) -> dict[str, NDArray[Any]]:
        """Return errors, separations, loss and reward terms of the last hold, arrays of length n, newly allocated."""
        m = self.world.measurements
        info: dict[str, NDArray[Any]] = dict(zip(m.NUMBERS, m.numbers.copy(), strict=True))
        info |= zip(m.COUNTS, m.counts.copy(), strict=True)
        info |= zip(_TERMS, self._terms.copy(), strict=True)
        info["projected"] = self._projected.copy()
        return info
