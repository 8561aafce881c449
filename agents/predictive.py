"""The predictive controller: EPM poses straight from the motion that a model of the plant predicts.

At every control instant a filter estimates the robots' state and what pushes them, and the plan over the coming
commands (``planner``) is made anew from the last one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agents.controller import RowGenerators
from agents.planner import ENOUGH, TROUBLE, Planner, Problem
from agents.trim import ROOM, Trim
from magenv.actions import ActionMode, pose_to_action
from magenv.forecast import STATE, Course, Goal
from magenv.home import home_epms
from magenv.observer import MOMENTS, Noise, correct, forecast
from magenv.outcome import CONVERGED as SOLVED
from magenv.outcome import FELL_BACK, NOT_CONVERGED
from magenv.params import Plant, System, TaskParams, plant_named, require
from magenv.poses import POSE_SIZE, from_cartesian
from magenv.sensitivity import COORDINATES, believe
from magenv.task import Frame, Layout, ObservationMode, unpack

Floats = NDArray[np.float64]

HORIZON_S = 0.2
"""Commands are planned for so long a time; one at least, two where EPMs travel and one takes no longer than that: where
they end the one they begin the next."""
POSITION_M, HEADING_RAD, SETTLING_S = 1e-3, 0.03, 0.02
"""Errors that count one, and the time in which an error of the rate would make them."""
# What finite numbers and the neglected curvature of the motion leave in doubt, however exact the plant is.
_FLOOR_M, _FLOOR_RAD, _FLOOR_MPS, _FLOOR_RADPS = 3e-6, 3e-6, 1e-5, 3e-5
_PUSH_N, _PUSH_NM = 3e-5, 3e-8

_DRIFT_N, _DRIFT_NM = 1e-4, 1e-6
"""By what a push drifts in a second, per mismatch of the parameters."""
_AMISS_N, _AMISS_NM = 1e-3, 1e-5
"""Push at the beginning, per mismatch."""
_JUMPS_DRIFT, _JUMPS_AMISS = 50.0, 10.0
"""So many times as much where EPMs jump: with each jump, other things are amiss."""
_START_MPS, _START_RADPS = 1e-3, 1e-3
"""Rates that an episode may begin with."""

_LOST = 1.0
"""Variance (m^2, rad^2, and with others) from which on a pose is not known at all."""
_PULL = 0.6
"""Weight of the way from the trim where EPMs travel: EPMs do not come back by themselves from where they can do
little."""
_STAY = 3.0
"""Weight of the way from the last command, there: else noise drives EPMs to and fro as fast as they can go."""
_ABSURD = 1e3
"""Number from which on an observation tells nothing: all are of the order of one."""
_ASTRAY = 1e-3
"""From which difference on, in metres and of unit vectors, EPMs that travel are not where they were believed to be."""

CONVERGED, SOUGHT, UNSOLVED, FALLBACK = range(4)
"""How a command was come by: from the last plan, or where EPMs travel from any that meets the reference; from a search;
by one that did not converge, or where EPMs travel that leaves great errors; none found, the last safe command held."""
_OUTCOMES = np.array([SOLVED, SOLVED, NOT_CONVERGED, FELL_BACK])


@dataclass
class Memory:
    """What is remembered of one episode."""

    known: Floats
    """(20 + N,) estimate of the state, of what pushes, and of what is amiss with the moments."""
    covariance: Floats
    """(20 + N, 20 + N)"""
    commands: Floats
    """(H, N, 6) the plan from the present instant on."""
    before: Floats
    """(N, 6) the last command."""
    paths: Floats
    """(2 M, N, 6) EPMs in each substep of the times of the last command but one, and of the last."""
    trim: Floats
    """(N, 6) where EPMs that travel are drawn to."""


@dataclass
class PredictiveState:
    """What is remembered of ``n`` episodes; and how the last commands were come by."""

    rows: list[Memory | None]
    status: NDArray[np.int64]
    """(n,) codes: CONVERGED, SOUGHT, UNSOLVED, FALLBACK."""

    @property
    def solver(self) -> NDArray[np.int64]:
        """(n,) the same in the words of all controllers, codes into ``magenv.outcome.OUTCOMES``."""
        return _OUTCOMES[self.status]


def _per_coordinate(position: float, heading: float) -> Floats:
    return np.array([position, position, heading] * 2)


class Predictive:
    """Model predictive control behind ``predict``, on nominal parameters of its own.

    Parameters
    ----------
    n_epm : int
        Number of EPMs.
    control_hz : float
        Control rate. Where EPMs travel each command is planned from rest to rest: with periods too short to get far, at
        100 Hz and more, they crawl.
    plant : str
        Of whose kind the nominal plant is: how EPMs move, how exact measurements are, nominal masses and drags.
    name : str
        Under which results are reported.
    doubt : float
        Share by which moments, masses and drags are reckoned to differ from the nominal ones, where the nominal
        plant's mismatch is less. It costs the smallest separations, which only an exact model holds.
    """

    action: ActionMode = "pose"
    observation: ObservationMode = "full"
    frame: Frame = "robots"

    def __init__(
        self,
        n_epm: int = 2,
        control_hz: float = 2.0,
        plant: str = "paper",
        name: str = "predictive",
        doubt: float = 0.0,
    ) -> None:
        require(isinstance(doubt, int | float) and 0.0 <= doubt <= 0.9, "doubt", "a number from 0 to 0.9", doubt)
        self.name = name
        nominal = plant_named(plant)
        self._system = System(n_epm=n_epm)
        self._plant = replace(nominal, mismatch=max(nominal.mismatch, doubt))
        self._period_s = period = TaskParams(control_hz=control_hz).period_s
        self._layout = Layout(self._system, self._plant.workspace_radius_m, period, self.observation, self.frame)
        self._substeps = max(1, math.ceil(period / self._plant.substep_s - 1e-9))
        least = 1 if self._plant.epms_jump or period > HORIZON_S else 2
        self._stages = min(4, max(least, round(HORIZON_S / period)))
        self._planner = Planner(self._system, self._plant, period, self._substeps, self._stages)
        self._home = home_epms(n_epm, self._plant.home_turn_rad)
        self._held = Course.of(n_epm, self._substeps, True)
        self._lag = round(self._plant.latency_s / (period / self._substeps))
        late = self._plant.latency_s
        require(
            self._lag <= self._substeps,
            "control_hz",
            f"at most {1 / max(late, 1e-9):g}, where commands act {late:g} s late",
            control_hz,
        )
        weights = _per_coordinate(1 / POSITION_M, 1 / HEADING_RAD)
        self._weights = np.concatenate([weights, SETTLING_S * weights])
        planner = self._planner
        self._trim = (
            None if self._plant.epms_jump else Trim(planner.model, planner.arms, planner.statics, self._weights)
        )
        self._noise = _noise(self._plant)
        amiss = self._plant.mismatch * (_JUMPS_AMISS if self._plant.epms_jump else 1.0)
        self._pushed = _per_coordinate(_PUSH_N + _AMISS_N * amiss, _PUSH_NM + _AMISS_NM * amiss) ** 2
        self._floor = np.concatenate(
            [_per_coordinate(0.3 * _FLOOR_M, _FLOOR_RAD), _per_coordinate(_FLOOR_MPS, _FLOOR_RADPS)]
        )
        self.seed(0)

    def seed(self, seed: int) -> None:
        """Fix the random starts to come."""
        self._rngs = RowGenerators(seed)

    def predict(
        self,
        observation: NDArray[np.float32],
        state: PredictiveState | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], PredictiveState]:
        """Return the ``pose`` actions (n, 5 N) for observations (n, d), or (5 N,) for (d,), and the new state."""
        batch = np.atleast_2d(observation)
        batch = np.where(np.abs(batch) < _ABSURD, batch, np.float32(np.nan))  # such numbers tell no more
        parts = unpack(batch, self._layout)
        n = len(batch)
        if state is None:
            state = PredictiveState([None] * n, np.zeros(n, np.int64))
        require(len(state.rows) == n, "state", f"one of {n} episodes, as many as observations", len(state.rows))
        if episode_start is not None:
            require(np.shape(episode_start) == (n,), "episode_start", f"of shape ({n},)", np.shape(episode_start))
        actions = np.empty((n, POSE_SIZE * self._system.n_epm), np.float32)
        epms = self._told(np.concatenate([parts.epm_positions, parts.epm_directions], axis=-1))
        for i, rng in enumerate(self._rngs.of(n)):
            memory = None if episode_start is not None and episode_start[i] else state.rows[i]
            measured = parts.robots[i].reshape(-1)
            if memory is None:
                memory = self._begin(measured, epms[i])
            else:
                self._update(memory, measured, epms[i])
            references = self._references(parts.reference[i].reshape(-1, COORDINATES))
            state.status[i] = self._decide(memory, references, epms[i], rng)
            state.rows[i] = memory
            command = memory.commands[0]
            actions[i] = pose_to_action(from_cartesian(command[:, :3], command[:, 3:]), self._system)
            path = self._planner.path(memory.before, command)
            memory.paths = np.concatenate([memory.paths[self._substeps :], path])
            memory.before, memory.commands = command, np.concatenate([memory.commands[1:], memory.commands[-1:]])
        return actions.reshape(*np.shape(observation)[:-1], -1), state

    def _told(self, epms: Floats) -> Floats:
        """Return the EPMs (n, N, 6) with NaN where they cannot be: no unit moment, or out of the bounds of radii."""
        radii, sizes = np.linalg.norm(epms[..., :3], axis=-1), np.linalg.norm(epms[..., 3:], axis=-1)
        low, high = self._system.r_min_m - _ASTRAY, self._system.r_max_m + _ASTRAY
        sound = (low < radii) & (radii < high) & (np.abs(sizes - 1.0) < _ASTRAY)
        told: Floats = np.where(sound[..., None], epms, np.nan)
        return told

    def _begin(self, measured: Floats, epms: Floats) -> Memory:
        """Return the memory of an episode that begins, at rest."""
        if not np.isfinite(epms).all():
            epms = self._home
        known = np.zeros(MOMENTS + len(epms) + 2)
        known[:COORDINATES] = measured
        unknown = _per_coordinate(_START_MPS, _START_RADPS) ** 2
        moments = np.full(len(epms) + 2, self._plant.mismatch**2 / 3.0)  # of a uniform distribution
        covariance = np.diag(np.concatenate([self._noise.measured, unknown, self._pushed, moments]))
        paths = np.repeat(epms[None], 2 * self._substeps, axis=0)
        return Memory(known, covariance, np.repeat(epms[None], self._stages, axis=0), epms, paths, epms)

    def _update(self, memory: Memory, measured: Floats, epms: Floats) -> None:
        """Carry the estimate over the last hold and correct it; one that was lost is begun anew."""
        first = self._substeps - self._lag  # commands act late
        self._see(memory, epms)
        self._follow(memory.paths[first : first + self._substeps], memory.known, memory.covariance)
        if not np.abs(memory.covariance[:COORDINATES]).max() < _LOST:  # NaN as well
            fresh = self._begin(measured, epms)
            memory.known, memory.covariance = fresh.known, fresh.covariance
        elif np.isfinite(measured).all():
            correct(measured, self._noise, memory.known, memory.covariance)

    def _see(self, memory: Memory, epms: Floats) -> None:
        """Mend what is believed of the EPMs' motion by where they are seen (N, 6), at the end of the last hold."""
        now = 2 * self._substeps - self._lag
        if not np.isfinite(epms).all():
            return
        if self._plant.epms_jump:
            if self._lag == 0:
                memory.paths[self._substeps :] = epms  # what was commanded, as it was carried out
            return
        around = memory.paths[now - 1 : now + 1]  # the middles of the substeps before and after; none after the last
        astray = epms - around.mean(axis=0)
        if np.abs(astray).max() < _ASTRAY:
            return
        # They are not as fast as believed: what lacks now came evenly, and will lack.
        share = np.minimum(np.arange(1, len(memory.paths) - now + self._substeps + 1) / self._substeps, 1.0)
        memory.paths[now - self._substeps :] += share[:, None, None] * astray
        memory.paths[..., 3:] /= np.linalg.norm(memory.paths[..., 3:], axis=-1, keepdims=True)
        memory.before = memory.paths[-1].copy()

    def _follow(self, path: Floats, known: Floats, covariance: Floats) -> None:
        """Carry an estimate over the substeps of a path (K, N, 6) of the EPMs."""
        self._held.path[: len(path)] = path
        forecast(self._planner.model, self._held, 0, len(path), self._noise, known, covariance)

    def _references(self, told: Floats) -> Floats:
        """Return the states (H, 12) to be reached at the ends of the commands' times, from those told (5, 6)."""
        turn = np.diff(told, axis=0)
        turn[:, 2::3] = np.remainder(turn[:, 2::3] + math.pi, 2 * math.pi) - math.pi
        rates = np.concatenate([1.5 * turn[:1] - 0.5 * turn[1:2], 0.5 * (turn[:-1] + turn[1:])]) / self._period_s
        states: Floats = np.concatenate([told[:4], rates], axis=-1)
        share = self._lag / self._substeps  # commands act late, and so do their times end
        growth = np.diff(states[:, COORDINATES:], axis=0)
        states[:, :COORDINATES] += share * turn
        states[:, COORDINATES:] += share * np.concatenate([growth, growth[-1:]])
        return states[: self._stages]

    def _goal(self, memory: Memory, references: Floats, pushing: Floats, rng: np.random.Generator) -> Goal:
        """Return the goal of states (H, 12). EPMs that travel are to stay, and to come to a trim, kept in the memory.

        ``pushing`` (6,) acts throughout, N and N m.
        """
        home, pull, room = memory.before, 0.0, 0.0
        if self._trim is not None:
            memory.trim = self._trim.follow(references[0], pushing, memory.trim, rng)
            pull, room = math.hypot(_PULL, _STAY), ROOM  # two squares, of the ways from the trim and before, are one
            home = home + (_PULL / pull) ** 2 * (memory.trim - home)
        stages = len(references)
        return Goal(
            np.array([self._substeps]),
            references[:, None],
            self._weights,
            np.repeat(home[None], stages, axis=0),
            pull,
            room,
        )

    def _decide(self, memory: Memory, references: Floats, epms: Floats, rng: np.random.Generator) -> int:
        """Write the best plan found into the memory; return how it was come by."""
        known, covariance, before = memory.known.copy(), memory.covariance.copy(), memory.before
        if self._lag > 0:  # until the command acts
            self._follow(memory.paths[-self._lag :], known, covariance)
            if not np.isfinite(covariance).all():
                known, covariance = memory.known.copy(), memory.covariance.copy()
        elif self._plant.epms_jump and np.isfinite(epms).all():
            before = epms
        believe(self._planner.model, known[MOMENTS:])
        goal = self._goal(memory, references, known[STATE:MOMENTS].copy(), rng)
        doubt: Floats = _root(covariance[:STATE, :STATE] + np.diag(self._floor**2))
        problem = Problem(known[:STATE].copy(), known[STATE:MOMENTS].copy(), doubt, goal, before)
        memory.commands, cost, sought = self._plan(problem, memory.commands, rng)
        if not math.isfinite(cost):
            memory.commands = np.repeat(before[None], self._stages, axis=0)
            return FALLBACK
        if not self._plant.epms_jump:  # there, noise and ways cost as well
            return UNSOLVED if self._planner.missed(problem, memory.commands) > TROUBLE * self._stages else CONVERGED
        return UNSOLVED if cost > ENOUGH * self._stages else SOUGHT if sought else CONVERGED

    def _plan(self, problem: Problem, last: Floats, rng: np.random.Generator) -> tuple[Floats, float, bool]:
        """Return the commands (H, N, 6) for a problem, their cost, and whether they were sought elsewhere than here.

        ``last`` (H, N, 6) is the last plan.
        """
        return self._planner.plan(problem, last, rng)


def _root(covariance: Floats) -> Floats:
    """Return a root L of a covariance, L L^T; rounding may have left it not quite positive."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    root: Floats = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _noise(plant: Plant) -> Noise:
    """Return what the filter reckons with on a plant of this kind."""
    position, heading = math.hypot(plant.noise_position_m, _FLOOR_M), math.hypot(plant.noise_heading_rad, _FLOOR_RAD)
    drift = plant.mismatch * (_JUMPS_DRIFT if plant.epms_jump else 1.0)
    return Noise(
        _per_coordinate(position, heading) ** 2,
        _per_coordinate(_PUSH_N + _DRIFT_N * drift, _PUSH_NM + _DRIFT_NM * drift) ** 2,
        _per_coordinate(0.1 * _FLOOR_M, 0.1 * _FLOOR_RAD) ** 2,
    )
