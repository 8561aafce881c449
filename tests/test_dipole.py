"""The dipole's laws against finite differences, closed forms and magpylib."""

from __future__ import annotations

import platform
import re
from typing import Any

import magpylib
import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from magenv.dipole import (
    _rows_kernel,
    dipole_force_gradient,
    dipole_force_hessian,
    field,
    field_and_gradient,
    gradient,
)
from magenv.params import MU_0, Magnet, System

Floats = NDArray[np.float64]

MAGPYLIB_RTOL = 1e-8
"""magpylib takes the measured vacuum permeability (CODATA), 1.3e-10 above 4 pi 1e-7."""


@pytest.fixture
def dipoles(rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Moments, sources and points (200, 3), 0.05 to 1 m apart in all directions."""
    moments = rng.normal(0.0, 1.0, (200, 3)) * 10.0 ** rng.uniform(-1, 3, (200, 1))
    sources = rng.normal(0.0, 0.2, (200, 3))
    offsets = rng.normal(0.0, 1.0, (200, 3))
    offsets *= rng.uniform(0.05, 1.0, (200, 1)) / np.linalg.norm(offsets, axis=-1, keepdims=True)
    return moments, sources, sources + offsets


def test_field_on_axis_and_on_the_equator() -> None:
    m, d = 925.0, 0.2
    k = MU_0 / (4 * np.pi)
    np.testing.assert_allclose(field([0, 0, m], [0, 0, 0], [0, 0, d]), [0, 0, 2 * k * m / d**3], rtol=1e-14)
    np.testing.assert_allclose(field([0, 0, m], [0, 0, 0], [0, 0, -d]), [0, 0, 2 * k * m / d**3], rtol=1e-14)
    np.testing.assert_allclose(field([0, 0, m], [0, 0, 0], [d, 0, 0]), [0, 0, -k * m / d**3], rtol=1e-14)


def test_field_is_magpylibs(dipoles: tuple[Floats, Floats, Floats]) -> None:
    moments, sources, points = dipoles
    b = magpylib.func.dipole_field("B", points, moments, positions=sources)
    h = magpylib.func.dipole_field("H", points, moments, positions=sources)
    ours = field(moments, sources, points)
    np.testing.assert_allclose(ours, b, rtol=MAGPYLIB_RTOL, atol=1e-14)
    np.testing.assert_allclose(ours, MU_0 * h, rtol=MAGPYLIB_RTOL, atol=1e-14)
    one = magpylib.misc.Dipole(moment=moments[0], position=sources[0])
    np.testing.assert_allclose(ours[0], one.getB(points[0]), rtol=MAGPYLIB_RTOL)


def test_gradient_is_the_derivative_of_the_field(dipoles: tuple[Floats, Floats, Floats]) -> None:
    moments, sources, points = dipoles
    distance = np.linalg.norm(points - sources, axis=-1)
    h = 1e-5 * distance
    numeric = np.empty((len(points), 3, 3))
    for j in range(3):
        step = h[:, None] * np.eye(3)[j]
        numeric[:, :, j] = (field(moments, sources, points + step) - field(moments, sources, points - step)) / (
            2 * h[:, None]
        )
    exact = gradient(moments, sources, points)
    size = np.linalg.norm(exact, axis=(-2, -1))[:, None, None]
    np.testing.assert_allclose(exact / size, numeric / size, atol=1e-8)


def test_gradient_is_the_derivative_of_magpylibs_field(dipoles: tuple[Floats, Floats, Floats]) -> None:
    moments, sources, points = dipoles
    h = 1e-5 * np.linalg.norm(points - sources, axis=-1)[:, None]
    numeric = np.stack(
        [
            (
                magpylib.func.dipole_field("B", points + h * axis, moments, positions=sources)
                - magpylib.func.dipole_field("B", points - h * axis, moments, positions=sources)
            )
            / (2 * h)
            for axis in np.eye(3)
        ],
        axis=-1,
    )
    exact = gradient(moments, sources, points)
    size = np.linalg.norm(exact, axis=(-2, -1))[:, None, None]
    np.testing.assert_allclose(exact / size, numeric / size, atol=1e-7)


def test_gradient_is_symmetric_and_traceless(dipoles: tuple[Floats, Floats, Floats]) -> None:
    g = gradient(*dipoles)
    size = np.linalg.norm(g, axis=(-2, -1))
    np.testing.assert_array_equal(g, np.swapaxes(g, -1, -2))
    assert np.abs(np.trace(g, axis1=-2, axis2=-1) / size).max() < 1e-14


def test_force_gradient_is_the_derivative_of_the_force(
    dipoles: tuple[Floats, Floats, Floats], rng: np.random.Generator
) -> None:
    moments, sources, points = dipoles
    for m, a, b in zip(moments[:50], sources, points, strict=False):
        n = rng.normal(size=3)
        h = 1e-5 * np.linalg.norm(b - a)
        numeric = np.stack(
            [(gradient(m, a, b + h * e).T @ n - gradient(m, a, b - h * e).T @ n) / (2 * h) for e in np.eye(3)], axis=-1
        )
        xx, xy, xz, yy, yz, zz = dipole_force_gradient(*m, *n, *(b - a))
        exact = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        size = np.linalg.norm(exact)
        np.testing.assert_allclose(exact / size, numeric / size, atol=1e-8)
        assert abs(np.trace(exact)) < 1e-13 * size


def test_gradient_of_the_papers_r_has_the_opposite_sign() -> None:
    """The paper's formula with its r = source - point is -1 times the derivative of B."""
    rng = np.random.default_rng(1)
    m, a, b = rng.normal(size=3), rng.normal(size=3), rng.normal(size=3)
    r = a - b
    u = r / np.linalg.norm(r)
    papers = (
        3
        * MU_0
        / (4 * np.pi * np.linalg.norm(r) ** 4)
        * (np.outer(m, u) + np.outer(u, m) + (u @ m) * (np.eye(3) - 5 * np.outer(u, u)))
    )
    np.testing.assert_allclose(gradient(m, a, b), -papers, rtol=1e-12)


def test_laws_are_linear_and_scale_with_distance(dipoles: tuple[Floats, Floats, Floats]) -> None:
    moments, sources, points = dipoles
    b, g = field(moments, sources, points), gradient(moments, sources, points)
    np.testing.assert_allclose(field(3 * moments, sources, points), 3 * b, rtol=1e-13)
    farther = sources + 2 * (points - sources)
    np.testing.assert_allclose(field(moments, sources, farther), b / 8, rtol=1e-10, atol=1e-18)
    np.testing.assert_allclose(gradient(moments, sources, farther), g / 16, rtol=1e-9, atol=1e-16)
    behind = 2 * sources - points
    np.testing.assert_allclose(field(moments, sources, behind), b, rtol=1e-9, atol=1e-16)
    np.testing.assert_allclose(gradient(moments, sources, behind), -g, rtol=1e-9, atol=1e-14)


def test_laws_turn_with_the_scene(dipoles: tuple[Floats, Floats, Floats], rotations: Floats) -> None:
    moments, sources, points = (value[: len(rotations)] for value in dipoles)
    q = rotations

    def turned(v: Floats) -> Floats:
        return np.einsum("nij,nj->ni", q, v)

    b = field(turned(moments), turned(sources), turned(points))
    g = gradient(turned(moments), turned(sources), turned(points))
    expected = gradient(moments, sources, points)
    size = np.linalg.norm(expected, axis=(-2, -1))[:, None, None]
    np.testing.assert_allclose(b, turned(field(moments, sources, points)), rtol=1e-9, atol=1e-12 * np.abs(b).max())
    np.testing.assert_allclose(g / size, q @ expected @ np.swapaxes(q, -1, -2) / size, atol=1e-12)


def test_arguments_broadcast() -> None:
    m, a, b = np.ones((4, 1, 3)), np.zeros(3), np.full((5, 3), 0.3)
    assert field(m, a, b).shape == (4, 5, 3)
    assert gradient(m, a, b).shape == (4, 5, 3, 3)
    assert field([1, 0, 0], [0, 0, 0], [1, 0, 0]).shape == (3,)
    assert field(np.ones((0, 3)), a, [1, 0, 0]).shape == (0, 3)
    np.testing.assert_array_equal(field(m, a, b)[2, 3], field([1, 1, 1], a, b[0]))


def test_fields_of_shapes_that_do_not_broadcast_are_refused() -> None:
    with pytest.raises(ValueError, match="shape mismatch"):
        field_and_gradient(np.ones((2, 3)), np.zeros((4, 3)), np.ones(3))


def same_bits(moments: Any, sources: Any, points: Any, b: Floats, g: Floats) -> bool:
    """Whether all three functions give exactly these fields and gradients, NaN included."""
    both = field_and_gradient(moments, sources, points)
    found = (field(moments, sources, points), gradient(moments, sources, points), *both)
    return all(
        one.shape == two.shape and one.tobytes() == two.tobytes() for one, two in zip(found, (b, g, b, g), strict=True)
    )


@pytest.mark.parametrize("n", [0, 1, 2, 31, 32, 33, 64, 200])
def test_bits_do_not_depend_on_how_many_rows_there_are(dipoles: tuple[Floats, Floats, Floats], n: int) -> None:
    """Blocks, the rest after them and single rows; the laws as they stand, too."""
    b, g = field_and_gradient(*dipoles)
    assert same_bits(*(value[:n] for value in dipoles), b[:n], g[:n])
    for row in range(n):
        assert same_bits(*(value[row] for value in dipoles), b[row], g[row])


def test_one_row_serves_for_many(dipoles: tuple[Floats, Floats, Floats]) -> None:
    for which in range(3):
        few = [value[:1] if i == which else value for i, value in enumerate(dipoles)]
        b, g = field_and_gradient(*(np.ascontiguousarray(np.broadcast_to(value, (200, 3))) for value in few))
        for one in (few[which], few[which][0], few[which][None]):
            arguments = [one if i == which else value for i, value in enumerate(few)]
            lead = (1,) if one.ndim == 3 else ()
            assert same_bits(*arguments, b.reshape(*lead, 200, 3), g.reshape(*lead, 200, 3, 3))


def test_bits_do_not_depend_on_how_arrays_lie_in_memory(dipoles: tuple[Floats, Floats, Floats]) -> None:
    moments, sources, points = dipoles
    expected = field_and_gradient(*dipoles)
    spread = np.zeros((200, 6))
    spread[:, ::2] = moments
    assert same_bits(spread[:, ::2], np.asfortranarray(sources), points[::-1][::-1], *expected)
    odd = np.frombuffer(b"x" + points.tobytes(), offset=1).reshape(200, 3)  # neither aligned nor writeable
    assert same_bits(moments, sources, odd, *expected)
    assert same_bits(moments.tolist(), sources, points, *expected)
    swapped = (np.swapaxes(value.reshape(20, 10, 3), 0, 1) for value in dipoles)
    b, g = expected[0].reshape(20, 10, 3), expected[1].reshape(20, 10, 3, 3)
    assert same_bits(*swapped, np.swapaxes(b, 0, 1), np.swapaxes(g, 0, 1))


def test_nan_in_a_row_never_touches_its_neighbours(dipoles: tuple[Floats, Floats, Floats]) -> None:
    moments, sources, points = dipoles
    b, g = field_and_gradient(*dipoles)
    moments[7], points[40], sources[199] = np.nan, sources[40], np.inf
    sick = field_and_gradient(*dipoles)
    others = np.isin(np.arange(200), [7, 40, 199], invert=True)
    assert np.isnan(sick[0][~others]).all()
    assert np.isnan(sick[1][~others]).all()
    np.testing.assert_array_equal(sick[0][others], b[others])
    np.testing.assert_array_equal(sick[1][others], g[others])


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="looks for x86 instructions")
@pytest.mark.parametrize("what", [(True, False), (False, True), (True, True)])
def test_rows_are_vectorised(what: tuple[bool, bool]) -> None:
    """Compiled here: numba does not show cached code."""
    cached: Any = _rows_kernel(*what)
    fresh = numba.njit(error_model="numpy", nogil=True)(cached.py_func)
    fresh(1, *np.ones((3, 3)), np.empty(3), np.empty(9))
    (assembly,) = fresh.inspect_asm().values()
    assert len(re.findall(r"\bvfn?m(?:add|sub)\d+pd\b", assembly)) >= 7, "as many as the inverse root has"


