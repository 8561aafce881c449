"""The magnets of a lane: how EPMs stand in it, and what they and the robots do to the robots in the plane.

EPMs are dipoles or cylinders. Which, is a constant of the machine code: their size, or None, is a type to numba.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.angles import sincos
from magenv.arithmetic import cross2, dot2, dot3, fma
from magenv.cylinder import cylinder_parts, cylinder_strength
from magenv.dipole import SOURCE, dipole_parts
from magenv.kernels import law
from magenv.lanes import EPMS, MOMENT1, MOMENT2
from magenv.poses import EPM_SIZE

Floats = NDArray[np.float64]

Size = tuple[float, float] | None
"""Diameter and length (m) of EPMs that are cylinders; None of dipoles."""

PlanarSums = tuple[float, float, float, float, float]
"""What sources do to a robot in the plane: B_x, B_y (T), force per moment along it (T/m), F_x, F_y of the rest (N)."""


@law
def add_source(
    sums: PlanarSums,
    sx: float,
    sy: float,
    s_height: float,
    nx: float,
    ny: float,
    rx: float,
    ry: float,
    height2: float,
) -> PlanarSums:
    """Return the sums with a source's share added, for a moment n in the plane at the offset (rx, ry) in the plane.

    (sx, sy) is the source's strength (see ``dipole.SOURCE``) in the plane. ``height2`` is the square of the source's
    height and ``s_height`` minus the height times the strength's z component: all that enters of what is out of plane.
    """
    bx, by, along, fx, fy = sums
    r2, s_r, n_r = fma(rx, rx, fma(ry, ry, height2)), fma(sx, rx, fma(sy, ry, s_height)), dot2(nx, ny, rx, ry)
    k, on_n, on_s, on_r = dipole_parts(r2, s_r, n_r, dot2(sx, sy, nx, ny))
    return (
        fma(on_n, rx, fma(k, sx, bx)),
        fma(on_n, ry, fma(k, sy, by)),
        along + on_n,
        fma(on_r, rx, fma(on_s, sx, fx)),
        fma(on_r, ry, fma(on_s, sy, fy)),
    )


@law
def add_cylinder(
    sums: PlanarSums,
    diameter: float,
    length: float,
    mx: float,
    my: float,
    mz: float,
    nx: float,
    ny: float,
    rx: float,
    ry: float,
    rz: float,
) -> PlanarSums:
    """Return the sums with a cylinder's share added: of the moment m, on the moment n in the plane at the offset r."""
    bx, by, along, fx, fy = sums
    m2 = dot3(mx, my, mz, mx, my, mz)
    inverse = 1.0 / math.sqrt(m2)
    ux, uy = inverse * mx, inverse * my
    z = inverse * dot3(mx, my, mz, rx, ry, rz)
    px, py, pz = fma(-z, ux, rx), fma(-z, uy, ry), fma(-z, inverse * mz, rz)
    strength = cylinder_strength(inverse * m2, diameter, length)
    q, on_u, w, s, g = cylinder_parts(strength, 0.5 * diameter, 0.5 * length, z, dot3(px, py, pz, px, py, pz))
    p_n, u_n = dot2(px, py, nx, ny), dot2(ux, uy, nx, ny)
    f_p, f_u = dot2(w, s, p_n, u_n), dot2(s, g, p_n, u_n)
    return (
        fma(q, px, fma(on_u, ux, bx)),
        fma(q, py, fma(on_u, uy, by)),
        along + q,
        fma(f_p, px, fma(f_u, ux, fx)),
        fma(f_p, py, fma(f_u, uy, fy)),
    )


@law
def add_epm(
    sums: PlanarSums, lanes: Floats, i: int, k: int, size: Size, nx: float, ny: float, x: float, y: float
) -> PlanarSums:
    """Return the sums with the share of EPM ``k`` of lane ``i`` added, for a moment n at (x, y) in the plane."""
    e = EPMS + EPM_SIZE * k
    rx, ry, z = x - lanes[e, i], y - lanes[e + 1, i], lanes[e + 2, i]
    ax, ay, az = lanes[e + 3, i], lanes[e + 4, i], lanes[e + 5, i]
    if size is None:
        return add_source(sums, ax, ay, az, nx, ny, rx, ry, z)
    diameter, length = size
    return add_cylinder(sums, diameter, length, ax, ay, az, nx, ny, rx, ry, -z)


