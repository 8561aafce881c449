"""The uniformly, axially magnetised cylinder of finite size: field and gradient in closed form.

It is the magnet that ``dipole`` stands for. All laws use r = point - centre and the total moment m, which lies along
the axis; the magnetisation is m over the volume, as in ``params.Magnet``. Far off the field is the dipole's.

In the magnet's frame, with z along the axis, rho across it, radius a and length 2 b, everything is the difference of
what its two ends make. B_rho is that of a solenoid (Derby and Olbert; Caciagli et al.); B_z is the solid angle under
which the ends are seen, as of two discs of magnetic charge (Paxton); and dB/dz is the field of two loops of current
round the ends (Smythe; Simpson et al.). The rest follows of div B = 0 and curl B = 0.

Outside the magnet field and gradient are off, relative to their sizes, by 2e-13 at most from 1 % of the diameter from
the rims to 5 diameters, by 1e-10 from 0.1 % and up to 5000 diameters; on the axis they are as exact as beside it. Only
outside is B promised. Inside comes mu0 H, which is B less the magnet's polarisation, with B's own gradient; on the
mantle B as outside, on the flat ends the one or the other, on the rims infinity or NaN.

References
----------
N. Derby and S. Olbert, "Cylindrical magnets and ideal solenoids", Am. J. Phys. 78, 229 (2010); A. Caciagli et al.,
"Exact expression for the magnetic field of a finite cylinder with arbitrary uniform magnetization", J. Magn. Magn.
Mater. 456, 423 (2018); F. Paxton, "Solid angle calculation for a circular disk", Rev. Sci. Instrum. 30, 254 (1959);
W. R. Smythe, "Static and dynamic electricity" (1968); J. Simpson et al., "Simple analytic expressions for the magnetic
field of a circular current loop", NASA, NTRS 20010038494 (2001); NIST, "Digital library of mathematical functions"
(DLMF), sections 19.7(iii) and 19.8(i).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.arithmetic import dot2, dot3, fma
from magenv.dipole import require_vectors
from magenv.kernels import kernel, law
from magenv.params import MU_0, Magnet, common_shape

Floats = NDArray[np.float64]

_TINY = 1e-300
"""Less than any square that counts: what a square that may be zero is divided by stays above it."""

Descent = tuple[float, float, float, float, float, float, float, float]
Parts = tuple[float, float, float, float, float]


@law
def _step(state: Descent, m: float, weight: float) -> Descent:
    """Return the next step of the arithmetic-geometric mean and of the sums that grow with it.

    The state is (a, g, p, t, sum t, tau, product, excess). a and g tend to their mean M, with K(m) = pi / (2 M);
    c = m t is half the difference of the last a and g, tau = sum 2^n t_n^2, and p and the last two belong to the
    integral of the third kind (DLMF, section 19.8(i)). One division serves for two.
    """
    a, g, p, t, sum_t, tau, product, excess = state
    square, p2 = a * g, p * p
    both, mean = p2 + square, 0.5 * (a + g)
    inverse = 1.0 / (both * mean)
    t = 0.25 * m * t * t * (inverse * both)
    product *= 0.5 * (p2 - square) * (inverse * mean)
    return mean, math.sqrt(square), 0.5 * both / p, t, sum_t + t, fma(weight * t, t, tau), product, excess + product


@law
def _end(a: float, rho: float, z: float) -> tuple[float, float, float, float]:
    """Return what the disc of radius a makes at the distances rho from its axis and z above its plane.

    (omega, q, h, s): the solid angle with the sign of z; B_rho / rho of the half-infinite solenoid below it, in 1/m;
    B_z and B_rho / rho of the loop round it, in 1/m and 1/m^2: all per mu0 I / pi, with I the current of the loop and
    per length of the solenoid. Infinite or NaN on the rim.

    Nothing is divided by rho and, other than in the common formulas, hardly a difference of nearly equal numbers is
    left: K, E and Pi come as the sums of the arithmetic-geometric mean, whose leading terms are taken out by hand.
    """
    outer = a + rho
    inverse_outer = 1.0 / outer
    inverse_beta = 1.0 / math.sqrt(fma(outer, outer, z * z))
    inverse_beta2 = inverse_beta * inverse_beta
    kc2 = fma(a - rho, a - rho, z * z) * inverse_beta2  # = 1 - m
    m, kc = 4.0 * a * rho * inverse_beta2, math.sqrt(kc2)
    gamma, delta = (a - rho) * inverse_outer, z * inverse_beta
    height, sign = abs(delta), 1.0 if z >= 0.0 else -1.0

    # Omega needs Pi(n, m) of 1 - n = gamma^2, whose sums converge slowly where gamma is far below kc: round rho = a.
    # As good is Pi(m / n, m) of 1 - m / n = delta^2 (DLMF, section 19.7(iii)), slow round z = 0; on the rim alone both
    # are. Far off digits cancel, a^2 z^2 / rho^4 of them with the one and rho^2 / a^2 with the other: alike at
    # rho^3 = a^2 |z|.
    by_gamma = (abs(gamma) > 4.0 * height) | ((rho * rho * rho > a * a * abs(z)) & (2.0 * abs(gamma) > height))
    p = abs(gamma) if by_gamma else height
    inverse_p = 1.0 / p
    p2 = p * p
    both, difference = kc + p2, kc - p2
    inverse_both = 1.0 / both

    # Steps of a fixed number and no branch let LLVM vectorise loops over points. The first step is done by hand; with
    # five more all sums have converged from 1 % of the diameter from the rims, to 1e-10 from 0.1 %.
    t = 0.5 / (1.0 + kc)
    state = (0.5 * (1.0 + kc), math.sqrt(kc), 0.5 * both * inverse_p, t, t, 2.0 * t * t, 1.0, 0.0)
    state = _step(state, m, 4.0)
    state = _step(state, m, 8.0)
    state = _step(state, m, 16.0)
    state = _step(state, m, 32.0)
    mean, _, _, _, sum_t, tau, _, excess = _step(state, m, 64.0)
    complete_k = 0.5 * math.pi / mean

    # Omega = 2 pi (where rho < a) - 2 delta (K + gamma Pi(n, m)) = pi - 2 delta (K + gamma (K - Pi(m / n, m))), z > 0
    one = 2.0 * a * inverse_outer  # 1 + gamma
    first = fma(one * one, one, -2.0 * m * t * fma(3.0, gamma, 1.0)) - (1.0 - gamma) * difference * excess
    first = (-0.5 if gamma >= 0.0 else 0.5) * delta * one * inverse_p * inverse_both * first
    v = outer * outer * inverse_beta2  # 1 - delta^2
    third = 1.0 - 0.5 * difference * inverse_both * (1.0 + excess)
    second = fma(2.0, v / (1.0 + height) - m * sum_t, gamma * v * inverse_p * third)
    whole = sign * (2.0 * math.pi) if (rho < a) & by_gamma else 0.0
    omega = fma(complete_k, first if by_gamma else sign * second, whole)

    # (2 - m) K - 2 E = K sigma with sigma = m^2 tau
    sigma = m * m * tau
    a_beta = a * inverse_beta
    disc = 4.0 * a_beta * a_beta * inverse_beta * complete_k
    loop = complete_k * inverse_beta / kc2
    q = disc * tau
    h = loop * fma(a_beta, a_beta - 0.5 * outer * inverse_beta * (m + sigma), 0.25 * sigma)
    s = 2.0 * loop * a_beta * a_beta * delta * inverse_beta * fma(m - 2.0, tau, 1.0)
    return omega, q, h, s


@law
def cylinder_parts(strength: float, radius: float, half: float, z: float, rho2: float) -> Parts:
    """Return what a cylinder makes at the height z and the square rho2 of the distance from its axis.

    (q, along, w, s, g) of B = q rho + along u and G n = q n + (w (rho.n) + s (u.n)) rho + (s (rho.n) + g (u.n)) u, with
    the unit vector u along the moment, the vector rho = r - z u and G the gradient, symmetric. ``strength`` is mu0 over
    pi times the magnetisation (T), see ``cylinder_strength``; ``half`` is half the length.
    """
    rho = math.sqrt(rho2)
    omega_up, q_up, h_up, s_up = _end(radius, rho, z - half)
    omega_low, q_low, h_low, s_low = _end(radius, rho, z + half)
    q, along = strength * (q_up - q_low), 0.25 * strength * (omega_up - omega_low)
    g_zz, s = strength * (h_low - h_up), strength * (s_low - s_up)
    # w rho^2 = dB_rho / drho - q with dB_rho / drho = -q - g_zz. On the axis both are zero, and zero multiplies w.
    w = fma(-2.0, q, -g_zz) / (rho2 + _TINY)
    return q, along, w, s, g_zz - q


@law
def cylinder_strength(moment: float, diameter: float, length: float) -> float:
    """Return mu0 / pi times the magnetisation (T): moment over volume."""
    return (MU_0 / math.pi) * moment / ((math.pi / 4.0) * diameter * diameter * length)


@law
def cylinder_source(
    mx: float, my: float, mz: float, diameter: float, length: float, rx: float, ry: float, rz: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return ``cylinder_field`` and ``cylinder_gradient`` together, their elliptic integrals evaluated once."""
    m2 = dot3(mx, my, mz, mx, my, mz)
    inverse = 1.0 / math.sqrt(m2 if m2 > _TINY else _TINY)  # no moment, no field
    ux, uy, uz = inverse * mx, inverse * my, inverse * mz
    z = dot3(ux, uy, uz, rx, ry, rz)
    px, py, pz = fma(-z, ux, rx), fma(-z, uy, ry), fma(-z, uz, rz)
    strength = cylinder_strength(inverse * m2, diameter, length)
    q, along, w, s, g = cylinder_parts(strength, 0.5 * diameter, 0.5 * length, z, dot3(px, py, pz, px, py, pz))
    # G = q I + rho v^T + u t^T with v = w rho + s u, t = s rho + g u
    vx, vy, vz = dot2(w, s, px, ux), dot2(w, s, py, uy), dot2(w, s, pz, uz)
    tx, ty, tz = dot2(s, g, px, ux), dot2(s, g, py, uy), dot2(s, g, pz, uz)
    return (
        dot2(q, along, px, ux),
        dot2(q, along, py, uy),
        dot2(q, along, pz, uz),
        q + dot2(px, ux, vx, tx),
        dot2(px, ux, vy, ty),
        dot2(px, ux, vz, tz),
        q + dot2(py, uy, vy, ty),
        dot2(py, uy, vz, tz),
        q + dot2(pz, uz, vz, tz),
    )


