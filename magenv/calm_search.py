"""Make the tables of calm holds: ``python -m magenv.calm_search --help``."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from magenv.calm_holds import TABLES, CalmHolds
from magenv.command import friendly, parse
from magenv.files import write_file
from magenv.forecast import STATE
from magenv.kernels import kernel
from magenv.params import Plant, System, is_whole, require
from magenv.poses import EPM_SIZE, HOME_RADIUS_M
from magenv.reach import EVERYWHERE, project_within
from magenv.steering import descend_calmly
from magenv.steering_cost import Steering, Workspace, workspace

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

SEPARATIONS_M = np.array([0.020, 0.022, 0.024, 0.026, 0.028, 0.030, 0.033, 0.038, 0.046, 0.060])
LINES, HALVES = 16, 12
"""Directions of the second robot from the first, and halves of what its heading is more, evenly all round."""
_PERIOD_S = 0.5
_ITERATIONS = 60
_HELD = 1.0
"""Squared miss up to which a hold is one, as ``steering`` counts it: where errors grow fast, in its beginning."""
_SWEEPS = 4


@dataclass(frozen=True)
class Options:
    """Search for EPMs that hold robots at rest so that errors grow little, for robots placed in many ways.

    From random poses, then from what was found for robots placed alike. Some ten minutes with three EPMs.
    """

    n_epm: int = 2
    """Number of external permanent magnets, 2 or 3."""
    tries: int = 300
    """Random poses from which each hold is sought."""
    seed: int = 0
    """Of these."""
    out: Path | None = None
    """File; by default that of the package."""

    def __post_init__(self) -> None:
        require(self.n_epm in (2, 3), "n_epm", "2 or 3", self.n_epm)
        require(is_whole(self.tries) and self.tries >= 1, "tries", "a whole number of at least 1", self.tries)
        require(is_whole(self.seed) and self.seed >= 0, "seed", "a whole number of at least 0", self.seed)


def grid() -> Floats:
    """Return how robots are placed (10, 16, 12, 3), see ``CalmHolds``."""
    lines = 2.0 * math.pi * np.arange(LINES) / LINES
    halves = math.pi * ((np.arange(HALVES) + 1.0) / HALVES - 0.5)
    return np.stack(np.meshgrid(SEPARATIONS_M, lines, halves, indexing="ij"), axis=-1)


@kernel
def _improve(
    s: Steering, w: Workspace, placed: Floats, limits: Floats, starts: Floats, cost: float, epms: Floats
) -> float:
    """Write the EPMs (N, 6) that hold robots so placed (3,) best, found from ``starts`` (k, N, 6); return their cost.

    Where none is better than ``cost``, nothing is written.
    """
    other, state = np.empty_like(epms), np.zeros(STATE)
    for robot in range(2):
        side = robot - 0.5
        state[3 * robot] = side * placed[0] * math.cos(placed[1])
        state[3 * robot + 1] = side * placed[0] * math.sin(placed[1])
        state[3 * robot + 2] = 2.0 * side * placed[2]
    for start in starts:
        other[:] = start
        project_within(other, limits)
        new, miss = descend_calmly(s, w, state, limits, _ITERATIONS, other)
        if miss <= _HELD and new < cost:
            cost, epms[:] = new, other
    return cost


def _beside(at: tuple[int, ...], shape: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Return the grid points beside one; lines go round."""
    a, b, c = at
    around = [(a - 1, b, c), (a + 1, b, c), (a, (b + 1) % LINES, c), (a, (b - 1) % LINES, c), (a, b, c - 1)]
    around.append((a, b, c + 1))
    return [p for p in around if 0 <= p[0] < shape[0] and 0 <= p[2] < shape[2]]


def search(n_epm: int, tries: int, seed: int) -> CalmHolds:
    """Return the holds that are found, of the grid's points at which there are any; in the same order."""
    system, placed, rng = System(n_epm=n_epm), grid(), np.random.default_rng(seed)
    nothing = CalmHolds(np.zeros((1, 3)), np.zeros((1, n_epm, EPM_SIZE)))
    s = Steering.of(system, Plant(), _PERIOD_S, nothing)
    w, limits = workspace(s), np.array([system.r_min_m, system.r_max_m, system.gap_min_m, *EVERYWHERE])
    starts = rng.normal(size=(tries, n_epm, 2, 3))
    starts /= np.linalg.norm(starts, axis=-1, keepdims=True)
    starts[:, :, 0] *= HOME_RADIUS_M
    shape = placed.shape[:-1]
    epms, costs = np.zeros((*shape, n_epm, EPM_SIZE)), np.full(shape, math.inf)
    random = starts.reshape(tries, n_epm, EPM_SIZE)
    for sweep in range(1 + _SWEEPS):
        for at in track(list(np.ndindex(shape)), f"sweep {sweep + 1} of {1 + _SWEEPS}"):
            beside = [epms[p] for p in _beside(at, shape) if costs[p] < math.inf]
            known = np.array(beside).reshape(len(beside), n_epm, EPM_SIZE)
            cost = float(costs[at])
            costs[at] = _improve(s, w, placed[at], limits, random if sweep == 0 else known, cost, epms[at])
    found = np.isfinite(costs)
    return CalmHolds(placed[found], epms[found])


def run(options: Options) -> None:
    """Search, and write the table."""
    found = search(options.n_epm, options.tries, options.seed)
    path = TABLES / f"calm-holds-{options.n_epm}.npz" if options.out is None else options.out
    content = io.BytesIO()
    np.savez_compressed(content, placed=found.placed.astype(np.float32), epms=found.epms.astype(np.float32))
    write_file(path, content.getvalue())
    print(f"{len(found.placed)} of {grid().size // 3} are held: {path}")


def main() -> None:
    """Run the command line."""
    run(parse(Options))


if __name__ == "__main__":
    friendly(main)
