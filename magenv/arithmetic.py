"""Sums of products with one rounding a product, and the inverse square root made of them.

Modern processors multiply and add in one instruction (FMA), in the time of either. That it is asked for by name, and
not left to the compiler, keeps the bits the same in every loop and on every processor.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from numba import types
from numba.extending import intrinsic

from magenv.kernels import law


def _fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


fma = cast("Callable[[float, float, float], float]", intrinsic(_fma))
"""``fma(a, b, c)``: a b + c, rounded once."""


@law
def dot2(ax: float, ay: float, bx: float, by: float) -> float:
    """Return a . b of vectors in the plane."""
    return fma(ax, bx, ay * by)


@law
def dot3(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    """Return a . b of vectors in space."""
    return fma(ax, bx, fma(ay, by, az * bz))


@law
def cross2(ax: float, ay: float, bx: float, by: float) -> float:
    """Return the z component of a x b of vectors in the plane."""
    return fma(ax, by, -(ay * bx))


def _guess_root(typing_context: Any, x: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        integer = context.get_value_type(types.int64)
        half = builder.lshr(builder.bitcast(arguments[0], integer), integer(1))
        return builder.bitcast(builder.sub(integer(0x5FE6EB50C7B537A9), half), arguments[0].type)

    return types.float64(types.float64), generate


_guess = cast("Callable[[float], float]", intrinsic(_guess_root))
"""1 / sqrt(x) to 3.5 %, by the bits of x as an integer: its exponent halved and negated.

The constant is that of Robertson, "A brief history of InvSqrt", thesis, University of New Brunswick (2012).
"""


@law
def inverse_root(x: float) -> float:
    """Return 1 / sqrt(x), at most two units in the last place off, for x from 1e-290 to 1e290.

    Division and square root would take half of a dipole's time. Instead two steps of Householder's iteration
    y (1 + h / 2 + 3 h^2 / 8 + ...), h = 1 - x y^2: of third order with the coefficients that serve the guess's whole
    range of h best, then of fourth. Zero gives a number above 1e154, of which the third power is infinite; infinity and
    NaN give NaN.
    """
    y = _guess(x)
    h = fma(-(x * y), y, 1.0)
    y = fma(y * h, fma(h, 0.37554678, 0.50109439), y)
    h = fma(-(x * y), y, 1.0)
    return fma(y * h, fma(h, fma(h, 0.3125, 0.375), 0.5), y)
