"""The solver's coordinates: each EPM a direction, a radius and a unit moment, moved along tangents of the unit sphere.

A point is a row of seven: direction of the centre (3), radius (m), unit moment (3). A step holds five numbers per EPM:
the direction's turn along two tangents (rad), the change of the radius (m), the moment's turn along two tangents (rad).
Azimuth and elevation would be singular at the poles, and would cost sines in every iteration; the step's map is
rational and its second derivative is that of the exponential map, so that Hessians are exact (Absil, Mahony and
Sepulchre, "Optimization Algorithms on Matrix Manifolds", 2008, sections 4.1 and 5.5).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.kernels import kernel, law
from magenv.poses import POSE_SIZE, pose_to_epm
from magenv.wrench import WRENCH_SIZE

Floats = NDArray[np.float64]

POINT_SIZE = 7


@kernel
def pose_to_points(pose: Floats, points: Floats) -> None:
    """Write the points (N, 7) of a pose vector (5 N)."""
    epm = np.empty(6)
    for k in range(len(points)):
        block = pose[POSE_SIZE * k : POSE_SIZE * k + POSE_SIZE]
        pose_to_epm(block, epm)
        for i in range(3):
            points[k, i], points[k, 4 + i] = epm[i] / block[2], epm[3 + i]
        points[k, 3] = block[2]


@law
def points_to_epms(points: Floats, epms: Floats) -> None:
    """Write centres and unit moments (N, 6) of the points (N, 7)."""
    for k in range(len(points)):
        for i in range(3):
            epms[k, i], epms[k, 3 + i] = points[k, 3] * points[k, i], points[k, 4 + i]


@law
def _basis(unit: Floats, rows: Floats) -> None:
    """Write two unit tangents at ``unit`` (Duff et al., "Building an orthonormal basis, revisited", 2017)."""
    x, y, z = unit[0], unit[1], unit[2]
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    rows[0, 0], rows[0, 1], rows[0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    rows[1, 0], rows[1, 1], rows[1, 2] = b, sign + y * y * a, -y


@law
def tangents_at(points: Floats, tangents: Floats) -> None:
    """Write into ``tangents`` (N, 5, 3) how centre (rows 0 to 2) and unit moment (rows 3, 4) change with each step."""
    for k in range(len(points)):
        _basis(points[k, 0:3], tangents[k, 0:2])
        _basis(points[k, 4:7], tangents[k, 3:5])
        for i in range(3):
            tangents[k, 0, i] *= points[k, 3]
            tangents[k, 1, i] *= points[k, 3]
            tangents[k, 2, i] = points[k, i]


@law
def _turn(unit: Floats, tangents: Floats, a: float, b: float, size: float, out: Floats) -> None:
    """Write ``unit`` turned by (a, b) along tangents of the given size, by 2 atan(|(a, b)| / 2)."""
    q = 0.25 * (a * a + b * b)
    along, across = (1.0 - q) / (1.0 + q), 1.0 / ((1.0 + q) * size)
    for i in range(3):
        out[i] = along * unit[i] + across * (a * tangents[0, i] + b * tangents[1, i])


@law
def move(points: Floats, tangents: Floats, step: Floats, out: Floats) -> None:
    """Write the points (N, 7) that a step (5 N) leads to."""
    for k in range(len(points)):
        at = POSE_SIZE * k
        _turn(points[k, 0:3], tangents[k, 0:2], step[at], step[at + 1], points[k, 3], out[k, 0:3])
        out[k, 3] = points[k, 3] + step[at + 2]
        _turn(points[k, 4:7], tangents[k, 3:5], step[at + 3], step[at + 4], 1.0, out[k, 4:7])


@law
def chain(gradients: Floats, tangents: Floats, scale: Floats, jacobian: Floats) -> None:
    """Write the scaled dU / dstep (10, 5 N) of dU / d (centre, unit moment) (10, 6 N)."""
    for k in range(len(tangents)):
        for i in range(WRENCH_SIZE):
            for q in range(POSE_SIZE):
                at = 6 * k + (0 if q < 3 else 3)
                t = tangents[k, q]
                total = gradients[i, at] * t[0] + gradients[i, at + 1] * t[1] + gradients[i, at + 2] * t[2]
                jacobian[i, POSE_SIZE * k + q] = scale[i] * total


@law
def _form(s: Floats, a: Floats, b: Floats) -> float:
    """Return a . s b with s = (xx, xy, xz, yy, yz, zz)."""
    product: float = (
        a[0] * (s[0] * b[0] + s[1] * b[1] + s[2] * b[2])
        + a[1] * (s[1] * b[0] + s[3] * b[1] + s[4] * b[2])
        + a[2] * (s[2] * b[0] + s[4] * b[1] + s[5] * b[2])
    )
    return product


@law
def _dot(a: Floats, b: Floats) -> float:
    product: float = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


@law
def _add_bend(points: Floats, tangents: Floats, k: int, slope: Floats, hessian: Floats) -> None:
    """Add what the bending of EPM ``k``'s path adds to second derivatives of a function of this slope (6).

    d^2 unit / dstep^2 = -unit; the centre is radius times unit, so that turn and radius mix as well.
    """
    at, centre, moment = POSE_SIZE * k, slope[0:3], slope[3:6]
    radial, along = points[k, 3] * _dot(points[k, 0:3], centre), _dot(points[k, 4:7], moment)
    for q in range(2):
        mixed = _dot(tangents[k, q], centre) / points[k, 3]
        hessian[at + q, at + q] -= radial
        hessian[at + q, at + 2] += mixed
        hessian[at + 2, at + q] += mixed
        hessian[at + 3 + q, at + 3 + q] -= along


@kernel
def add_curvature(
    points: Floats,
    tangents: Floats,
    gradients: Floats,
    weights: Floats,
    curvature: Floats,
    slope: Floats,
    hessian: Floats,
) -> None:
    """Add the second derivatives of ``weights`` . U by the step to ``hessian`` (5 N, 5 N).

    ``gradients`` (10, 6 N) and ``curvature`` (N, 2, 6) are those of ``magenv.wrench``; ``slope`` (6,) is scratch.
    """
    for k in range(len(points)):
        at, t = POSE_SIZE * k, tangents[k]
        for p in range(3):
            for q in range(3):
                hessian[at + p, at + q] += _form(curvature[k, 0], t[p], t[q])
            for q in range(3, 5):
                mixed = _form(curvature[k, 1], t[p], t[q])
                hessian[at + p, at + q] += mixed
                hessian[at + q, at + p] += mixed
        for j in range(6):
            slope[j] = 0.0
            for i in range(WRENCH_SIZE):
                slope[j] += weights[i] * gradients[i, 6 * k + j]
        _add_bend(points, tangents, k, slope, hessian)


@law
def gap_values(epms: Floats, gap: float, values: Floats) -> float:
    """Write (|p_i - p_j|^2 - gap^2) / (2 gap) in m for every pair of centres; return the least."""
    least, pair = math.inf, 0
    for i in range(len(epms)):
        for j in range(i + 1, len(epms)):
            x, y, z = epms[i, 0] - epms[j, 0], epms[i, 1] - epms[j, 1], epms[i, 2] - epms[j, 2]
            values[pair] = (x * x + y * y + z * z - gap * gap) / (2.0 * gap)
            least = min(least, values[pair])
            pair += 1
    return least


@law
def gap_gradients(epms: Floats, tangents: Floats, gap: float, gradients: Floats) -> None:
    """Write the derivatives of ``gap_values`` by the step into ``gradients`` (pairs, 5 N), elsewhere 0."""
    pair = 0
    for i in range(len(epms)):
        for j in range(i + 1, len(epms)):
            x, y, z = (epms[i, 0] - epms[j, 0]) / gap, (epms[i, 1] - epms[j, 1]) / gap, (epms[i, 2] - epms[j, 2]) / gap
            for q in range(3):
                a, b = tangents[i, q], tangents[j, q]
                gradients[pair, POSE_SIZE * i + q] = x * a[0] + y * a[1] + z * a[2]
                gradients[pair, POSE_SIZE * j + q] = -x * b[0] - y * b[1] - z * b[2]
            pair += 1


@kernel
def subtract_gap_curvature(
    points: Floats, epms: Floats, tangents: Floats, gap: float, weights: Floats, slope: Floats, hessian: Floats
) -> None:
    """Take the second derivatives of ``weights`` (pairs) . ``gap_values`` by the step from ``hessian`` (5 N, 5 N).

    ``slope`` (6,) is scratch.
    """
    slope[:] = 0.0
    pair = 0
    for i in range(len(points)):
        for j in range(i + 1, len(points)):
            f = -weights[pair] / gap
            for p in range(3):
                for q in range(3):
                    hessian[POSE_SIZE * i + p, POSE_SIZE * i + q] += f * _dot(tangents[i, p], tangents[i, q])
                    hessian[POSE_SIZE * j + p, POSE_SIZE * j + q] += f * _dot(tangents[j, p], tangents[j, q])
                    across = f * _dot(tangents[i, p], tangents[j, q])
                    hessian[POSE_SIZE * i + p, POSE_SIZE * j + q] -= across
                    hessian[POSE_SIZE * j + q, POSE_SIZE * i + p] -= across
            for k, sign in ((i, f), (j, -f)):
                for axis in range(3):
                    slope[axis] = sign * (epms[i, axis] - epms[j, axis])
                _add_bend(points, tangents, k, slope, hessian)
            pair += 1