@law
def cylinder_field(
    mx: float, my: float, mz: float, diameter: float, length: float, rx: float, ry: float, rz: float
) -> tuple[float, float, float]:
    """Return B (T) of a cylinder of diameter and length (m) and of the moment m (A m^2) at r = point - centre (m).

    B = M mu0 / pi (rho (q- - q+) + u (omega- - omega+) / 4) with M the magnetisation, - the end at z = length / 2.
    """
    bx, by, bz, _, _, _, _, _, _ = cylinder_source(mx, my, mz, diameter, length, rx, ry, rz)
    return bx, by, bz


@law
def cylinder_gradient(
    mx: float, my: float, mz: float, diameter: float, length: float, rx: float, ry: float, rz: float
) -> tuple[float, float, float, float, float, float]:
    """Return the gradient's (xx, xy, xz, yy, yz, zz) in T/m of a cylinder: symmetric, traceless.

    dB_z/dz and dB_z/drho = dB_rho/dz are those of the loops round its ends, dB_rho/drho = -B_rho/rho - dB_z/dz.
    """
    _, _, _, xx, xy, xz, yy, yz, zz = cylinder_source(mx, my, mz, diameter, length, rx, ry, rz)
    return xx, xy, xz, yy, yz, zz


@kernel
def _columns(columns: Floats, diameter: float, length: float) -> None:
    """Write field and gradient into rows 9 to 17 of (18, n), of the moments, centres and points in rows 0 to 8.

    Numbers of one kind stand side by side, so that LLVM vectorises the loop.
    """
    c = columns
    for i in range(c.shape[1]):
        rx, ry, rz = c[6, i] - c[3, i], c[7, i] - c[4, i], c[8, i] - c[5, i]
        bx, by, bz, xx, xy, xz, yy, yz, zz = cylinder_source(c[0, i], c[1, i], c[2, i], diameter, length, rx, ry, rz)
        c[9, i], c[10, i], c[11, i] = bx, by, bz
        c[12, i], c[13, i], c[14, i], c[15, i], c[16, i], c[17, i] = xx, xy, xz, yy, yz, zz


