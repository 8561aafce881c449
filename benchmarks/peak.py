"""What a core can do at most: fused multiply-adds, and how many cores the machine really gives at the moment."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Contestant

LANES = 64
"""Independent sums: enough to hide the latency of a fused multiply-add in every vector unit."""
LOOPS = 5_000_000


@numba.njit(fastmath={"contract"}, nogil=True)
def _multiply_add(loops: int, factor: float, term: float, sums: NDArray[np.float64]) -> None:
    """Compute sums = sums * factor + term again and again: ``LANES`` chains of fused multiply-adds, kept in registers.

    The peak measured so is that of the vectors numba compiles for, which is what our kernels have.
    """
    for _ in range(loops):
        for lane in range(LANES):
            sums[lane] = sums[lane] * factor + term


def multiply_adds(threads: int) -> Contestant:
    """Return a contestant whose units are floating point operations, the work shared among threads."""
    pool = ThreadPoolExecutor(threads)

    def one(loops: int) -> None:
        _multiply_add(loops, 0.999, 1e-9, np.ones(LANES))

    def run() -> None:
        list(pool.map(one, [LOOPS // threads] * threads))

    return Contestant(run, 2 * LANES * (LOOPS // threads) * threads, cores=threads)


def gain_of_two(speedup: float) -> str:
    """Return the note that stands beside two threads against one."""
    return f"multiply-adds without memory gain {speedup:.3g} x here and now"