def test_laws_are_nan_at_the_source() -> None:
    assert np.isnan(field([0, 0, 1], [0.1, 0, 0], [0.1, 0, 0])).all()
    assert np.isnan(gradient([0, 0, 1], [0.1, 0, 0], [0.1, 0, 0])).all()


def directions(n: int) -> Floats:
    angle = np.linspace(0.0, np.pi / 2, n)
    return np.stack([np.sin(angle), np.zeros(n), np.cos(angle)], axis=-1)


def cylinder_field(points: Floats) -> Floats:
    """Field of the exact 100 mm x 100 mm magnet along z."""
    magnet = System().reference_epm
    cylinder = magpylib.magnet.Cylinder(
        dimension=(magnet.diameter_m, magnet.length_m), polarization=(0, 0, magnet.remanence_t)
    )
    exact: Floats = cylinder.getB(points)
    return exact


def dipole_error(points: Floats) -> Floats:
    """Error (n,) of the dipole relative to the exact field."""
    exact = cylinder_field(points)
    dipole = field([0, 0, System().reference_epm.moment_am2], [0, 0, 0], points)
    error: Floats = np.linalg.norm(dipole - exact, axis=-1) / np.linalg.norm(exact, axis=-1)
    return error


FAR_OFF = [0.125, 0.15, 0.2, 0.3, 0.5]


