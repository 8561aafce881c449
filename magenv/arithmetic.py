"""Sums of products with one rounding a product.

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
