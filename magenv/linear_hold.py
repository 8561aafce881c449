"""A hold by its linear motion: M q'' + D q' = F + K q about where the robots are, of constant wrench F and stiffness K.

Some microseconds, where integrating the plant takes a hundred; and how much small deviations grow in it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.kernels import kernel
from magenv.params import Body
from magenv.sensitivity import COORDINATES

Floats = NDArray[np.float64]

_SUBSTEP_S = 0.01
"""Decay by drag is exact in each."""


class LinearHold(NamedTuple):
    """What is known of a hold beforehand."""

    drag: Floats
    """(6,) N s/m and N m s/rad, of x, y, heading of both robots."""
    decay: Floats
    """(6,) share of the rates left after a substep."""
    root: Floats
    """(6,) square roots of the inverse drags."""
    substep: float
    """s."""
    substeps: int

    @classmethod
    def of(cls, body: Body, period_s: float) -> LinearHold:
        """Return holds of ``period_s`` (s) of robots with drag."""
        substeps = max(1, math.ceil(period_s / _SUBSTEP_S - 1e-9))
        substep = period_s / substeps
        drag = np.tile([body.drag_linear_nspm, body.drag_linear_nspm, body.drag_rotational_nmsprad], 2)
        inertia = np.tile([body.mass_kg, body.mass_kg, body.inertia_kgm2], 2)
        return cls(drag, np.exp(-drag * substep / inertia), 1.0 / np.sqrt(drag), substep, substeps)


@kernel
def _multiply(a: Floats, b: Floats, out: Floats) -> None:
    for i in range(COORDINATES):
        a0, a1, a2, a3, a4, a5 = a[i, 0], a[i, 1], a[i, 2], a[i, 3], a[i, 4], a[i, 5]
        for j in range(COORDINATES):  # written out, so that it is vectorised
            first, second = a0 * b[0, j] + a1 * b[1, j] + a2 * b[2, j], a3 * b[3, j] + a4 * b[4, j] + a5 * b[5, j]
            out[i, j] = first + second


@kernel
def log_growth(a: Floats, period: float, exponential: Floats, scratch: Floats) -> float:
    """Return the logarithm of the norm of exp(a period), for a symmetric ``a`` (6, 6) in 1/s; both others are written.

    By its Taylor series over a small part of the period, and squaring.
    """
    norm = 0.0
    for i in range(COORDINATES):
        row = 0.0
        for j in range(COORDINATES):
            row += abs(a[i, j])
        norm = max(norm, row)
    halvings, part = 0, period
    while norm * part > 0.5 and halvings < 60:
        part *= 0.5
        halvings += 1
    exponential[:] = 0.0
    for order in range(6, 0, -1):
        for i in range(COORDINATES):
            exponential[i, i] += 1.0
        _multiply(a, exponential, scratch)
        for i in range(COORDINATES):
            for j in range(COORDINATES):
                exponential[i, j] = part / order * scratch[i, j]
    for i in range(COORDINATES):
        exponential[i, i] += 1.0
    for _ in range(halvings):
        _multiply(exponential, exponential, scratch)
        exponential[:] = scratch
    square = 0.0
    for i in range(COORDINATES):
        for j in range(COORDINATES):
            square += exponential[i, j] ** 2
    return 0.5 * math.log(square)


@kernel
def foresee(hold: LinearHold, substeps: int, force: Floats, k: Floats, rates: Floats, x: Floats, v: Floats) -> None:
    """Write how far the robots come in so many substeps, ``x`` (6,), and their rates then, ``v`` (6,).

    Of ``rates`` (6,) at first, ``force`` (6,) N and N m, and stiffness ``k`` (6, 6), N and N m per m and rad.
    """
    half = 0.5 * hold.substep
    for i in range(COORDINATES):
        x[i], v[i] = 0.0, rates[i]
    for _ in range(substeps):
        for i in range(COORDINATES):
            x[i] += half * v[i]
        for i in range(COORDINATES):
            first = k[i, 0] * x[0] + k[i, 1] * x[1] + k[i, 2] * x[2]
            second = k[i, 3] * x[3] + k[i, 4] * x[4] + k[i, 5] * x[5]
            v[i] = hold.decay[i] * v[i] + (1.0 - hold.decay[i]) / hold.drag[i] * (force[i] + first + second)
        for i in range(COORDINATES):
            x[i] += half * v[i]


@kernel
def growth(hold: LinearHold, k: Floats, scaled: Floats, exponential: Floats, scratch: Floats) -> float:
    """Return the logarithm of the norm of exp(D^-1/2 K D^-1/2 T): how deviations of robots without inertia grow.

    ``k`` (6, 6) is symmetric; the other matrices are room to compute in.
    """
    for i in range(COORDINATES):
        for j in range(COORDINATES):
            scaled[i, j] = hold.root[i] * k[i, j] * hold.root[j]
    return log_growth(scaled, hold.substep * hold.substeps, exponential, scratch)