@pytest.mark.parametrize("distance", FAR_OFF)
def test_dipole_is_the_cylinder_within_3_percent_on_its_axis(distance: float) -> None:
    assert dipole_error(np.array([[0.0, 0.0, distance], [0.0, 0.0, -distance]])).max() < 0.03


@pytest.mark.parametrize(("distance", "error"), [(0.125, 0.11), (0.15, 0.07), (0.2, 0.032), (0.3, 0.02), (0.5, 0.01)])
def test_dipole_is_the_cylinder_in_all_directions_as_documented(distance: float, error: float) -> None:
    """Broadside the dipole is worse than on the axis; the docstring of ``magenv.dipole`` tells these figures."""
    assert 0.3 * error < dipole_error(distance * directions(19)).max() < error


def test_error_of_the_dipole_falls_with_the_square_of_the_distance() -> None:
    """Equal moments and an octupole next: what remains far off is geometry, not a wrong remanence."""
    near, far = dipole_error(0.6 * directions(7)), dipole_error(1.2 * directions(7))
    assert (far < 1.5e-3).all()
    assert (far < 0.3 * near + 1e-6).all()


def test_dipole_is_not_the_cylinder_close_by() -> None:
    assert dipole_error(np.array([[0.0, 0.0, 0.075]]))[0] > 0.15


