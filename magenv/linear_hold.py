"""Holds by their linear motion: M q'' + D q' = F + K q about where robots are, of constant wrench F and stiffness K.

Some microseconds, where integrating the plant takes a hundred; and how much small deviations grow in it. Holds under
poses that differ a little are foreseen side by side, one a lane (see ``magenv.lanes``): field f of lane v of w stands
at w f + v, with w of ``ALONE`` or ``BESIDE``, so that fields stand apart by constants and the loops are vectorised.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.kernels import kernel, law
from magenv.params import Body
from magenv.sensitivity import COORDINATES

Floats = NDArray[np.float64]

ALONE, BESIDE = (0,), (0,) * 16
"""Of these lengths are the rows of lanes: one hold, or as many as the poses of three EPMs have numbers, and one."""
_SUBSTEP_S = 0.01
"""Decay by drag is exact in each."""
_TERMS = 6
"""Of the exponential's series, for a norm of half at most."""
_MOST_HALVINGS = 60

# The wrench (N, N m) and its stiffness (N and N m per m and rad, row by row); how far robots come (m, rad) and their
# rates then; the logarithm of what deviations grow by.
FORCE, STIFFNESS, MOVED, RATES, GROWN = 0, 6, 42, 48, 54
# Room for the growth: stiffness over drag (1/s), its exponential over a part of the period and the product of two
# matrices; norms, a row's sum, parts of the period and how often these were halved.
SCALED, _EXPONENTIAL, _PRODUCT, _NORM, _SUM, _PART, _HALVINGS = 55, 91, 127, 163, 164, 165, 166
HOLD_SIZE = 167


class LinearHold(NamedTuple):
    """What is known of a hold beforehand, of robots that are alike and move along x as along y."""

    drag: Floats
    """(6,) N s/m and N m s/rad, of x, y, heading of both robots."""
    decay: Floats
    """(6,) share of the rates left after a substep."""
    root: Floats
    """(6,) square roots of the inverse drags."""
    substep: float
    """s."""
    substeps: int

    @classmethod
    def of(cls, body: Body, period_s: float) -> LinearHold:
        """Return holds of ``period_s`` (s) of robots with drag."""
        substeps = max(1, math.ceil(period_s / _SUBSTEP_S - 1e-9))
        substep = period_s / substeps
        drag = np.tile([body.drag_linear_nspm, body.drag_linear_nspm, body.drag_rotational_nmsprad], 2)
        inertia = np.tile([body.mass_kg, body.mass_kg, body.inertia_kgm2], 2)
        return cls(drag, np.exp(-drag * substep / inertia), 1.0 / np.sqrt(drag), substep, substeps)


Six = tuple[float, float, float, float, float, float]


@law
def _six(lanes: Floats, w: int, v: int, first: int, apart: int) -> Six:
    """Return six fields of lane ``v``, so far apart."""
    a, b, c = lanes[w * first + v], lanes[w * (first + apart) + v], lanes[w * (first + 2 * apart) + v]
    return (
        a,
        b,
        c,
        lanes[w * (first + 3 * apart) + v],
        lanes[w * (first + 4 * apart) + v],
        lanes[w * (first + 5 * apart) + v],
    )


