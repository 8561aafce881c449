"""Calm holds: EPMs under which robots at rest nearly stay so, and errors grow little, for robots placed in many ways.

The table is made by ``calm_search``. Holds of robots that are placed alike are where ``steering`` starts from when the
present poses lead to nothing.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.angles import arctan2, sincos, wrap
from magenv.arithmetic import dot2
from magenv.kernels import kernel

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

TABLES = Path(__file__).parent / "data"
_APART, _LINE_RAD, _HALF_RAD = 0.15, 0.4, 0.25
"""Differences that count one: of the separation's logarithm, the line between the robots, half the headings' angle."""


class CalmHolds(NamedTuple):
    """How robots are placed, in the frame that they carry and about their midpoint, and a hold of each."""

    placed: Floats
    """(m, 3) separation (m), direction of the second robot from the first, half of what its heading is more (rad)."""
    epms: Floats
    """(m, N, 6)"""

    @classmethod
    def load(cls, n_epm: int) -> CalmHolds:
        """Return the table for 2 or 3 EPMs."""
        with np.load(TABLES / f"calm-holds-{n_epm}.npz", allow_pickle=False) as stored:
            placed, epms = (stored[name].astype(np.float64) for name in ("placed", "epms"))
        epms[..., 3:] /= np.linalg.norm(epms[..., 3:], axis=-1, keepdims=True)
        return cls(placed, epms)


@kernel
def nearest(table: CalmHolds, state: Floats, heading: float, which: Integers) -> None:
    """Write the rows of the table that are placed most like robots of ``state`` (12,), the most alike first.

    ``heading`` (rad) is that of the frame which the robots carry. Where no such thing can be told, rows are zero.
    """
    x, y = state[3] - state[0], state[4] - state[1]
    apart = math.log(max(math.sqrt(dot2(x, y, x, y)), 1e-9))
    line, half = wrap(arctan2(y, x) - heading), 0.5 * wrap(state[5] - state[2])
    last = len(which) - 1
    which[:] = 0
    distances = np.full(len(which), math.inf)
    for i in range(len(table.placed)):
        p = table.placed[i]
        a, b, d = (math.log(p[0]) - apart) / _APART, wrap(p[1] - line) / _LINE_RAD, (p[2] - half) / _HALF_RAD
        distance = a * a + b * b + d * d
        if distance < distances[last]:
            at = last
            while at > 0 and distance < distances[at - 1]:
                distances[at], which[at] = distances[at - 1], which[at - 1]
                at -= 1
            distances[at], which[at] = distance, i


@kernel
def put_hold(table: CalmHolds, row: int, state: Floats, heading: float, epms: Floats) -> None:
    """Write the EPMs (N, 6) of a row, turned by ``heading`` and moved to where robots of ``state`` (12,) are."""
    sine, cosine = sincos(heading)
    for k in range(len(epms)):
        hold = table.epms[row, k]
        for a in (0, 3):
            epms[k, a], epms[k, a + 1] = cosine * hold[a] - sine * hold[a + 1], sine * hold[a] + cosine * hold[a + 1]
            epms[k, a + 2] = hold[a + 2]
        for a in range(2):
            epms[k, a] += 0.5 * (state[a] + state[3 + a])