def test_moment_is_that_of_the_polarised_cylinder() -> None:
    magnet = Magnet(diameter_m=5e-3, length_m=5e-3)
    cylinder = magpylib.magnet.Cylinder(dimension=(5e-3, 5e-3), polarization=(0, 0, magnet.remanence_t))
    far = np.array([0.1, 0.2, 2.0])
    np.testing.assert_allclose(field([0, 0, magnet.moment_am2], [0, 0, 0], far), cylinder.getB(far), rtol=1e-5)


def test_force_hessian_is_the_derivative_of_the_force_gradient(rng: np.random.Generator) -> None:
    h = 1e-5
    for _ in range(20):
        a, b, c, r = rng.normal(size=(4, 3))
        exact = np.array(dipole_force_hessian(*a, *b, *c, *r))
        ahead, behind = (np.array(dipole_force_gradient(*a, *b, *(r + s * h * c))) for s in (1, -1))
        np.testing.assert_allclose(exact, (ahead - behind) / (2 * h), atol=1e-6 * np.abs(exact).max())
        assert abs(exact[0] + exact[3] + exact[5]) < 1e-13 * np.abs(exact).max()
        for x, y, z in ((b, a, c), (c, b, a), (a, c, b)):
            np.testing.assert_allclose(
                dipole_force_hessian(*x, *y, *z, *r), exact, rtol=1e-9, atol=1e-13 * np.abs(exact).max()
            )