@law
def planar_wrench(sums: PlanarSums, nx: float, ny: float) -> tuple[float, float, float]:
    """Return F_x, F_y (N) and tau_z (N m) of the sources summed up, on the moment n in the plane."""
    bx, by, along, fx, fy = sums
    return fma(along, nx, fx), fma(along, ny, fy), cross2(nx, ny, bx, by)


@law
def robots_wrench(
    lanes: Floats,
    i: int,
    n_epm: int,
    size: Size,
    x1: float,
    y1: float,
    heading1: float,
    x2: float,
    y2: float,
    heading2: float,
) -> tuple[float, float, float, float, float, float]:
    """Return F_x, F_y (N) and tau_z (N m) on both robots of lane ``i`` at these poses, global frame.

    Out-of-plane components are borne by the plane. Between the robots the wrench is computed once: their forces are
    opposite, and their torques and the force's moment add up to nothing.
    """
    s, c = sincos(heading1)
    m1x, m1y = lanes[MOMENT1, i] * c, lanes[MOMENT1, i] * s
    s, c = sincos(heading2)
    m2x, m2y = lanes[MOMENT2, i] * c, lanes[MOMENT2, i] * s
    none = (0.0, 0.0, 0.0, 0.0, 0.0)
    dx, dy = x2 - x1, y2 - y1
    mutual = add_source(none, SOURCE * m1x, SOURCE * m1y, 0.0, m2x, m2y, dx, dy, 0.0)
    fx, fy, turn = planar_wrench(mutual, m2x, m2y)
    on1, on2 = none, none
    for k in range(n_epm):
        on1 = add_epm(on1, lanes, i, k, size, m1x, m1y, x1, y1)
        on2 = add_epm(on2, lanes, i, k, size, m2x, m2y, x2, y2)
    f1x, f1y, tz1 = planar_wrench(on1, m1x, m1y)
    f2x, f2y, tz2 = planar_wrench(on2, m2x, m2y)
    return f1x - fx, f1y - fy, tz1 - (cross2(dx, dy, fx, fy) + turn), f2x + fx, f2y + fy, tz2 + turn


@law
def place_epm(
    lanes: Floats,
    i: int,
    k: int,
    size: Size,
    moment: float,
    x: float,
    y: float,
    z: float,
    ux: float,
    uy: float,
    uz: float,
) -> None:
    """Put EPM ``k``, its moment (A m^2) along the unit vector u, into lane ``i``: what ``add_epm`` needs of it."""
    e = EPMS + EPM_SIZE * k
    lanes[e, i], lanes[e + 1, i] = x, y
    if size is None:
        strength = SOURCE * moment
        lanes[e + 2, i] = z * z
        lanes[e + 3, i], lanes[e + 4, i], lanes[e + 5, i] = strength * ux, strength * uy, -strength * uz * z
    else:
        lanes[e + 2, i] = z
        lanes[e + 3, i], lanes[e + 4, i], lanes[e + 5, i] = moment * ux, moment * uy, moment * uz


@law
def copy_epms(source: Floats, row: int, target: Floats, to: int) -> None:
    """Write the EPMs of a row (n, N, 6) into a row of ``target``; written out, as slices are functions to numba."""
    for k in range(source.shape[1]):
        for j in range(EPM_SIZE):
            target[to, k, j] = source[row, k, j]


@law
def place_all(lanes: Floats, i: int, size: Size, moments: Floats, epms: Floats, row: int) -> None:
    """Put the EPMs (n, N, 6) of a row, of moments (n, N) in A m^2, into lane ``i``."""
    for k in range(epms.shape[1]):
        x, y, z = epms[row, k, 0], epms[row, k, 1], epms[row, k, 2]
        place_epm(lanes, i, k, size, moments[row, k], x, y, z, epms[row, k, 3], epms[row, k, 4], epms[row, k, 5])
