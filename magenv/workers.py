"""Threads that share the rows of a batch.

Plain Python threads round kernels that release the interpreter lock: they sleep between calls, and a forked child makes
its own. (Numba's own pools spin, abort on concurrent use or do not survive a fork, depending on the layer.)
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from magenv.params import is_whole, require


class Workers:
    """Runs kernels over rows on ``threads`` threads, the calling one included; the bits do not depend on how many.

    Each takes an equal share of the rows; or, where some rows take far longer than others, ``at_once`` of them, and
    then the next that nobody has taken.
    """

    def __init__(self, threads: int = 1, at_once: int | None = None) -> None:
        require(is_whole(threads) and threads >= 1, "threads", "a whole number of at least 1", threads)
        self.threads = threads
        self._at_once = at_once
        self._pool: ThreadPoolExecutor | None = None
        self._owner = 0

    def __reduce__(self) -> tuple[type[Workers], tuple[int, int | None]]:
        return Workers, (self.threads, self._at_once)

    def run(self, kernel: Callable[..., None], rows: int, *arguments: Any) -> None:
        """Call ``kernel(first, last, *arguments)`` such that the ranges cover all rows once."""
        if self.threads == 1 or rows < 2 * self.threads:
            kernel(0, rows, *arguments)
            return
        if self._pool is None or self._owner != os.getpid():  # threads do not survive a fork
            self._pool, self._owner = ThreadPoolExecutor(self.threads - 1, "magenv"), os.getpid()
        share = math.ceil(rows / self.threads)
        ends = [*range(0, rows, min(share, self._at_once or share)), rows]
        parts = iter([*itertools.pairwise(ends)])  # a list's iterator, which no thread can leave between two steps

        def work() -> None:
            for first, last in parts:  # one iterator for all: each part is taken once
                kernel(first, last, *arguments)

        others = [self._pool.submit(work) for _ in range(self.threads - 1)]
        work()
        for other in others:
            other.result()