_FIELD, _GRADIENT = [9, 10, 11], [12, 13, 14, 13, 15, 16, 14, 16, 17]
"""Where ``_columns`` writes the components, the gradient's row by row."""


def field_and_gradient(
    moment: ArrayLike, diameter_m: float, length_m: float, centre: ArrayLike, point: ArrayLike
) -> tuple[Floats, Floats]:
    """Flux density of a uniformly, axially magnetised cylinder and its spatial derivative.

    Parameters
    ----------
    moment : array_like, shape (..., 3)
        Magnetic moment in A m^2, along the axis.
    diameter_m, length_m : float
        Size of the cylinder in m, the same for all.
    centre, point : array_like, shape (..., 3)
        Position of the cylinder's centre and of the point in m. They and the moment broadcast.

    Returns
    -------
    field : ndarray, shape (..., 3)
        B in T outside the magnet; see the module for what comes out elsewhere.
    gradient : ndarray, shape (..., 3, 3)
        ``[i, j]`` = dB_i/dp_j in T/m, symmetric and traceless.

    Raises
    ------
    ValueError
        If a last axis is not 3 long, leading axes do not broadcast, or a size is not a positive, finite number.
    """
    Magnet(diameter_m=diameter_m, length_m=length_m)  # tells what is wrong with a size
    arrays = require_vectors(moment=moment, centre=centre, point=point)
    shape = common_shape(**{name: array.shape for name, array in arrays.items()})
    columns = np.empty((18, math.prod(shape) // 3))
    for i, array in enumerate(arrays.values()):
        columns[3 * i : 3 * i + 3] = np.broadcast_to(array, shape).reshape(-1, 3).T
    _columns(columns, float(diameter_m), float(length_m))
    return columns[_FIELD].T.reshape(shape), columns[_GRADIENT].T.reshape((*shape, 3))


def field(moment: ArrayLike, diameter_m: float, length_m: float, centre: ArrayLike, point: ArrayLike) -> Floats:
    """Magnetic flux density (..., 3) in T of a cylinder: the first of `field_and_gradient`, in the same time."""
    return field_and_gradient(moment, diameter_m, length_m, centre, point)[0]


def gradient(moment: ArrayLike, diameter_m: float, length_m: float, centre: ArrayLike, point: ArrayLike) -> Floats:
    """Spatial derivative (..., 3, 3) in T/m of a cylinder's field: the second of `field_and_gradient`."""
    return field_and_gradient(moment, diameter_m, length_m, centre, point)[1]
