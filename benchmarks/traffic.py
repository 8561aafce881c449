"""What memory can do at most: reading and writing what field and gradient of pairs read and write, without them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.extending import intrinsic
from numpy.typing import NDArray

Floats = NDArray[np.float64]

BLOCK = 32
"""Pairs at a time."""
_LINE = 8
"""Numbers of a cache line."""


@intrinsic
def _store_past_caches(_: Any, out: Any, at: Any, line: Any) -> Any:
    """Write the eight numbers of ``line`` to ``out`` from ``at`` on, a whole cache line, by a non-temporal store.

    Such a store need not read the line that it overwrites.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = ir.VectorType(ir.DoubleType(), _LINE).as_pointer()
        target, source = (context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 2))
        numbers = builder.load(builder.bitcast(source, vector), align=8)
        store = builder.store(numbers, builder.bitcast(builder.gep(target, [arguments[1]]), vector), align=8 * _LINE)
        store.set_metadata("nontemporal", builder.module.add_metadata([ir.Constant(ir.IntType(32), 1)]))
        return context.get_dummy_value()

    return numba.types.void(out, numba.types.intp, line), generate


@numba.njit(nogil=True)
def _through_caches(moments: Floats, points: Floats, fields: Floats, gradients: Floats, sums: Floats) -> None:
    size = 3 * BLOCK
    for block in range(len(fields) // size):
        first = size * block
        m, p, b = moments[first : first + size], points[first : first + size], fields[first : first + size]
        g = gradients[3 * first : 3 * (first + size)]
        for i in range(size):
            sums[i] = m[i] + p[i]
        for i in range(size):
            b[i] = sums[i]
        if len(gradients) > 0:
            for row in range(3):
                for i in range(size):
                    g[row * size + i] = sums[i]


@numba.njit(nogil=True)
def _past_caches(moments: Floats, points: Floats, fields: Floats, gradients: Floats, sums: Floats) -> None:
    size = 3 * BLOCK
    for first in range(0, len(fields), size):
        for i in range(size):
            sums[i] = moments[first + i] + points[first + i]
        for i in range(0, size, _LINE):
            _store_past_caches(fields, first + i, sums[i : i + _LINE])  # type: ignore[call-arg]
        if len(gradients) > 0:
            for i in range(0, 3 * size, _LINE):
                _store_past_caches(gradients, 3 * first + i, sums[i % size : i % size + _LINE])  # type: ignore[call-arg]


def _aligned(size: int) -> Floats:
    """Return ones, the first of which begins a cache line."""
    array = np.ones(size + _LINE)
    begin = -(array.ctypes.data // array.itemsize) % _LINE
    return array[begin : begin + size]


def traffic(pairs: int, to_gradient: bool, past_caches: bool) -> tuple[Callable[[], None], int]:
    """Return what moves the numbers of so many pairs, always the same arrays, and of how many: whole blocks only."""
    count = BLOCK * max(1, pairs // BLOCK)
    arrays = [_aligned(3 * count) for _ in range(3)]
    arrays += [_aligned(9 * count if to_gradient else 0), _aligned(3 * BLOCK)]
    move = _past_caches if past_caches else _through_caches
    return lambda: move(*arrays), count
