"""Threads that share the rows of a batch.

Plain Python threads round kernels that release the interpreter lock: they sleep between calls, and a forked child makes
its own. (Numba's own pools spin, abort on concurrent use or do not survive a fork, depending on the layer.)
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from magenv.params import is_whole, require


class Workers:
    """Runs kernels over rows on ``threads`` threads, the calling one included; the bits do not depend on how many."""

    def __init__(self, threads: int = 1) -> None:
        require(is_whole(threads) and threads >= 1, "threads", "a whole number of at least 1", threads)
        self.threads = threads
        self._pool: ThreadPoolExecutor | None = None
        self._owner = 0

    def __reduce__(self) -> tuple[type[Workers], tuple[int]]:
        return Workers, (self.threads,)

    def run(self, kernel: Callable[..., None], rows: int, *arguments: Any) -> None:
        """Call ``kernel(first, last, *arguments)`` such that the ranges cover all rows once."""
        if self.threads == 1 or rows < 2 * self.threads:
            kernel(0, rows, *arguments)
            return
        if self._pool is None or self._owner != os.getpid():  # threads do not survive a fork
            self._pool, self._owner = ThreadPoolExecutor(self.threads - 1, "magenv"), os.getpid()
        ends = [rows * k // self.threads for k in range(self.threads + 1)]
        others = [self._pool.submit(kernel, *part, *arguments) for part in itertools.pairwise(ends[1:])]
        kernel(ends[0], ends[1], *arguments)
        for other in others:
            other.result()
