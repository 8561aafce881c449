"""Sums of products, against exact arithmetic."""

from __future__ import annotations

from fractions import Fraction

import numba
import numpy as np
import pytest

from magenv.arithmetic import cross2, dot2, dot3, fma


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
