"""Local coordinates of an EPM: they have no singularity, and each undoes the other."""

from __future__ import annotations

import math

import numpy as np
import pytest
from foreseen import Floats, bases_of, shifted
from lane import magnets

from magenv.local import local_basis, seen_from, shift

POLES = np.array(
    [
        [0.0, 0.0, 0.2, 0.0, 0.0, -1.0],
        [0.0, 0.0, -0.3, 0.0, 0.0, 1.0],
        [1e-11, -1e-11, 0.2, 1e-10, 0.0, 1.0],
        [1e-7, 0.0, 0.2, 0.0, 1e-7, 1.0],
        [0.2, 0.0, 0.0, 0.0, 1.0, 0.0],
    ]
)
"""Centres above and below the middle, moments upright: where azimuths do not exist."""


def epms_everywhere(rng: np.random.Generator) -> Floats:
    """EPMs (45, 6), the poles among them."""
    return np.concatenate([POLES, *(magnets(rng) for _ in range(20))])


def test_the_basis_holds_the_derivatives_of_a_shift(rng: np.random.Generator) -> None:
    h = 1e-5
    for epm in epms_everywhere(rng):
        basis = bases_of(epm[None])[0]
        columns = [(shifted(epm[None], h * e)[0] - shifted(epm[None], -h * e)[0]) / (2 * h) for e in np.eye(5)]
        np.testing.assert_allclose(basis, np.transpose(columns), atol=1e-9)


def test_the_basis_has_columns_at_right_angles_and_of_known_length(rng: np.random.Generator) -> None:
    """Turns of the centre are as long as its radius, all else of unit length; centre and moment stand apart."""
    for epm in epms_everywhere(rng):
        basis = np.full((6, 5), np.nan)
        local_basis(epm, basis)
        radius = np.linalg.norm(epm[:3])
        np.testing.assert_allclose(basis.T @ basis, np.diag([radius**2, radius**2, 1.0, 1.0, 1.0]), atol=1e-10)
        assert (basis[3:, :3] == 0.0).all()
        assert (basis[:3, 3:] == 0.0).all()
        np.testing.assert_allclose(basis[:3, 2], epm[:3] / radius, atol=1e-15)
        np.testing.assert_allclose(epm[3:] @ basis[3:, 3:], 0.0, atol=1e-9)


def test_a_shift_moves_on_spheres(rng: np.random.Generator) -> None:
    """However far: the radius is what was asked for, the moment a unit vector, and turns of them pure."""
    for epm in epms_everywhere(rng):
        step = rng.normal(0.0, 1.0, 5) * [1.0, 1.0, 0.02, 1.0, 1.0]
        moved = shifted(epm[None], step)[0]
        assert np.linalg.norm(moved[:3]) == pytest.approx(np.linalg.norm(epm[:3]) + step[2], rel=1e-14)
        assert np.linalg.norm(moved[3:]) == pytest.approx(1.0, rel=1e-14)
        for at, turn in ((0, step[:2]), (3, step[3:])):
            one, two = epm[at : at + 3], moved[at : at + 3]
            angle = math.atan2(float(np.linalg.norm(np.cross(one, two))), float(one @ two))
            assert angle == pytest.approx(math.atan(np.linalg.norm(turn)), abs=1e-9)


@pytest.mark.parametrize(("change", "radius"), [(-1.0, 0.15), (1.0, 0.5), (0.1, 0.3)])
def test_a_shift_keeps_the_radius_within_its_bounds(rng: np.random.Generator, change: float, radius: float) -> None:
    epm = np.array([0.0, 0.12, -0.16, 1.0, 0.0, 0.0])
    step = np.array([*rng.normal(size=2), change, 0.0, 0.0])
    shift(epm, bases_of(epm[None])[0], step, 0.15, 0.5)
    assert np.linalg.norm(epm[:3]) == pytest.approx(radius, rel=1e-14)
    np.testing.assert_array_equal(epm[3:], [1.0, 0.0, 0.0])


def test_no_step_moves_nothing(rng: np.random.Generator) -> None:
    for epm in epms_everywhere(rng):
        np.testing.assert_allclose(shifted(epm[None], np.zeros(5))[0], epm, rtol=1e-13, atol=1e-16)


def test_what_is_seen_from_an_epm_undoes_a_shift_to_first_order(rng: np.random.Generator) -> None:
    """Half the step, a quarter of the error at most; and it is small."""
    for epm in epms_everywhere(rng):
        step, basis = rng.normal(0.0, 1.0, 5) * [1.0, 1.0, 0.1, 1.0, 1.0], bases_of(epm[None])[0]
        errors = []
        for size in (2e-3, 1e-3):
            seen = np.empty(5)
            seen_from(shifted(epm[None], size * step)[0], epm, basis, seen)
            errors.append(np.abs(seen - size * step).max())
        assert errors[1] <= 0.26 * errors[0] + 1e-15
        assert errors[1] < 1e-5


def test_what_is_seen_is_linear_and_inverts_the_basis(rng: np.random.Generator) -> None:
    for epm in epms_everywhere(rng):
        step, basis, seen = rng.normal(size=5), bases_of(epm[None])[0], np.empty(5)
        seen_from(epm + basis @ step, epm, basis, seen)
        np.testing.assert_allclose(seen, step, atol=1e-13)
