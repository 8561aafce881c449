"""What is not known of a state, grown by a command: a cost by which holds that let errors grow are shunned.

Of the doubt (a root of the state's covariance) the direction that grows most is leant on: the motion from there,
beside the motion itself, tells how it grows, and how that depends on the command, with the derivatives of first order
alone.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.cholesky import add_product
from magenv.forecast import STATE, Course, Goal, roll
from magenv.kernels import kernel
from magenv.sensitivity import Model

Floats = NDArray[np.float64]

_SMALL = 1e-3
"""Weighted error to which the doubt is scaled, so that it grows as in the linearised motion."""
_TURNS = 6
"""Of the power iteration."""


@kernel
def lean_on(by: Floats, weights: Floats, doubt: Floats, lean: Floats) -> float:
    """Write the doubt (12,) that grows most into weighted errors, scaled; return by how much, zero where there is none.

    ``by`` (12, 12) holds the derivatives of the last state by the first, ``doubt`` (12, 12) a root of its covariance,
    ``weights`` (12,) those of errors.
    """
    grown, along, square = np.zeros((STATE, STATE)), np.ones(STATE), 0.0
    add_product(by, doubt, grown)
    for i in range(STATE):
        grown[i] *= weights[i]
    for _ in range(_TURNS):
        there, back = np.zeros(STATE), np.zeros(STATE)
        for i in range(STATE):
            for k in range(STATE):
                there[i] += grown[i, k] * along[k]
        for i in range(STATE):
            for k in range(STATE):
                back[k] += grown[i, k] * there[i]
        square = math.sqrt((back * back).sum())
        if not square > 0.0:
            return 0.0
        along = back / square
    scale = _SMALL / math.sqrt(square)
    lean[:] = 0.0
    for i in range(STATE):
        for k in range(STATE):
            lean[i] += scale * doubt[i, k] * along[k]
    return scale


@kernel
def risk(
    model: Model,
    pushing: Floats,
    motion: Course,
    goal: Goal,
    stage: int,
    start: Floats,
    lean: Floats,
    scale: float,
    sensitivity: Floats,
    residuals: Floats,
    jacobian: Floats,
) -> float:
    """Write what is leant on makes of the last errors below them into the residuals (r,); return its cost.

    ``lean`` (12,) is added to ``start`` (12,), ``scale`` by how much it was scaled; ``pushing`` (6,) acts, N and N m.
    Where ``sensitivity`` (12, 5 N or 0), zero, has columns, the derivatives by the command are written into the last
    columns of ``jacobian`` (r, z).
    """
    rows, width = STATE * len(goal.marks), sensitivity.shape[1]
    errors, by = np.empty(rows), np.empty((rows, width))
    roll(model, start + lean, pushing, motion, goal, stage, sensitivity, errors, by)
    cost, first = 0.0, jacobian.shape[1] - width
    for i in range(STATE):
        last, at = rows - STATE + i, rows + i
        grown, turn = errors[last] - residuals[last], 2.0 * math.pi * goal.weights[i]
        if (i == 2 or i == 5) and abs(grown) > 0.5 * turn:  # one of the two errors was wrapped
            grown -= math.copysign(turn, grown)
        residuals[at] = grown / scale
        cost += residuals[at] * residuals[at]
        for c in range(width):
            jacobian[at, first + c] = (by[last, c] - jacobian[last, first + c]) / scale
    return cost
