"""Sines, cosines and angles without branches, against extended precision."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from magenv.angles import arctan2, sincos, sincos_all, wrap

Floats = NDArray[np.float64]


@numba.njit(error_model="numpy")
def directions_of(y: Floats, x: Floats) -> Floats:
    angles = np.empty_like(x)
    for i in range(len(x)):
        angles[i] = arctan2(y[i], x[i])
    return angles


@pytest.mark.parametrize("span", [1.0, 10.0, 1e3, 1e5])
def test_sine_and_cosine_are_right_to_two_units_in_the_last_place(rng: np.random.Generator, span: float) -> None:
    angles = rng.uniform(-span, span, 50_000)
    sines, cosines = np.empty_like(angles), np.empty_like(angles)
    sincos_all(angles, len(angles), sines, cosines)
    for got, exact in ((sines, np.sin(angles.astype(np.longdouble))), (cosines, np.cos(angles.astype(np.longdouble)))):
        assert np.max(np.abs(got - exact) / np.spacing(np.abs(got))) < 2
    assert np.max(np.abs(sines)) <= 1
    assert np.max(np.abs(cosines)) <= 1


def test_angle_of_a_vector_is_right_to_two_units_in_the_last_place(rng: np.random.Generator) -> None:
    y, x = rng.normal(size=(2, 50_000))
    y *= 10 ** rng.uniform(-8, 8, len(y))
    angles = directions_of(y, x)
    exact = np.arctan2(y.astype(np.longdouble), x.astype(np.longdouble))
    assert np.max(np.abs(angles - exact) / np.spacing(np.abs(angles))) < 2


@pytest.mark.parametrize("y", [0.0, 1.0, -1.0, 1e-300])
@pytest.mark.parametrize("x", [0.0, 1.0, -1.0, 1e-300])
def test_angle_on_the_axes(y: float, x: float) -> None:
    assert arctan2(y, x) == math.atan2(y, x)


def test_alone_and_in_a_row_give_the_same_bits(rng: np.random.Generator) -> None:
    angles, other = rng.uniform(-10, 10, (2, 101))
    sines, cosines, directions = np.empty(101), np.empty(101), directions_of(angles, other)
    sincos_all(angles, 101, sines, cosines)
    for i, angle in enumerate(angles):
        assert sincos(angle) == (sines[i], cosines[i])
        assert arctan2(angle, other[i]) == directions[i]


def test_nan_stays_nan() -> None:
    for value in (math.nan, math.inf):
        assert all(math.isnan(part) for part in sincos(value))
    assert math.isnan(arctan2(math.nan, 1.0))
    assert math.isnan(arctan2(1.0, math.nan))
    assert math.isnan(wrap(math.nan))


def test_wrap() -> None:
    angles = np.linspace(-20.0, 20.0, 999)
    wrapped = np.array([wrap(a) for a in angles])
    assert np.abs(wrapped).max() <= math.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-13)
