"""The cylinder's laws against magpylib, closed forms, finite differences and the dipole."""

from __future__ import annotations

import math

import magpylib
import numpy as np
import pytest
from numpy.typing import NDArray
from regions import EPM, MAGNETS, REGIONS, N, Region, around, error, far_off, near_axis, points_in, upright

from magenv import dipole
from magenv.cylinder import field
from magenv.params import Magnet

Floats = NDArray[np.float64]

RAYS = np.linspace(0.0, np.pi / 2, 19)


def magpylibs(magnet: Magnet) -> magpylib.magnet.Cylinder:
    return magpylib.magnet.Cylinder(
        dimension=(magnet.diameter_m, magnet.length_m), polarization=(0, 0, magnet.remanence_t)
    )


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
