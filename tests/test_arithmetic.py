"""Sums of products and the inverse square root, against exact and extended arithmetic."""

from __future__ import annotations

import math
from fractions import Fraction

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from magenv.arithmetic import cross2, dot2, dot3, fma, inverse_root

Floats = NDArray[np.float64]


@numba.njit
def roots(x: Floats) -> Floats:
    out = np.empty_like(x)
    for i in range(len(x)):
        out[i] = inverse_root(x[i])
    return out


@numba.njit
def once(a: float, b: float, c: float) -> float:
    result: float = fma(a, b, c)
    return result


def nearest(exact: Fraction) -> float:
    return float(exact)  # Python rounds a fraction to the nearest double


def test_fma_rounds_once(rng: np.random.Generator) -> None:
    differing = 0
    for a, b, c in rng.normal(size=(500, 3)):
        c = -a * b * (1.0 + 1e-9 * c)  # cancels, so that the product's own rounding would be seen
        assert once(a, b, c) == nearest(Fraction(a) * Fraction(b) + Fraction(c))
        differing += once(a, b, c) != a * b + c
    assert differing > 400


def test_products_of_vectors(rng: np.random.Generator) -> None:
    for ax, ay, az, bx, by, bz in rng.normal(size=(100, 6)):
        scale = 1e-15 * (abs(ax * bx) + abs(ay * by) + abs(az * bz) + abs(ax * by) + abs(ay * bx))
        assert dot2(ax, ay, bx, by) == pytest.approx(ax * bx + ay * by, rel=0, abs=scale)
        assert dot3(ax, ay, az, bx, by, bz) == pytest.approx(ax * bx + ay * by + az * bz, rel=0, abs=scale)
        assert cross2(ax, ay, bx, by) == pytest.approx(ax * by - ay * bx, rel=0, abs=scale)


@pytest.mark.parametrize(("low", "high"), [(1.0, 4.0), (1e-9, 1e9), (1e-290, 1e290)])
def test_inverse_root_is_right_to_two_units_in_the_last_place(
    rng: np.random.Generator, low: float, high: float
) -> None:
    x = np.exp(rng.uniform(math.log(low), math.log(high), 200_000))
    exact = 1.0 / np.sqrt(x.astype(np.longdouble))
    assert np.max(np.abs(roots(x) - exact) / np.spacing(exact.astype(np.float64))) < 2


def test_inverse_root_alone_and_in_a_row_gives_the_same_bits(rng: np.random.Generator) -> None:
    x = np.exp(rng.uniform(-20.0, 20.0, 101))
    assert [inverse_root(value) for value in x] == roots(x).tolist()


def test_inverse_root_at_the_ends() -> None:
    zero, subnormal, infinite, nan = roots(np.array([0.0, 5e-324, math.inf, math.nan]))
    assert 1e154 < zero < math.inf
    assert subnormal > 1e154
    assert math.isnan(infinite)
    assert math.isnan(nan)
