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
from magenv.poses import POSE_SIZE
from magenv.starts import Starts
from magenv.steps import begin_episodes, step_kernel, tell_rows
from magenv.task import REWARD_TERMS, Frame, Layout, ObservationMode
from magenv.trajectories import named_trajectory
from magenv.workers import Workers
from magenv.world import Measurements, World

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Observations = NDArray[np.float32]

_STEP_KEYS = (
    *Measurements.NUMBERS,
    *Measurements.COUNTS,
    *(f"reward_{name}" for name in REWARD_TERMS),
    "projected",
)


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
    if not _clip(numbers.ravel()):
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
        self._shape = (n, self.layout.size)
        self._every: Bools = np.ones(n, np.bool_)
        self._measured: Floats = np.zeros((n, 2, 3))
        self._before: Floats = np.zeros((n, 2, 3))
        self._targets: Floats = np.zeros(self.world.epms.shape)
        self._projected: Bools = np.zeros(n, np.bool_)
        self._paid: Floats = np.zeros((len(REWARD_TERMS) + 1, n))  # the terms, then the reward
        self._ended: Bools = np.zeros((2, n), np.bool_)  # terminated, truncated
        self._time_s: Floats = np.zeros(n)
        self._references: Floats = np.zeros((n, 2, 3))
        self._poses: Floats = np.zeros((n, POSE_SIZE * settings.n_epm))
        self._starts = Starts(n, trajectory is None, self._workers)
        w, starts, task = self.world, self._starts, self.task
        # Arguments of the kernels, collected once: the arrays are the same ones at every step.
        self._told = (
            self._measured,
            self._before,
            w.coefficients,
            w.duration_s,
            w.step_count,
            w.measurements.counts,
            w.epms,
            w.period_s,
            w.substeps,
            self.system.r_max_m,
            settings.frame == "robots",
            bounds,
            self._time_s,
            self._references,
            self._poses,
        )
        self._kernel = step_kernel(settings.n_epm, w.width)
        self._stepped = (
            w.robots,
            w.epms,
            self._targets,
            *w.held,
            self._paid,
            self._ended,
            self._every,
            self._measured,
            self._before,
            self.system.r_max_m,
            settings.frame == "robots",
            bounds,
            self._time_s,
            self._references,
            self._poses,
        )
        self._started = (
            starts.offsets,
            starts.used,
            task.start_position_sd_m,
            task.start_heading_sd_rad,
            self.actions.home_epms,
            task.tracking_distance_m,
            w.robots,
            w.measurements.numbers,
            self._projected,
            *self._told,
        )

    def seed(self, row: int, rng: np.random.Generator) -> None:
        """Draw the episodes of ``row`` from ``rng`` from now on."""
        self._starts.seed(row, rng)

    def start(self, mask: Bools, observations: Observations | None = None) -> Observations:
        """Begin a new episode in each row where ``mask`` says, drawn from the row's generator.

        Returns ``observations`` (n, d), without it a new array, with the first ones of these rows written into it.
        """
        observations = np.empty(self._shape, np.float32) if observations is None else observations
        self._starts.draw(mask, self.world.coefficients, self.world.duration_s)
        self._workers.run(begin_episodes, len(mask), mask, *self._started, observations)
        return observations

    def observe(self) -> Observations:
        """Return the observations (n, d), newly allocated."""
        observations = np.empty(self._shape, np.float32)
        self._workers.run(tell_rows, len(observations), self._every, *self._told, observations)
        return observations

    def step(self, actions: Floats, active: Bools) -> Observations:
        """Act (n, size), checked, for one control period in the active rows.

        Returns the observations (n, d) of all rows, newly allocated; ``outcome`` and ``step_info`` tell the rest.
        """
        w = self.world
        self.actions.command(actions, self._measured, w.epms, active, self._targets, self._projected)
        observations = np.empty(self._shape, np.float32)
        self._workers.run(self._kernel, len(active), active, *self._stepped, observations)
        return observations

    def outcome(self) -> tuple[Floats, Bools, Bools]:
        """Return reward, terminated and truncated (n,) of the last step, newly allocated."""
        return self._paid[-1].copy(), self._ended[0].copy(), self._ended[1].copy()

    def state_info(self) -> dict[str, NDArray[Any]]:
        """Return the true state for records and pictures, arrays of length n, newly allocated."""
        return {
            "time_s": self._time_s.copy(),
            "robots": self.world.robots.copy(),
            "reference": self._references.copy(),
            "epm_pose": self._poses.copy(),
        }

    def step_info(self) -> dict[str, NDArray[Any]]:
        """Return errors, separations, loss and reward terms of the last hold, arrays of length n, newly allocated."""
        m = self.world.measurements
        values = (*m.numbers.copy(), *m.counts.copy(), *self._paid[:-1].copy(), self._projected.copy())
        return dict(zip(_STEP_KEYS, values, strict=True))

    def single_state(self) -> dict[str, Any]:
        """Return ``state_info`` of a single episode, its numbers as Python's."""
        return {
            "time_s": self._time_s.item(),
            "robots": self.world.robots[0].copy(),
            "reference": self._references[0].copy(),
            "epm_pose": self._poses[0].copy(),
        }

    def single_outcome(self) -> tuple[float, bool, bool, dict[str, Any]]:
        """Return ``outcome`` of a single episode, and ``single_state`` with ``step_info``, its numbers as Python's."""
        m, info = self.world.measurements, self.single_state()
        *terms, reward = self._paid.ravel().tolist()
        terminated, truncated = self._ended.ravel().tolist()
        values = m.numbers.ravel().tolist() + m.counts.ravel().tolist() + terms + self._projected.tolist()
        info.update(zip(_STEP_KEYS, values, strict=True))
        return reward, terminated, truncated, info
