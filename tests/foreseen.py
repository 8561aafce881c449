"""What controllers foresee: models of the plant, motions of EPMs and goals, made with few words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magenv.actions import Actions
from magenv.dynamics import Physics, constants
from magenv.forecast import STATE, Course, Goal, roll
from magenv.lanes import CONSTANTS, CONSTANTS_SIZE
from magenv.local import local_basis, shift
from magenv.params import PLANTS, System
from magenv.sensitivity import Model, believe
from magenv.trajectories import shaped

Floats = NDArray[np.float64]

PAPER = PLANTS["paper"]
ONES = np.ones(STATE)
NATURAL = np.array([1e-3, 1e-3, 0.03, 1e-3, 1e-3, 0.03, 0.01, 0.01, 0.3, 0.01, 0.01, 0.3])
"""(12,) sizes that a state's coordinates have in common: a millimetre, and what goes with it."""
WEIGHTS = 1.0 / NATURAL
UNMOVED = np.zeros(6)
CERTAIN = np.zeros((STATE, STATE))


def paper_model(n_epm: int = 2) -> Model:
    """Model of the paper's plant."""
    return Model.of(System(n_epm=n_epm), PAPER, PAPER.substep_s)


def uneven_model(n_epm: int) -> Model:
    """Model in which no two EPMs and no two robots are alike."""
    system = System(n_epm=n_epm)
    model, physics, row = paper_model(n_epm), Physics.of(system, PAPER, 1), np.empty((1, CONSTANTS_SIZE))
    for values, factor in (
        (physics.mass, 1.3),
        (physics.inertia, 0.8),
        (physics.drag_linear, 1.7),
        (physics.drag_rotational, 1.4),
        (physics.ipm_moment, 0.9),
        (physics.epm_moment, 0.8),
    ):
        values[0, 1] *= factor
    constants(physics, PAPER.substep_s, row)
    model.lane[CONSTANTS : CONSTANTS + CONSTANTS_SIZE, 0] = row
    physics.epm_moment[0] *= np.array([1.1, 1.0, 1.2])[:n_epm]
    model.nominal[:] = np.concatenate([physics.epm_moment[0], physics.ipm_moment[0]])
    believe(model, np.zeros(n_epm + 2))
    return model


def bases_of(epms: Floats) -> Floats:
    """Bases (N, 6, 5) of the local coordinates of EPMs (N, 6)."""
    bases = np.empty((len(epms), 6, 5))
    for epm, basis in zip(epms, bases, strict=True):
        local_basis(epm, basis)
    return bases


def shifted(epms: Floats, step: Floats, r_min: float = 1e-3, r_max: float = 1e3) -> Floats:
    """EPMs (N, 6) after a step (5 N) in their local coordinates."""
    out = epms.copy()
    for epm, basis, part in zip(out, bases_of(epms), step.reshape(-1, 5), strict=True):
        shift(epm, basis, part, r_min, r_max)
    return out


def held(epms: Floats, substeps: int) -> Course:
    """EPMs (N, 6) that jump there and stay for so many substeps."""
    motion = Course.of(len(epms), substeps, False)
    motion.path[0], motion.by[0, 1] = epms, bases_of(epms)
    return motion


def travelling(before: Floats, command: Floats, substeps: int) -> Course:
    """EPMs on the straight line between two of their places (N, 6), which they reach in the last substep."""
    motion = Course.of(len(command), substeps, True)
    first, second = bases_of(before), bases_of(command)
    for j, share in enumerate((1.0 + np.arange(substeps)) / substeps):
        motion.path[j] = (1.0 - share) * before + share * command
        motion.by[j, 0], motion.by[j, 1] = (1.0 - share) * first, share * second
    return motion


def goal_of(
    references: Floats,
    marks: tuple[int, ...],
    weights: Floats = ONES,
    home: Floats | None = None,
    pull: float = 0.0,
    room: float = 0.0,
) -> Goal:
    """Goal with references (H, k, 12) at marks, or of (H, 12) at a single one, and one home (N, 6) for all commands."""
    states = np.ascontiguousarray(references).reshape(-1, len(marks), STATE)
    homes = np.repeat((np.ones((3, 6)) if home is None else home)[None], len(states), axis=0)
    return Goal(np.array(marks), states, weights, homes, pull, room)


def foreseen(
    model: Model, state: Floats, pushing: Floats, motion: Course, goal: Goal, sensitivity: Floats | None = None
) -> tuple[Floats, Floats, Floats]:
    """State (12,) at the end of a motion, residuals (12 k,) and, by what ``sensitivity`` holds, their derivatives."""
    by = np.empty((STATE, 0)) if sensitivity is None else sensitivity
    end, rows = state.copy(), STATE * len(goal.marks)
    residuals, jacobian = np.full(rows, np.nan), np.full((rows, by.shape[1]), np.nan)
    cost = roll(model, end, pushing, motion, goal, 0, by, residuals, jacobian)
    np.testing.assert_allclose(cost, residuals @ residuals, rtol=1e-12)
    return end, residuals, jacobian


def end_of(model: Model, state: Floats, pushing: Floats, motion: Course) -> Floats:
    """State (12,) at the end of a motion."""
    goal = goal_of(np.zeros((1, STATE)), (len(motion.which),))
    return foreseen(model, state, pushing, motion, goal)[0]


def on_the_way(scenario_m: float, time_s: float) -> Floats:
    """State (12,) of robots that follow an approach to so many metres."""
    trajectory, h = shaped("approach", scenario_m), 1e-3
    rates = (trajectory.at(time_s + h) - trajectory.at(time_s - h)) / (2 * h)
    return np.concatenate([trajectory.at(time_s).ravel(), rates.ravel()])


def at_home(state: Floats, n_epm: int = 2) -> Floats:
    """EPMs (N, 6) at home for robots in a state (12,)."""
    home: Floats = Actions("home", System(n_epm=n_epm)).home(state[:6].reshape(1, 2, 3))[0]
    return home
