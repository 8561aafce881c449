"""Estimation: the robots' state and what pushes them, from the poses measured at control instants.

An extended Kalman filter over the state (12,) of ``sensitivity``, a wrench (6,) that drifts slowly, and what is amiss
with the magnets' moments (N + 2,), as shares of their nominal ones. The wrench stands for all else that the model does
not know. Derivatives are those of the motion itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.angles import wrap
from magenv.cholesky import add_product, factorise, solve
from magenv.forecast import STATE, Course
from magenv.kernels import kernel
from magenv.sensitivity import (
    COORDINATES,
    Model,
    believe,
    by_moments,
    chain,
    differentiate,
    go,
    load_state,
    place,
    push,
    read_state,
)

Floats = NDArray[np.float64]
MOMENTS = STATE + COORDINATES
"""Where moments begin in what is estimated: the state, the push, then they."""


class Noise(NamedTuple):
    """Variances that the filter reckons with."""

    measured: Floats
    """(6,) of a measured pose, m^2 and rad^2."""
    drift: Floats
    """(6,) by which the push's grow in a second, N^2/s and (N m)^2/s."""
    unsteady: Floats
    """(6,) by which the rates' grow in a second."""


@kernel
def forecast(
    model: Model, motion: Course, first: int, last: int, noise: Noise, known: Floats, covariance: Floats
) -> None:
    """Carry estimate (20 + N,) and covariance (its square) over the substeps ``first`` to ``last`` of a motion.

    In place. The model's moments are left as they are estimated.
    """
    n = len(known)
    by, drive = np.zeros((STATE, n)), np.zeros((COORDINATES, n))
    for i in range(COORDINATES):
        drive[i, STATE + i] = 1.0
    for i in range(STATE):
        by[i, i] = 1.0
    load_state(model, known)
    push(model, known[STATE:MOMENTS])
    believe(model, known[MOMENTS:])
    for j in range(first, last):
        row = motion.which[j]
        place(model, motion.path[row])
        differentiate(model, motion.path[row], True)
        by_moments(model, motion.path[row], known[MOMENTS:], drive)
        chain(model, by, drive)
        go(model)
    read_state(model, known)
    transition = np.zeros((n, n))
    transition[:STATE] = by
    for i in range(STATE, n):
        transition[i, i] = 1.0
    grown = np.zeros((n, n))
    add_product(transition, covariance, grown)
    covariance[:] = 0.0
    add_product(grown, np.ascontiguousarray(transition.T), covariance)
    seconds = (last - first) * model.substep
    for i in range(COORDINATES):
        covariance[COORDINATES + i, COORDINATES + i] += seconds * noise.unsteady[i]
        covariance[STATE + i, STATE + i] += seconds * noise.drift[i]


@kernel
def correct(poses: Floats, noise: Noise, known: Floats, covariance: Floats) -> float:
    """Correct estimate (20 + N,) and covariance (its square) in place by measured poses (6,).

    Returns the squared innovation over its variance: about 6 where the filter is right of itself.
    """
    n, size = COORDINATES, len(known)
    innovation, matrix, gain = np.empty(n), covariance[:n, :n].copy(), np.empty((size, n))
    for i in range(n):
        difference = poses[i] - known[i]
        innovation[i] = wrap(difference) if i % 3 == 2 else difference
        matrix[i, i] += noise.measured[i]
    if not factorise(matrix):
        return np.inf
    weighted = innovation.copy()
    solve(matrix, weighted)
    surprise = 0.0
    for i in range(n):
        surprise += innovation[i] * weighted[i]
    for k in range(size):
        row = covariance[k, :n].copy()
        solve(matrix, row)
        gain[k] = row
        total = 0.0
        for i in range(n):
            total += gain[k, i] * innovation[i]
        known[k] += total
    # Joseph's form keeps the covariance symmetric and positive
    keep = np.eye(size)
    keep[:, :n] -= gain
    kept = np.zeros((size, size))
    add_product(keep, covariance, kept)
    covariance[:] = 0.0
    add_product(kept, np.ascontiguousarray(keep.T), covariance)
    for k in range(size):
        for q in range(size):
            for i in range(n):
                covariance[k, q] += gain[k, i] * noise.measured[i] * gain[q, i]
    return surprise
