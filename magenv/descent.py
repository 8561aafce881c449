"""The arrays of a descent of ``magenv.solver``: what it does not change, where it is, its local model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.kernels import kernel, law
from magenv.poses import POSE_SIZE
from magenv.spheres import POINT_SIZE
from magenv.wrench import WRENCH_SIZE

Floats = NDArray[np.float64]


class Problem(NamedTuple):
    """What a descent does not change."""

    target: Floats
    positions: Floats
    moments: Floats
    frames: Floats
    mutual: Floats
    epm_moment: float
    scale: Floats
    r_min: float
    r_max: float
    gap: float


class State(NamedTuple):
    """A point and what follows from it."""

    points: Floats
    epms: Floats
    wrench: Floats
    error: Floats
    """Scaled, (10,)."""
    gaps: Floats
    slacks: Floats
    """Of all constraints (m,): the radii above r_min, below r_max, then the gaps."""


class Model(NamedTuple):
    """The local model of a descent, and its multipliers."""

    gradients: Floats
    """dU / d (centre, unit moment) (10, 6 N)."""
    jacobian: Floats
    """Scaled, by the step (10, 5 N)."""
    tangents: Floats
    curvature: Floats
    slopes: Floats
    """Of the gaps, by the step (pairs, 5 N)."""
    gradient: Floats
    """Of f (5 N)."""
    hessian: Floats
    diagonal: Floats
    """D of the damping (5 N)."""
    right: Floats
    """Right-hand side of the primal-dual system (5 N)."""
    factor: Floats
    step: Floats
    duals: Floats
    """Multipliers (m,)."""
    changes: Floats
    """Of the slacks by the full step (m,)."""
    weights: Floats
    """Scaled error times scale (10,)."""
    slope: Floats
    work: Floats


@kernel
def new_model(n: int) -> Model:
    """Return an empty model of ``n`` EPMs."""
    size, pairs = POSE_SIZE * n, n * (n - 1) // 2
    return Model(
        np.empty((WRENCH_SIZE, 6 * n)),
        np.empty((WRENCH_SIZE, size)),
        np.empty((n, POSE_SIZE, 3)),
        np.empty((n, 2, 6)),
        np.zeros((pairs, size)),
        np.empty(size),
        np.empty((size, size)),
        np.empty(size),
        np.empty(size),
        np.empty((size, size)),
        np.empty(size),
        np.empty(2 * n + pairs),
        np.empty(2 * n + pairs),
        np.empty(WRENCH_SIZE),
        np.empty(6),
        np.empty((2, 3)),
    )


@kernel
def new_state(n: int) -> State:
    """Return an empty state of ``n`` EPMs."""
    pairs = n * (n - 1) // 2
    return State(
        np.empty((n, POINT_SIZE)),
        np.empty((n, 6)),
        np.empty(WRENCH_SIZE),
        np.empty(WRENCH_SIZE),
        np.empty(pairs),
        np.empty(2 * n + pairs),
    )


@law
def _copy(source: Floats, out: Floats) -> None:
    for i in range(len(out)):
        out[i] = source[i]


@law
def copy_state(source: State, out: State) -> None:
    """Copy all of ``source`` to ``out``."""
    for k in range(len(out.points)):
        _copy(source.points[k], out.points[k])
        _copy(source.epms[k], out.epms[k])
    _copy(source.wrench, out.wrench)
    _copy(source.error, out.error)
    _copy(source.gaps, out.gaps)
    _copy(source.slacks, out.slacks)
