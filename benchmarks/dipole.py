"""Dipole field and gradient, against magpylib and against what core and memory can do at most."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numba
import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import EXTRA, Contestant, Effort, installed, side_by_side
from benchmarks.peak import multiply_adds
from benchmarks.table import LeftOut, Limit, Line, Row, text
from benchmarks.traffic import traffic
from magenv.dipole import dipole_field, dipole_gradient, field, field_and_gradient

TITLE = "Dipole"

FLOPS = 61
"""Floating point operations of field and gradient of one pair by the common formulas, a division and a square root
among them: the measure of the work, however it is done."""
BYTES = 8 * (3 + 3 + 3 + 9)
"""What field and gradient of one pair read (moment, point; all have one source) and write."""
CALLS = 20
"""Calls in a turn: a single one would measure the caches that the contestant before has left."""
BLOCKS, LANES = 8, 32
"""Pairs that stay in the nearest cache."""


@numba.njit(error_model="numpy", nogil=True)
def _in_cache(loops: int, blocks: NDArray[np.float64]) -> None:
    """Compute field and gradient in blocks (any, 15, ``LANES``) again and again: the laws without their arrays.

    Rows 0 to 2 of a block are the moments, 3 to 5 the offsets, the rest results. IEEE arithmetic, as in the product.
    """
    for _ in range(loops):
        for k in range(len(blocks)):
            b = blocks[k]
            for i in range(LANES):
                mx, my, mz, rx, ry, rz = b[0, i], b[1, i], b[2, i], b[3, i], b[4, i], b[5, i]
                b[6, i], b[7, i], b[8, i] = dipole_field(mx, my, mz, rx, ry, rz)
                xx, xy, xz, yy, yz, zz = dipole_gradient(mx, my, mz, rx, ry, rz)
                b[9, i], b[10, i], b[11, i], b[12, i], b[13, i], b[14, i] = xx, xy, xz, yy, yz, zz


def _calls(call: Callable[[], object], units: int) -> Contestant:
    """Return a contestant that makes ``CALLS`` calls of so many units each."""

    def run() -> None:
        for _ in range(CALLS):
            call()

    return Contestant(run, CALLS * units)


def measure(effort: Effort) -> Iterator[Line]:
    """Measure all of this part."""
    n = effort.pairs
    rng = np.random.default_rng(0)
    moments, offsets = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    source = np.zeros(3)
    blocks, loops = rng.normal(size=(BLOCKS, 15, LANES)), 1 + CALLS * n // (BLOCKS * LANES)
    contestants = {
        "field": _calls(lambda: field(moments, source, offsets), n),
        "field and gradient": _calls(lambda: field_and_gradient(moments, source, offsets), n),
        "in cache": Contestant(lambda: _in_cache(loops, blocks), loops * BLOCKS * LANES),
        "moving field": _calls(*traffic(n, to_gradient=False, past_caches=False)),
        "moving field and gradient": _calls(*traffic(n, to_gradient=True, past_caches=False)),
        "moving past caches": _calls(*traffic(n, to_gradient=True, past_caches=True)),
        "peak": multiply_adds(1),
    }
    if installed("magpylib"):
        from magpylib.core import dipole_Hfield

        contestants["magpylib"] = _calls(lambda: dipole_Hfield(offsets, moments), n)
    else:
        yield LeftOut("magpylib", f"magpylib is not installed: {EXTRA}")
    times = side_by_side(contestants, effort.repeats)
    pairs = f"{n:,} pairs"
    for name in ("field", "field and gradient"):
        moving = f"moving {name}"
        if "magpylib" in contestants:
            theirs, ratio = times.rate("magpylib"), times.speedup(name, "magpylib")
            bound = text(times.speedup(moving, "magpylib"), "x")
            note = f"bound by memory: reading and writing the same numbers alone is {bound}"
            peer = "magpylib.core, field alone"
            yield Row(f"{name}, {pairs}", times.rate(name), "pairs/s", peer, theirs, ratio, Limit(15.0), note)
    peak, wanted = times.rate("peak"), Limit(0.35)
    bound = text(FLOPS * times.speedup("moving field and gradient", "peak"), "x")
    for name, where, note in (
        ("field and gradient", pairs, f"{FLOPS} flops a pair; bound by memory, whose rate allows {bound} of the peak"),
        ("in cache", "in cache", f"{FLOPS} flops a pair; the laws without reading and writing arrays"),
    ):
        flops, share = FLOPS * times.rate(name), FLOPS * times.speedup(name, "peak")
        yield Row(f"field and gradient, {where}", flops, "flop/s", "peak of one core", peak, share, wanted, note)
    past = text(times.speedup("moving past caches", "moving field and gradient"), "x")
    for name, size, note in (
        ("field", BYTES - 72, ""),
        ("field and gradient", BYTES, f"; non-temporal stores are {past} as fast as these"),
    ):
        moving = f"moving {name}"
        share, note = times.speedup(name, moving), f"{size} bytes a pair{note}"
        what, peer = f"{name}, {pairs}, memory", "reading and writing alone"
        yield Row(what, size * times.rate(name), "B/s", peer, size * times.rate(moving), share, note=note)
