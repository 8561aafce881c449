"""Batched episodes: world, actions and task put together. Both environments are shells over this one.

An episode is fixed by scenario, plant and seed: its start, and all else that is drawn, comes from the episode's own
generator before the first action, whatever the controller does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from magenv.actions import ActionMode, Actions
from magenv.params import PLANTS, InputError, System, TaskParams, choose, is_whole, require
from magenv.poses import from_cartesian
from magenv.task import REWARD_TERMS, Frame, Layout, ObservationMode, observe_rows, reward_rows
from magenv.trajectories import check_scenario, draw
from magenv.world import World

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


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
    """Return an action, or a batch of them, as float64 clipped to [-1, 1].

    Raises
    ------
    ValueError
        If it has another shape or is not finite.
    """
    must_be = f"an array of shape {shape}"
    try:
        numbers = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"Input action must be {must_be}; instead received {action!r}.") from None
    require(numbers.shape == shape, "action", must_be, numbers.shape)
    require(bool(np.isfinite(numbers).all()), "action", "finite", numbers[~np.isfinite(numbers)][:3].tolist())
    return np.clip(numbers, -1.0, 1.0)


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

    def __init__(self, n: int, settings: Settings) -> None:
        require(is_whole(settings.n_epm) and settings.n_epm in (2, 3), "n_epm", "2 or 3", settings.n_epm)
        plant = self.plant = choose(PLANTS, "plant", settings.plant)
        check_scenario(settings.scenario)
        self.settings = settings
        self.system = System(n_epm=settings.n_epm)
        self.task = TaskParams(control_hz=settings.control_hz)
        self.layout = Layout(
            self.system, plant.workspace_radius_m, self.task.period_s, settings.observation, settings.frame
        )
        self.actions = Actions(settings.action, self.system)
        self.world = World(n, self.system, plant, self.task)
        bounds = self.layout.bounds()
        self.observation_space = spaces.Box(-bounds, bounds, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (self.actions.size,), np.float32)
        self._bounds = bounds
        self._measured: Floats = np.zeros((n, 2, 3))
        self._before: Floats = np.zeros((n, 2, 3))
        self._terms = {name: np.zeros(n) for name in REWARD_TERMS}
        self._projected: Bools = np.zeros(n, np.bool_)

    def start(self, row: int, rng: np.random.Generator) -> None:
        """Begin a new episode in ``row``, drawn from ``rng``."""
        trajectory = draw(self.settings.scenario, rng)
        robots = np.zeros((2, 6))
        robots[:, :3] = trajectory.at(0.0)
        robots[:, :2] += rng.normal(0.0, self.task.start_position_sd_m, (2, 2))
        robots[:, 2] += rng.normal(0.0, self.task.start_heading_sd_rad, 2)
        epms = self.actions.home(robots[None, :, :3])[0]
        self.world.start(row, trajectory, robots, epms)
        self._measured[row] = robots[:, :3]
        self._before[row] = robots[:, :3]
        self._projected[row] = False

    def observe(self) -> NDArray[np.float32]:
        """Return the observations (n, d), newly allocated."""
        w = self.world
        out = np.empty((len(self._measured), self.layout.size), np.float32)
        observe_rows(
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
        w = self.world
        targets, projected = self.actions.to_epms(actions, self._measured, w.epms)
        measured = w.step(targets, active)
        self._projected = np.where(active, projected, self._projected)
        self._before[active] = self._measured[active]
        self._measured[active] = w.robots[active, :, :3]
        reward_rows(
            measured.position_error_m, measured.heading_error_rad, self._terms["position"], self._terms["heading"]
        )
        terminated = active & (measured.loss > 0)
        truncated = active & ~terminated & w.ended()
        reward = np.where(active, sum(self._terms.values()) / len(self._terms), 0.0)
        return reward, terminated, truncated

    def state_info(self) -> dict[str, NDArray[Any]]:
        """Return the true state for records and pictures, arrays of length n, newly allocated."""
        w = self.world
        return {
            "time_s": w.time_s(),
            "robots": w.robots.copy(),
            "reference": w.references(),
            "epm_pose": from_cartesian(w.epms[..., :3], w.epms[..., 3:]),
        }

    def step_info(self) -> dict[str, NDArray[Any]]:
        """Return errors, separations, loss and reward terms of the last hold, arrays of length n, newly allocated."""
        info: dict[str, NDArray[Any]] = {name: value.copy() for name, value in vars(self.world.measurements).items()}
        info |= {f"reward_{name}": value.copy() for name, value in self._terms.items()}
        info["projected"] = self._projected.copy()
        return info
