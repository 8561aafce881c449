"""Dipole field and gradient, against magpylib and against what the core can do at most."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.measure import EXTRA, Contestant, Effort, installed, side_by_side
from benchmarks.peak import multiply_adds
from benchmarks.table import LeftOut, Limit, Line, Row
from magenv.dipole import field, gradient

TITLE = "Dipole"

FLOPS = 61
"""Floating point operations of field and gradient of one pair, a division and a square root among them."""


def measure(effort: Effort) -> Iterator[Line]:
    """Measure all of this part."""
    n = effort.pairs
    rng = np.random.default_rng(0)
    moments, offsets = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    source = np.zeros(3)

    def both() -> None:
        field(moments, source, offsets)
        gradient(moments, source, offsets)

    contestants = {
        "field": Contestant(lambda: field(moments, source, offsets), n),
        "field and gradient": Contestant(both, n),
        "peak": multiply_adds(1),
    }
    if installed("magpylib"):
        from magpylib.core import dipole_Hfield

        contestants["magpylib"] = Contestant(lambda: dipole_Hfield(offsets, moments), n)
    else:
        yield LeftOut("magpylib", f"magpylib is not installed: {EXTRA}")
    times = side_by_side(contestants, effort.repeats)
    pairs = f"{n:,} pairs"
    for name in ("field", "field and gradient"):
        if "magpylib" in contestants:
            theirs, ratio = times.rate("magpylib"), times.speedup(name, "magpylib")
            peer = "magpylib.core, field alone"
            yield Row(f"{name}, {pairs}", times.rate(name), "pairs/s", peer, theirs, ratio, Limit(15.0))
    share = FLOPS * times.speedup("field and gradient", "peak")
    flops, peak = FLOPS * times.rate("field and gradient"), times.rate("peak")
    note = f"{FLOPS} flops a pair"
    yield Row(f"field and gradient, {pairs}", flops, "flop/s", "peak of one core", peak, share, Limit(0.35), note)