@law
def _halves(a: Six, b: Six) -> tuple[float, float]:
    """Return the halves of a product of two rows."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2], a[3] * b[3] + a[4] * b[4] + a[5] * b[5]


@law
def _drift(lanes: Floats, w: int, v: int, i: int, half: float) -> float:
    moved: float = lanes[w * (MOVED + i) + v] + half * lanes[w * (RATES + i) + v]
    lanes[w * (MOVED + i) + v] = moved
    return moved


@law
def _kick(lanes: Floats, w: int, v: int, i: int, x: Six, decay: float, gain: float) -> None:
    one, other = _halves(_six(lanes, w, v, STIFFNESS + COORDINATES * i, 1), x)
    lanes[w * (RATES + i) + v] = decay * lanes[w * (RATES + i) + v] + gain * (lanes[w * (FORCE + i) + v] + one + other)


@law
def _drift_all(lanes: Floats, w: int, v: int, half: float) -> Six:
    x, y, heading = _drift(lanes, w, v, 0, half), _drift(lanes, w, v, 1, half), _drift(lanes, w, v, 2, half)
    return x, y, heading, _drift(lanes, w, v, 3, half), _drift(lanes, w, v, 4, half), _drift(lanes, w, v, 5, half)


@kernel
def foresee(hold: LinearHold, substeps: int, rates: Floats, lanes: Floats, side_by_side: tuple[int, ...]) -> None:
    """Write how far robots of these ``rates`` (6,) come in so many substeps, and their rates then."""
    half, w = 0.5 * hold.substep, len(side_by_side)
    (decay, turn_decay), (drag, turn_drag) = (hold.decay[0], hold.decay[2]), (hold.drag[0], hold.drag[2])
    gain, turn_gain = (1.0 - decay) / drag, (1.0 - turn_decay) / turn_drag
    for i in range(COORDINATES):
        for v in range(w):
            lanes[w * (MOVED + i) + v], lanes[w * (RATES + i) + v] = 0.0, rates[i]
    for _ in range(substeps):
        for v in range(w):  # written out: loops within would be in the way of vectors
            x = _drift_all(lanes, w, v, half)
            _kick(lanes, w, v, 0, x, decay, gain)
            _kick(lanes, w, v, 1, x, decay, gain)
            _kick(lanes, w, v, 2, x, turn_decay, turn_gain)
            _kick(lanes, w, v, 3, x, decay, gain)
            _kick(lanes, w, v, 4, x, decay, gain)
            _kick(lanes, w, v, 5, x, turn_decay, turn_gain)
            _drift_all(lanes, w, v, half)


@law
def _element(lanes: Floats, w: int, v: int, b: int, at: int, row: Six, j: int) -> None:
    one, other = _halves(row, _six(lanes, w, v, b + j, COORDINATES))
    lanes[w * (at + j) + v] = one + other


@law
def _product_row(lanes: Floats, w: int, v: int, a: int, b: int, i: int) -> None:
    row, at = _six(lanes, w, v, a + COORDINATES * i, 1), _PRODUCT + COORDINATES * i
    _element(lanes, w, v, b, at, row, 0)
    _element(lanes, w, v, b, at, row, 1)
    _element(lanes, w, v, b, at, row, 2)
    _element(lanes, w, v, b, at, row, 3)
    _element(lanes, w, v, b, at, row, 4)
    _element(lanes, w, v, b, at, row, 5)


@law
def _multiply(lanes: Floats, a: int, b: int, side_by_side: tuple[int, ...]) -> None:
    """Write the product of two matrices, whose fields begin at ``a`` and ``b``."""
    w = len(side_by_side)
    for v in range(w):
        _product_row(lanes, w, v, a, b, 0)
        _product_row(lanes, w, v, a, b, 1)
        _product_row(lanes, w, v, a, b, 2)
        _product_row(lanes, w, v, a, b, 3)
        _product_row(lanes, w, v, a, b, 4)
        _product_row(lanes, w, v, a, b, 5)


@kernel
def log_growth(period: float, lanes: Floats, side_by_side: tuple[int, ...]) -> None:
    """Write the logarithms of the norms of exp(a period), of the symmetric matrices ``SCALED``, a, in 1/s.

    By its Taylor series over a small part of the period, and squaring.
    """
    w, most = len(side_by_side), 0.0
    for v in range(w):
        lanes[w * _NORM + v] = 0.0
    for i in range(COORDINATES):
        for v in range(w):
            lanes[w * _SUM + v] = 0.0
        for j in range(COORDINATES):
            for v in range(w):
                lanes[w * _SUM + v] += abs(lanes[w * (SCALED + COORDINATES * i + j) + v])
        for v in range(w):
            lanes[w * _NORM + v] = max(lanes[w * _NORM + v], lanes[w * _SUM + v])
    for v in range(w):
        part, halvings = period, 0
        while lanes[w * _NORM + v] * part > 0.5 and halvings < _MOST_HALVINGS:
            part *= 0.5
            halvings += 1
        lanes[w * _PART + v], lanes[w * _HALVINGS + v] = part, halvings
        most = max(most, lanes[w * _HALVINGS + v])
    for i in range(COORDINATES * COORDINATES):
        for v in range(w):
            lanes[w * (_EXPONENTIAL + i) + v] = 0.0
    for order in range(_TERMS, 0, -1):
        for i in range(COORDINATES):
            for v in range(w):
                lanes[w * (_EXPONENTIAL + (COORDINATES + 1) * i) + v] += 1.0
        _multiply(lanes, SCALED, _EXPONENTIAL, side_by_side)
        for v in range(w):
            lanes[w * _SUM + v] = lanes[w * _PART + v] / order
        for i in range(COORDINATES * COORDINATES):
            for v in range(w):
                lanes[w * (_EXPONENTIAL + i) + v] = lanes[w * _SUM + v] * lanes[w * (_PRODUCT + i) + v]
    for i in range(COORDINATES):
        for v in range(w):
            lanes[w * (_EXPONENTIAL + (COORDINATES + 1) * i) + v] += 1.0
    for turn in range(int(most)):
        _multiply(lanes, _EXPONENTIAL, _EXPONENTIAL, side_by_side)
        for i in range(COORDINATES * COORDINATES):
            for v in range(w):
                squares = turn < lanes[w * _HALVINGS + v]
                old, new = lanes[w * (_EXPONENTIAL + i) + v], lanes[w * (_PRODUCT + i) + v]
                lanes[w * (_EXPONENTIAL + i) + v] = new if squares else old
    for v in range(w):
        lanes[w * _SUM + v] = 0.0
    for i in range(COORDINATES * COORDINATES):
        for v in range(w):
            lanes[w * _SUM + v] += lanes[w * (_EXPONENTIAL + i) + v] * lanes[w * (_EXPONENTIAL + i) + v]
    for v in range(w):
        lanes[w * GROWN + v] = 0.5 * math.log(lanes[w * _SUM + v])


@kernel
def growth(hold: LinearHold, lanes: Floats, side_by_side: tuple[int, ...]) -> None:
    """Write the logarithms of the norms of exp(D^-1/2 K D^-1/2 T): how deviations of robots without inertia grow.

    Stiffnesses K are symmetric.
    """
    w = len(side_by_side)
    for i in range(COORDINATES):
        for j in range(COORDINATES):
            for v in range(w):
                at = COORDINATES * i + j
                lanes[w * (SCALED + at) + v] = hold.root[i] * lanes[w * (STIFFNESS + at) + v] * hold.root[j]
    log_growth(hold.substep * hold.substeps, lanes, side_by_side)
