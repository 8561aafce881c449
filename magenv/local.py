"""Local coordinates of an EPM, five without a singularity: two turns of its centre, the radius, two of its moment."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.arithmetic import dot3
from magenv.kernels import kernel
from magenv.poses import EPM_SIZE, POSE_SIZE, tangent

Floats = NDArray[np.float64]


@kernel
def local_basis(epm: Floats, basis: Floats) -> None:
    """Write the derivatives (6, 5) of an EPM (centre, unit moment) by its local coordinates: rad, rad, m, rad, rad."""
    basis[:] = 0.0
    for at, column in ((0, 0), (3, 3)):
        nx, ny, nz = epm[at], epm[at + 1], epm[at + 2]
        length = math.sqrt(dot3(nx, ny, nz, nx, ny, nz))
        nx, ny, nz = nx / length, ny / length, nz / length
        tx, ty, tz = tangent(epm[at : at + 3])
        basis[at, column], basis[at + 1, column], basis[at + 2, column] = length * tx, length * ty, length * tz
        basis[at, column + 1] = length * (ny * tz - nz * ty)
        basis[at + 1, column + 1] = length * (nz * tx - nx * tz)
        basis[at + 2, column + 1] = length * (nx * ty - ny * tx)
        if at == 0:
            basis[0, 2], basis[1, 2], basis[2, 2] = nx, ny, nz


@kernel
def shift(epm: Floats, basis: Floats, step: Floats, r_min: float, r_max: float) -> None:
    """Move an EPM (6,) by a step (5,) in its local coordinates, of basis (6, 5), its radius within the bounds (m)."""
    radius = math.sqrt(dot3(epm[0], epm[1], epm[2], epm[0], epm[1], epm[2]))
    out = min(max(radius + step[2], r_min), r_max)
    for at, column, length in ((0, 0, out), (3, 3, 1.0)):
        for i in range(3):
            epm[at + i] += basis[at + i, column] * step[column] + basis[at + i, column + 1] * step[column + 1]
        scale = length / math.sqrt(dot3(epm[at], epm[at + 1], epm[at + 2], epm[at], epm[at + 1], epm[at + 2]))
        for i in range(3):
            epm[at + i] *= scale


@kernel
def seen_from(epm: Floats, other: Floats, basis: Floats, out: Floats) -> None:
    """Write the local coordinates (5,) of an EPM (6,) near another, whose basis (6, 5) has columns at right angles."""
    for c in range(POSE_SIZE):
        along, square = 0.0, 0.0
        for a in range(EPM_SIZE):
            along += basis[a, c] * (epm[a] - other[a])
            square += basis[a, c] * basis[a, c]
        out[c] = along / square
