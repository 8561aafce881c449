"""The cylinder's laws against magpylib, closed forms, finite differences and the dipole."""

from __future__ import annotations

import math
import platform
import re
from collections.abc import Callable
from typing import Any

import magpylib
import numba
import numpy as np
import pytest
from messages import told
from numpy.typing import NDArray

from magenv import dipole
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
from magenv.params import Magnet, System

Floats = NDArray[np.float64]

EPM, IPM = System().reference_epm, System().ipm
ROD, DISC = Magnet(diameter_m=0.02, length_m=0.2), Magnet(diameter_m=0.2, length_m=0.02)
MAGNETS = [EPM, IPM, ROD, DISC]
RAYS = np.linspace(0.0, np.pi / 2, 19)
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


def magpylibs(magnet: Magnet) -> magpylib.magnet.Cylinder:
    return magpylib.magnet.Cylinder(
        dimension=(magnet.diameter_m, magnet.length_m), polarization=(0, 0, magnet.remanence_t)
    )


def error(found: Floats, expected: Floats, axes: int = 1) -> Floats:
    """Error (n,) relative to the size of vectors, or of matrices."""
    over = tuple(range(-axes, 0))
    size: Floats = np.sqrt(np.sum(expected**2, axis=over))
    return np.asarray(np.sqrt(np.sum((found - expected) ** 2, axis=over)) / size)


@pytest.fixture
def cylinders(rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Moments, centres and points (200, 3) in all directions, 0.08 to 1 m apart: for the EPM's size."""
    moments = rng.normal(0.0, 1.0, (N, 3)) * 10.0 ** rng.uniform(-1, 3, (N, 1))
    centres, offsets = rng.normal(0.0, 0.2, (N, 3)), rng.normal(0.0, 1.0, (N, 3))
    offsets *= rng.uniform(0.08, 1.0, (N, 1)) / np.linalg.norm(offsets, axis=-1, keepdims=True)
    return moments, centres, centres + offsets


def epm(moments: Any, centres: Any, points: Any) -> tuple[Floats, Floats]:
    return field_and_gradient(moments, EPM.diameter_m, EPM.length_m, centres, points)


@pytest.mark.parametrize("region", REGIONS)
@pytest.mark.parametrize("magnet", MAGNETS)
def test_field_is_magpylibs(magnet: Magnet, region: Region, rng: np.random.Generator) -> None:
    """magpylib itself loses digits far from a magnet, on the axis above all."""
    points = points_in(region, magnet, rng)
    limit = 1e-7 if region in (far_off, near_axis) else 1e-10
    assert error(upright(magnet, points)[0], magpylibs(magnet).getB(points)).max() < limit


def test_field_of_turned_cylinders_is_magpylibs(rng: np.random.Generator) -> None:
    from scipy.spatial.transform import Rotation

    points = points_in(around, EPM, rng)
    for turn in Rotation.random(10, rng=rng):
        cylinder = magpylibs(EPM)
        cylinder.orientation, cylinder.position = turn, rng.normal(0.0, 0.1, 3)
        moment = turn.apply([0.0, 0.0, EPM.moment_am2])
        at = cylinder.position + turn.apply(points)
        found = field(moment, EPM.diameter_m, EPM.length_m, cylinder.position, at)
        assert error(found, cylinder.getB(at)).max() < 1e-10


@pytest.mark.parametrize("magnet", MAGNETS)
def test_field_and_gradient_on_and_near_the_axis(magnet: Magnet) -> None:
    """Closed form on the axis. Beside it everything changes by the square of the distance."""
    a, b, remanence = 0.5 * magnet.diameter_m, 0.5 * magnet.length_m, magnet.remanence_t
    for z in (b + 1e-3, b + a, -b - a, b + 4.0 * a):
        up, low = z - b, z + b
        bz = 0.5 * remanence * (low / math.hypot(low, a) - up / math.hypot(up, a))
        g_zz = 0.5 * remanence * a**2 * (math.hypot(low, a) ** -3 - math.hypot(up, a) ** -3)
        for off in (0.0, 1e-300, 1e-170, 1e-150, 1e-100, 1e-20, 1e-12, 1e-9):
            found, slope = upright(magnet, np.array([off * a, -off * a, z]))
            np.testing.assert_allclose(found[2], bz, rtol=1e-13)
            np.testing.assert_allclose(found[:2], -0.5 * g_zz * off * a * np.array([1, -1]), rtol=1e-12)
            expected = g_zz * np.diag([-0.5, -0.5, 1.0])
            np.testing.assert_allclose(slope, expected, atol=(1e-13 + 10.0 * off) * abs(g_zz))


@pytest.mark.parametrize("region", REGIONS)
@pytest.mark.parametrize("magnet", MAGNETS)
def test_gradient_is_the_derivative_of_the_field(magnet: Magnet, region: Region, rng: np.random.Generator) -> None:
    """By central differences of the fourth order over a part of the distance from the surface."""
    points = points_in(region, magnet, rng)
    rho, z = np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 2])
    beside, above = np.maximum(rho - 0.5 * magnet.diameter_m, 0.0), np.maximum(z - 0.5 * magnet.length_m, 0.0)
    h = 0.004 * np.hypot(beside, above)[:, None]
    numeric = np.empty((N, 3, 3))
    for j, axis in enumerate(np.eye(3)):
        near, far = (
            upright(magnet, points + k * h * axis)[0] - upright(magnet, points - k * h * axis)[0] for k in (1, 2)
        )
        numeric[:, :, j] = (8.0 * near - far) / (12.0 * h)
    assert error(upright(magnet, points)[1], numeric, axes=2).max() < 1e-8


