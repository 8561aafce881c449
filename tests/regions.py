"""Magnets of several shapes, points in the regions round them, and the cylinder's laws there."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magenv.cylinder import field_and_gradient
from magenv.params import Magnet, System

Floats = NDArray[np.float64]

EPM, IPM = System().reference_epm, System().ipm
ROD, DISC = Magnet(diameter_m=0.02, length_m=0.2), Magnet(diameter_m=0.2, length_m=0.02)
MAGNETS = [EPM, IPM, ROD, DISC]
EXTREMES = np.concatenate([[0.0], 10.0 ** np.linspace(-17, -2, 16)])
"""Parts of a radius by which points are off an axis or a plane."""
N = 200


def near_mantle(rng: np.random.Generator, a: float, b: float) -> tuple[Floats, Floats]:
    return np.full(N, a + 1e-3), rng.uniform(-b, b, N)


def near_ends(rng: np.random.Generator, a: float, b: float) -> tuple[Floats, Floats]:
    return rng.uniform(0.0, a, N), rng.choice([-1.0, 1.0], N) * (b + 1e-3)


def near_rims(rng: np.random.Generator, a: float, b: float) -> tuple[Floats, Floats]:
    angle = rng.uniform(-0.5 * np.pi, np.pi, N)
    return a + 1e-3 * np.cos(angle), rng.choice([-1.0, 1.0], N) * (b + 1e-3 * np.sin(angle))


def near_axis(rng: np.random.Generator, a: float, b: float) -> tuple[Floats, Floats]:
    return a * rng.choice(EXTREMES, N), rng.choice([-1.0, 1.0], N) * (b + 10.0 ** rng.uniform(-3, 0, N) * (a + b))


def near_mid_plane(rng: np.random.Generator, a: float, b: float) -> tuple[Floats, Floats]:
    return a + 10.0 ** rng.uniform(-2, 1, N) * a, a * rng.choice(EXTREMES, N)


def beyond_mantle(rng: np.random.Generator, a: float, b: float) -> tuple[Floats, Floats]:
    """On the mantle's lengthening, where one of the third kind's integrals is singular."""
    off = rng.choice([-1.0, 1.0], N) * rng.choice(EXTREMES, N)
    return a * (1.0 + off), rng.choice([-1.0, 1.0], N) * (b + 10.0 ** rng.uniform(-2, 1, N) * a)


def in_end_planes(rng: np.random.Generator, a: float, b: float) -> tuple[Floats, Floats]:
    """In the planes of the ends, where the other is."""
    off = rng.choice([-1.0, 1.0], N) * rng.choice(EXTREMES, N)
    return a + 10.0 ** rng.uniform(-2, 1, N) * a, rng.choice([-1.0, 1.0], N) * b * (1.0 + off)


def around(rng: np.random.Generator, a: float, b: float) -> tuple[Floats, Floats]:
    distance, angle = math.hypot(a, b) * rng.uniform(1.1, 8.0, N), np.arccos(rng.uniform(-1.0, 1.0, N))
    return distance * np.sin(angle), distance * np.cos(angle)


def far_off(rng: np.random.Generator, a: float, b: float) -> tuple[Floats, Floats]:
    rho, z = around(rng, a, b)
    return 12.0 * rho, 12.0 * z


Region = Callable[[np.random.Generator, float, float], tuple[Floats, Floats]]
REGIONS: list[Region] = [
    around,
    far_off,
    near_axis,
    near_mid_plane,
    beyond_mantle,
    in_end_planes,
    near_mantle,
    near_ends,
    near_rims,
]


def points_in(region: Region, magnet: Magnet, rng: np.random.Generator) -> Floats:
    """Points (N, 3) of a region round a magnet along z."""
    rho, z = region(rng, 0.5 * magnet.diameter_m, 0.5 * magnet.length_m)
    turn = rng.uniform(0.0, 2.0 * np.pi, N)
    return np.stack([rho * np.cos(turn), rho * np.sin(turn), z], axis=-1)


def upright(magnet: Magnet, points: Floats) -> tuple[Floats, Floats]:
    """Field and gradient of a magnet at the origin, along z."""
    return field_and_gradient([0, 0, magnet.moment_am2], magnet.diameter_m, magnet.length_m, np.zeros(3), points)


def error(found: Floats, expected: Floats, axes: int = 1) -> Floats:
    """Error (n,) relative to the size of vectors, or of matrices."""
    over = tuple(range(-axes, 0))
    size: Floats = np.sqrt(np.sum(expected**2, axis=over))
    return np.asarray(np.sqrt(np.sum((found - expected) ** 2, axis=over)) / size)
