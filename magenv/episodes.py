"""Batched episodes: world, actions and task put together. Both environments are shells over this one.

An episode is fixed by scenario, plant and seed: its start, and all else that is drawn, comes from the episode's own
generator before the first action, whatever the controller does.
"""

from __future__ import annotations

import math
import reprlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from magenv.actions import PLANAR, ActionMode, Actions
from magenv.forecast import STATE
from magenv.params import InputError, System, TaskParams, is_whole, plant_named, require
from magenv.poses import EPM_SIZE, LANES, POSE_SIZE
from magenv.random_knots import RANDOM_RADIUS_M
from magenv.reach import Shell
from magenv.starts import Starts, holding_epms
from magenv.state import State, packed
from magenv.steps import begin_episodes, clip, step_kernel, tell_rows
from magenv.task import REWARD_TERMS, Frame, Layout, ObservationMode
from magenv.trajectories import FAMILY_MOST_MM, extent, family_separation, named_trajectory
from magenv.uncertainty import is_uncertain, nominal
from magenv.workers import Workers
from magenv.world import Measurements, World, check_extent

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
        given = np.asarray(action)
        if given.dtype.kind not in "biufO":  # numpy would read text and dates as numbers
            raise TypeError
        numbers = np.array(given, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"Input action must be an array of shape {shape}; instead received {reprlib.repr(action)}."
        ) from None
    if numbers.shape != shape:
        require(False, "action", f"an array of shape {shape}", numbers.shape)
    if not clip(numbers.ravel()):
        numbers = np.array(action, dtype=np.float64)
        require(False, "action", "finite", numbers[~np.isfinite(numbers)][:3].tolist())
    return numbers


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
        require(is_whole(settings.n_epm) and settings.n_epm in (2, 3), "n_epm", "2 or 3", settings.n_epm)
        plant = self.plant = plant_named(settings.plant)
        trajectory, nearest = named_trajectory(settings.scenario), family_separation(settings.scenario)
        self.settings = settings
        self.system = System(n_epm=settings.n_epm)
        self.task = TaskParams(control_hz=settings.control_hz)
        self.layout = Layout(
            self.system, plant.workspace_radius_m, self.task.period_s, settings.observation, settings.frame
        )
        self._workers = Workers(threads, LANES if settings.action in PLANAR else None)  # searches differ in length
        shell = Shell.of(self.system, plant)
        self.actions = Actions(settings.action, self.system, self._workers, shell, plant, self.task.period_s)
        reach_and_gap = (RANDOM_RADIUS_M, 0.0 if nearest is None else nearest)
        if trajectory is not None:
            reach_and_gap = extent(trajectory)
        check_extent(reach_and_gap, plant, "scenario", f"{settings.scenario!r} on {settings.plant!r}")
        self.world = World(n, self.system, plant, self.task, trajectory, self._workers)
        bounds = self.layout.bounds()
        self.observation_space = spaces.Box(-bounds, bounds, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (self.actions.size,), np.float32)
        self._shape = (n, self.layout.size)
        self._starts = Starts(n, nearest, is_uncertain(plant), self._workers)
        self.state = self._state(n, bounds)
        self._prepare()

    def _state(self, n: int, bounds: Observations) -> State:
        """Return the arrays of world, actions and starts, by name, with those of the task."""
        w, system, task, physics, n_epm = self.world, self.system, self.task, self.world.physics, self.settings.n_epm
        plant = self.plant
        return State(
            robots=w.robots,
            epms=w.epms,
            constants=w.constants,
            mass=physics.mass,
            epm_moment=physics.epm_moment,
            epm_size=physics.epm_size,
            coefficients=w.coefficients,
            duration=w.duration_s,
            step=w.step_count,
            numbers=w.measurements.numbers,
            counts=w.measurements.counts,
            period=w.period_s,
            substeps=w.substeps,
            loss_distance=task.loss_distance_m,
            tracking_distance=task.tracking_distance_m,
            diameter=physics.body_diameter,
            wall_radius=physics.wall_radius,
            motion=w.motion,
            routes=w.routes,
            queue=w.queue,
            slow=w.slow,
            rubs=w.rubs,
            uncertain=is_uncertain(plant),
            plant_keys=self._starts.plant_keys,
            plant_key=np.zeros(n, np.uint64),
            mismatch=plant.mismatch,
            nominal=nominal(system, plant),
            inertia=physics.inertia,
            drag_linear=physics.drag_linear,
            drag_rotational=physics.drag_rotational,
            ipm_moments=physics.ipm_moment,
            substep=w.period_s / w.substeps,
            noise_position=plant.noise_position_m,
            noise_heading=plant.noise_heading_rad,
            targets=np.zeros(w.epms.shape),
            projected=np.zeros(n, np.bool_),
            solver=np.zeros(n, np.int64),
            **self.actions.constants(),
            offsets=self._starts.offsets,
            used=self._starts.used,
            position_sd=task.start_position_sd_m,
            heading_sd=task.start_heading_sd_rad,
            held_epms=self._held_epms(n),
            every=np.ones(n, np.bool_),
            measured=np.zeros((n, 2, 3)),
            before=np.zeros((n, 2, 3)),
            expected=np.zeros((n, STATE)),
            paid=np.zeros((len(REWARD_TERMS) + 1, n)),
            ended=np.zeros((2, n), np.bool_),
            time=np.zeros(n),
            references=np.zeros((n, 2, 3)),
            poses=np.zeros((n, POSE_SIZE * n_epm)),
            r_max=system.r_max_m,
            carried=self.settings.frame == "robots",
            bounds=bounds,
            action=np.zeros((1, self.actions.size)),
            observation=np.zeros((1, self.layout.size), np.float32),
        )

    def _held_epms(self, n: int) -> Floats:
        """Return room for EPMs that hold the robots at the start, filled where all rows start alike; none at home.

        Home holds nothing: robots there are lost before commands that act late, or EPMs that accelerate, could help.
        """
        plant = self.plant
        if plant.latency_s == 0.0 and math.isinf(min(plant.epm_acceleration_mps2, plant.epm_turn_acceleration_radps2)):
            return np.zeros((0, self.settings.n_epm, EPM_SIZE))
        trajectory = named_trajectory(self.settings.scenario)
        if trajectory is None:
            return np.zeros((max(n, 2), self.settings.n_epm, EPM_SIZE))
        return holding_epms(trajectory.at(0.0), self.system, self.world.motion.shell, plant.home_turn_rad)[None]

    def _prepare(self) -> None:
        self.packed = packed(self.state)
        self._kernel = step_kernel(self.settings.action, *self.world.shape)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy takes over: all but what refers to this one's own arrays."""
        return {name: value for name, value in vars(self).items() if name not in ("packed", "_kernel")}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        vars(self).update(kept)
        self._prepare()

    def seed(self, row: int, rng: np.random.Generator) -> None:
        """Draw the episodes of ``row`` from ``rng`` from now on."""
        self._starts.seed(row, rng)

    def set_nearest(self, nearest_m: float) -> None:
        """Let the robots of random trajectories drawn from now on come so near to each other (m) and no nearer.

        Raises
        ------
        ValueError
            If the scenario is no random family, or this is nearer than it is, or beyond the range of such families.
        """
        own, most = family_separation(self.settings.scenario), 1e-3 * FAMILY_MOST_MM
        require(own is not None, "scenario", "a random family", self.settings.scenario)
        assert own is not None
        fits = isinstance(nearest_m, int | float) and own <= nearest_m <= most
        require(fits, "nearest_m", f"from {own:g}, as of the scenario, to {most:g}", nearest_m)
        self._starts.nearest = nearest_m

    def draw(self, mask: Bools) -> None:
        """Draw the next episode of each row where ``mask`` says, from the row's generator."""
        self._starts.draw(mask, self.world.coefficients, self.world.duration_s)
        if len(self.state.held_epms) > 1:  # each row has a trajectory of its own
            for row in np.flatnonzero(mask).tolist():
                start = self.world.trajectory(row).at(0.0)
                shell, turn = self.world.motion.shell, self.plant.home_turn_rad
                self.state.held_epms[row] = holding_epms(start, self.system, shell, turn, at_best=True)

    def start(self, mask: Bools, observations: Observations | None = None) -> Observations:
        """Begin a new episode in each row where ``mask`` says, drawn from the row's generator.

        Returns ``observations`` (n, d), without it a new array, with the first ones of these rows written into it.
        """
        observations = np.empty(self._shape, np.float32) if observations is None else observations
        self.draw(mask)
        self._workers.run(begin_episodes, len(mask), mask, self.packed, observations)
        return observations

    def observe(self) -> Observations:
        """Return the observations (n, d), newly allocated."""
        observations = np.empty(self._shape, np.float32)
        self._workers.run(tell_rows, len(observations), self.state.every, self.packed, observations)
        return observations

    def step(self, actions: Floats, active: Bools) -> Observations:
        """Act (n, size), checked, for one control period in the active rows.

        Returns the observations (n, d) of all rows, newly allocated; ``outcome`` and ``step_info`` tell the rest.
        """
        observations = np.empty(self._shape, np.float32)
        self._workers.run(self._kernel, len(active), active, actions, self.packed, observations)
        return observations

    def outcome(self) -> tuple[Floats, Bools, Bools]:
        """Return reward, terminated and truncated (n,) of the last step, newly allocated."""
        s = self.state
        return s.paid[-1].copy(), s.ended[0].copy(), s.ended[1].copy()

    def state_info(self) -> dict[str, NDArray[Any]]:
        """Return the true state for records and pictures, arrays of length n, newly allocated."""
        s = self.state
        return {
            "time_s": s.time.copy(),
            "robots": s.robots.copy(),
            "reference": s.references.copy(),
            "epm_pose": s.poses.copy(),
        }

    def step_info(self) -> dict[str, NDArray[Any]]:
        """Return errors, separations, loss and reward terms of the last hold, arrays of length n, newly allocated.

        In the modes that solve for poses (``actions.PLANAR``) also how that ended.
        """
        s = self.state
        values = (*s.numbers.copy(), *s.counts.copy(), *s.paid[:-1].copy(), s.projected.copy())
        info = dict(zip(_STEP_KEYS, values, strict=True))
        return info | {"solver": s.solver.copy()} if self.actions.mode in PLANAR else info