@pytest.mark.parametrize("magnet", MAGNETS)
def test_gradient_is_the_derivative_of_magpylibs_field(magnet: Magnet, rng: np.random.Generator) -> None:
    points, cylinder = points_in(around, magnet, rng), magpylibs(magnet)
    h = 1e-4 * np.linalg.norm(points, axis=-1)[:, None]
    numeric = np.stack(
        [(cylinder.getB(points + h * axis) - cylinder.getB(points - h * axis)) / (2.0 * h) for axis in np.eye(3)],
        axis=-1,
    )
    assert error(upright(magnet, points)[1], numeric, axes=2).max() < 1e-6


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


def from_dipole(magnet: Magnet, distance: float) -> tuple[float, float]:
    """Worst deviation of field and gradient from the dipole's, in all directions."""
    points = distance * np.stack([np.sin(RAYS), np.zeros(19), np.cos(RAYS)], axis=-1)
    b, g = upright(magnet, points)
    dipole_b, dipole_g = dipole.field_and_gradient([0, 0, magnet.moment_am2], np.zeros(3), points)
    return float(error(b, dipole_b).max()), float(error(g, dipole_g, axes=2).max())


@pytest.mark.parametrize("magnet", MAGNETS)
def test_far_off_the_cylinder_is_the_dipole(magnet: Magnet) -> None:
    """An octupole is next: what lies between falls with the square of the distance."""
    size = max(magnet.diameter_m, magnet.length_m)
    for near, far in zip(from_dipole(magnet, 10.0 * size), from_dipole(magnet, 100.0 * size), strict=True):
        assert near < 0.05
        assert far == pytest.approx(near / 100.0, rel=0.05)
    assert max(from_dipole(magnet, 5000.0 * size)) < 3e-7


def test_the_cylinder_of_the_best_shape_is_a_dipole_soonest() -> None:
    """Length over diameter of sqrt(3) / 2 has no octupole (Petruska and Abbott): the fourth power of the distance."""
    best = Magnet(diameter_m=0.1, length_m=0.05 * math.sqrt(3.0))
    for near, far in zip(from_dipole(best, 0.5), from_dipole(best, 5.0), strict=True):
        assert near < 2e-3
        assert far == pytest.approx(near * 1e-4, rel=0.05)


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


def test_inside_comes_mu0_h_and_the_gradient(rng: np.random.Generator) -> None:
    points = rng.uniform(-0.025, 0.025, (N, 3))
    b, g = upright(EPM, points)
    cylinder = magpylibs(EPM)
    inside = cylinder.getB(points) - [0.0, 0.0, EPM.remanence_t]
    assert error(b, inside).max() < 1e-10
    h = 1e-5
    numeric = np.stack(
        [(cylinder.getB(points + h * axis) - cylinder.getB(points - h * axis)) / (2.0 * h) for axis in np.eye(3)],
        axis=-1,
    )
    assert error(g, numeric, axes=2).max() < 1e-6


def test_on_the_mantle_comes_the_field_outside_and_on_the_rims_nothing_finite() -> None:
    on, beside = (upright(EPM, np.array([0.05 + off, 0.0, 0.02])) for off in (0.0, 1e-12))
    np.testing.assert_allclose(on[0], beside[0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(on[1], beside[1], rtol=1e-9, atol=1e-9)
    for rim in upright(EPM, np.array([0.05, 0.0, 0.05])):
        assert not np.isfinite(rim).all()


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
