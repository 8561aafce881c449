"""What a controller expects of a command: where the robots are in its time, and how that depends on what is chosen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.angles import wrap
from magenv.kernels import kernel
from magenv.poses import EPM_SIZE, POSE_SIZE
from magenv.sensitivity import COORDINATES, Model, chain, differentiate, go, load_state, place, push, read_state

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

STATE = 2 * COORDINATES


class Goal(NamedTuple):
    """What is to be reached, over H commands."""

    marks: Integers
    """(k,) substeps of a command's time at whose ends the errors are taken, rising."""
    references: Floats
    """(H, k, 12) states there."""
    weights: Floats
    """(12,) of the errors, per m, rad, m/s, rad/s."""
    home: Floats
    """(H, N, 6) EPMs that commands are drawn to."""
    pull: float
    """Weight of the way from there, per 0.1 m of the centres and per unit of the unit moments."""
    room: float
    """Weight of EPMs nearer to each other than they should be, per cm."""


class Course(NamedTuple):
    """Where the EPMs are in a command's time, and how that depends on this command and the one before."""

    which: Integers
    """(M,) row of the next two in each substep."""
    path: Floats
    """(rows, N, 6) EPMs that act."""
    by: Floats
    """(rows, 2, N, 6, 5) derivatives by the command before and by this one, in their local coordinates.

    Of centres by the first three alone, of moments by the last two."""
    carried: bool
    """Whether the EPMs travel, and so depend on the command before."""

    @classmethod
    def of(cls, n_epm: int, substeps: int, travels: bool) -> Course:
        """Return room for the motion of so many substeps."""
        rows = substeps if travels else 1
        which = np.arange(substeps) if travels else np.zeros(substeps, np.int64)
        path, by = np.zeros((rows, n_epm, EPM_SIZE)), np.zeros((rows, 2, n_epm, EPM_SIZE, POSE_SIZE))
        return cls(which, path, by, travels)


@kernel
def _drive(model: Model, by: Floats, carried: bool, first: int, drive: Floats) -> None:
    """Write the derivatives of the wrench by the commands into the columns from ``first`` on of ``drive`` (6, m)."""
    n_epm = len(model.epm_moment)
    width = POSE_SIZE * n_epm
    for old in range(0 if carried else 1, 2):
        at = first if old == 1 else first - STATE - width
        for i in range(COORDINATES):
            for k in range(n_epm):
                for c in range(POSE_SIZE):
                    first_a = 0 if c < 3 else 3  # of an EPM's centre, or moment
                    total = 0.0
                    for a in range(first_a, first_a + 3):
                        total += model.gradients[i, EPM_SIZE * k + a] * by[old, k, a, c]
                    drive[i, at + POSE_SIZE * k + c] = total


@kernel
def roll(
    model: Model,
    state: Floats,
    pushing: Floats,
    motion: Course,
    goal: Goal,
    stage: int,
    sensitivity: Floats,
    residuals: Floats,
    jacobian: Floats,
) -> float:
    """Predict the motion of a command's time from ``state`` (12,), which is overwritten; return the errors' cost.

    A wrench ``pushing`` (6,), N and N m, acts throughout; ``stage`` tells which of the goal's references count.
    Writes the weighted errors (12 k, at least) and, where ``sensitivity`` (12, m) has columns, their derivatives into
    the last m columns of ``jacobian``. Its last 5 N columns are those of the command; before them, where there is room,
    those of the first state and of the command before. What it holds at first is carried on.
    """
    mark, last, cost, m = 0, -1, 0.0, sensitivity.shape[1]
    width = POSE_SIZE * len(model.epm_moment)
    carried, column = motion.carried and m > STATE + width, jacobian.shape[1] - m
    drive = np.zeros((COORDINATES, m))
    load_state(model, state)
    push(model, pushing)
    for j in range(len(motion.which)):
        row = motion.which[j]
        if row != last:
            place(model, motion.path[row])
            last = row
        if m > 0:
            differentiate(model, motion.path[row], True)
            _drive(model, motion.by[row], carried, m - width, drive)
            chain(model, sensitivity, drive)
        go(model)
        if mark < len(goal.marks) and j + 1 == goal.marks[mark]:
            read_state(model, state)
            for i in range(STATE):
                error, at = state[i] - goal.references[stage, mark, i], STATE * mark + i
                residuals[at] = goal.weights[i] * (wrap(error) if i == 2 or i == 5 else error)
                cost += residuals[at] * residuals[at]
                for c in range(m):
                    jacobian[at, column + c] = goal.weights[i] * sensitivity[i, c]
            mark += 1
    read_state(model, state)
    return cost
