"""Identities that the cylinder's laws keep, alone and over arrays, and the input that they refuse."""

from __future__ import annotations

import math
import platform
import re
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest
from messages import told
from numpy.typing import NDArray
from regions import EPM, MAGNETS, N, Region, around, beyond_mantle, error, near_mantle, points_in, upright

from magenv.cylinder import (
    _columns,
    cylinder_field,
    cylinder_gradient,
    cylinder_parts,
    cylinder_source,
    cylinder_strength,
    field,
    field_and_gradient,
    gradient,
)
from magenv.params import Magnet

Floats = NDArray[np.float64]


@pytest.fixture
def cylinders(rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Moments, centres and points (200, 3) in all directions, 0.08 to 1 m apart: for the EPM's size."""
    moments = rng.normal(0.0, 1.0, (N, 3)) * 10.0 ** rng.uniform(-1, 3, (N, 1))
    centres, offsets = rng.normal(0.0, 0.2, (N, 3)), rng.normal(0.0, 1.0, (N, 3))
    offsets *= rng.uniform(0.08, 1.0, (N, 1)) / np.linalg.norm(offsets, axis=-1, keepdims=True)
    return moments, centres, centres + offsets


def epm(moments: Any, centres: Any, points: Any) -> tuple[Floats, Floats]:
    return field_and_gradient(moments, EPM.diameter_m, EPM.length_m, centres, points)


def test_gradient_is_symmetric_and_traceless(cylinders: tuple[Floats, Floats, Floats]) -> None:
    g = epm(*cylinders)[1]
    np.testing.assert_array_equal(g, np.swapaxes(g, -1, -2))
    assert np.abs(np.trace(g, axis1=-2, axis2=-1) / np.linalg.norm(g, axis=(-2, -1))).max() < 1e-13


@pytest.mark.parametrize("magnet", MAGNETS)
@pytest.mark.parametrize("region", [around, near_mantle, beyond_mantle])
def test_a_cylinder_is_made_of_shorter_ones(magnet: Magnet, region: Region, rng: np.random.Generator) -> None:
    """Of 3/10 and 7/10 of its length; nothing of the inner ends is left."""
    points = points_in(region, magnet, rng)
    b, g = upright(magnet, points)
    parts_b, parts_g = np.zeros_like(b), np.zeros_like(g)
    for share, centre in ((0.3, -0.35), (0.7, 0.15)):
        moment, at = [0, 0, share * magnet.moment_am2], [0, 0, centre * magnet.length_m]
        for total, part in zip(
            (parts_b, parts_g),
            field_and_gradient(moment, magnet.diameter_m, share * magnet.length_m, at, points),
            strict=True,
        ):
            total += part
    assert error(parts_b, b).max() < 1e-11
    assert error(parts_g, g, axes=2).max() < 1e-9


def test_laws_are_linear_in_the_moment(cylinders: tuple[Floats, Floats, Floats]) -> None:
    moments, centres, points = cylinders
    b, g = epm(moments, centres, points)
    for factor in (3.0, -1.0, 1e-100, 1e30):
        scaled_b, scaled_g = epm(factor * moments, centres, points)
        assert error(scaled_b / factor, b).max() < 1e-12
        assert error(scaled_g / factor, g, axes=2).max() < 1e-12
    for none in epm(np.zeros(3), centres, points):
        np.testing.assert_array_equal(none, 0.0)


def test_laws_scale_with_size_and_are_even_in_space(cylinders: tuple[Floats, Floats, Floats]) -> None:
    moments, centres, points = cylinders
    b, g = epm(moments, centres, points)
    farther = centres + 2.0 * (points - centres)
    large_b, large_g = field_and_gradient(moments, 2.0 * EPM.diameter_m, 2.0 * EPM.length_m, centres, farther)
    assert error(8.0 * large_b, b).max() < 1e-12
    assert error(16.0 * large_g, g, axes=2).max() < 1e-12
    behind_b, behind_g = epm(moments, centres, 2.0 * centres - points)
    assert error(behind_b, b).max() < 1e-12
    assert error(-behind_g, g, axes=2).max() < 1e-12


def test_laws_turn_with_the_scene(cylinders: tuple[Floats, Floats, Floats], rotations: Floats) -> None:
    few = [value[: len(rotations)] for value in cylinders]
    b, g = epm(*few)
    turned_b, turned_g = epm(*(np.einsum("nij,nj->ni", rotations, value) for value in few))
    assert error(turned_b, np.einsum("nij,nj->ni", rotations, b)).max() < 1e-12
    assert error(turned_g, rotations @ g @ np.swapaxes(rotations, -1, -2), axes=2).max() < 1e-12


def test_laws_are_those_of_the_arrays(cylinders: tuple[Floats, Floats, Floats]) -> None:
    """Bit for bit, one by one or many at once: field, gradient, both."""
    b, g = epm(*cylinders)
    moments, centres, points = cylinders
    size = EPM.diameter_m, EPM.length_m
    np.testing.assert_array_equal(field(moments, *size, centres, points), b)
    np.testing.assert_array_equal(gradient(moments, *size, centres, points), g)
    upper = np.triu_indices(3)
    for row in range(50):
        m, r = moments[row], points[row] - centres[row]
        assert cylinder_field(*m, *size, *r) == tuple(b[row])
        assert cylinder_gradient(*m, *size, *r) == tuple(g[row][upper])
        assert cylinder_source(*m, *size, *r) == (*b[row], *g[row][upper])


def test_parts_give_the_wrench_in_the_plane(cylinders: tuple[Floats, Floats, Floats], rng: np.random.Generator) -> None:
    """Field and force on a moment n in the plane, of what ``cylinder_parts`` returns."""
    b, g = epm(*cylinders)
    for row in range(50):
        m, r, n = cylinders[0][row], cylinders[2][row] - cylinders[1][row], np.array([*rng.normal(size=2), 0.0])
        size = float(np.linalg.norm(m))
        u = m / size
        z = float(r @ u)
        rho = r - z * u
        strength = cylinder_strength(size, EPM.diameter_m, EPM.length_m)
        q, along, w, s, gap = cylinder_parts(strength, EPM.diameter_m / 2, EPM.length_m / 2, z, float(rho @ rho))
        np.testing.assert_allclose(q * rho + along * u, b[row], atol=1e-12 * np.linalg.norm(b[row]))
        force = q * n + (w * (rho @ n) + s * (u @ n)) * rho + (s * (rho @ n) + gap * (u @ n)) * u
        np.testing.assert_allclose(force, g[row] @ n, atol=1e-12 * np.linalg.norm(g[row]) * np.linalg.norm(n))


def test_strength_is_that_of_the_magnets_remanence() -> None:
    for magnet in MAGNETS:
        strength = cylinder_strength(magnet.moment_am2, magnet.diameter_m, magnet.length_m)
        assert strength == pytest.approx(magnet.remanence_t / math.pi, rel=1e-14)


def test_arguments_broadcast() -> None:
    m, c, p = np.ones((4, 1, 3)), np.zeros(3), np.full((5, 3), 0.3)
    b, g = epm(m, c, p)
    assert b.shape == (4, 5, 3)
    assert g.shape == (4, 5, 3, 3)
    assert field([1, 0, 0], 0.1, 0.1, [0, 0, 0], [1, 0, 0]).shape == (3,)
    assert gradient(np.ones((0, 3)), 0.1, 0.1, c, [1, 0, 0]).shape == (0, 3, 3)
    one = epm([1, 1, 1], c, p[0])
    np.testing.assert_array_equal(b[2, 3], one[0])
    np.testing.assert_array_equal(g[2, 3], one[1])


def test_nan_in_a_row_never_touches_its_neighbours(cylinders: tuple[Floats, Floats, Floats]) -> None:
    moments, centres, points = cylinders
    b, g = epm(*cylinders)
    moments[7, 1], points[40, 0], centres[199] = np.nan, np.nan, np.inf
    sick = epm(*cylinders)
    others = np.isin(np.arange(N), [7, 40, 199], invert=True)
    assert np.isnan(sick[0][~others]).all()
    assert np.isnan(sick[1][~others]).all()
    np.testing.assert_array_equal(sick[0][others], b[others])
    np.testing.assert_array_equal(sick[1][others], g[others])


@pytest.mark.parametrize("call", [field, gradient, field_and_gradient])
def test_what_does_not_fit_is_refused(call: Callable[..., object]) -> None:
    fitting: dict[str, Any] = {
        "moment": [1, 0, 0],
        "diameter_m": 0.1,
        "length_m": 0.1,
        "centre": [0, 0, 0],
        "point": [1, 0, 0],
    }
    for name, value in (("moment", [1, 2]), ("centre", [0, 0, 0, 0]), ("point", 1.0)):
        with pytest.raises(ValueError, match=told(name, "an array of shape (..., 3)", np.shape(value))):
            call(**(fitting | {name: value}))
    for name in ("diameter_m", "length_m"):
        for size in (0.0, -0.1, math.nan, math.inf, "1", None, True, [0.1, 0.1]):
            with pytest.raises(ValueError, match=told(name, "a positive, finite number", size)):
                call(**(fitting | {name: size}))
    with pytest.raises(ValueError, match="Input moment, centre, point must be of leading axes that broadcast"):
        call(**(fitting | {"moment": np.ones((2, 3)), "point": np.ones((4, 3))}))


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="looks for x86 instructions")
def test_rows_are_vectorised() -> None:
    """Seven roots an end and one of the moment at least; compiled here: numba does not show cached code."""
    cached: Any = _columns
    fresh = numba.njit(error_model="numpy", nogil=True)(cached.py_func)
    fresh(np.ones((18, 1)), 0.1, 0.1)
    (assembly,) = fresh.inspect_asm().values()
    assert len(re.findall(r"\bv?sqrtpd\b", assembly)) >= 15
    assert len(re.findall(r"\bv?divpd\b", assembly)) >= 30
