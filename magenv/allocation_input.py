"""What ``magenv.allocation`` takes in: checked arrays, and the random starts."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.kernels import kernel
from magenv.params import System, is_whole, require
from magenv.poses import POSE_SIZE, pose_bounds
from magenv.wrench import WRENCH_SIZE

Floats = NDArray[np.float64]

_LEAST_M = 1e-6
"""Nearer robots cannot be: their mutual wrench grows beyond all numbers."""
_MOST = 1e9
"""Size of any number taken in, SI units: far beyond all magnets, far from what overflows."""


def random_starts(system: System, starts: int, rng: np.random.Generator) -> Floats:
    """Draw pose vectors (starts, 5 N) uniformly within their bounds."""
    low, high = pose_bounds(system)
    return rng.uniform(low, high, size=(starts, len(low)))


@lru_cache(maxsize=16)
def _seeded_starts(system: System, starts: int, seed: int) -> Floats:
    """Return ``random_starts`` of a seed: drawing them takes longer than a warm start."""
    drawn = random_starts(system, starts, np.random.default_rng(seed))
    drawn.flags.writeable = False
    return drawn


@kernel
def _all_within(values: Floats) -> bool:
    within = True
    for value in values:
        within = within and abs(value) <= _MOST  # false for NaN
    return within


@kernel
def _fault(target: Floats, positions: Floats, moments: Floats, initial: Floats) -> int:
    """Return the index of the first rule in ``_RULES`` that flat arrays of problems break, -1 where none."""
    if not _all_within(target):
        return 0
    if not _all_within(positions):
        return 1
    if not _all_within(moments):
        return 2
    for i in range(0, len(positions), 6):
        squared = 0.0
        for k in range(i, i + 3):
            squared += (positions[k] - positions[k + 3]) ** 2
        if not squared > _LEAST_M**2:
            return 3
    for i in range(0, len(moments), 3):
        if not moments[i] ** 2 + moments[i + 1] ** 2 + moments[i + 2] ** 2 > 0.0:
            return 4
    return -1 if _all_within(initial) else 5


_SANE = f"finite, of at most {_MOST:g} in size"
_RULES = (
    ("target", _SANE),
    ("positions", _SANE),
    ("moments", _SANE),
    ("positions", f"of two robots over {_LEAST_M:g} m apart from each other"),
    ("moments", "other than zero"),
    ("initial", _SANE),
)
"""What the numbers must be."""
_NONE = np.empty(0)


def _shaped(name: str, value: ArrayLike, own: tuple[int, ...], leading: bool) -> Floats:
    """Return ``value`` as an array of shape ``own``, or (..., *own) where leading axes are allowed."""
    array = np.ascontiguousarray(value, dtype=np.float64)
    axes = array.ndim - len(own)
    if array.shape != own and not (leading and axes >= 0 and array.shape[axes:] == own):
        require(False, name, f"an array of shape {('...', *own) if leading else own}", array.shape)
    return array


def checked_problem(
    target: ArrayLike,
    positions: ArrayLike,
    moments: ArrayLike,
    initial: ArrayLike | None,
    system: System,
    leading: bool,
) -> tuple[Floats, Floats, Floats, Floats | None]:
    """Return the checked target, positions, moments and initial pose."""
    u_d = _shaped("target", target, (WRENCH_SIZE,), leading)
    p, m = _shaped("positions", positions, (2, 3), leading), _shaped("moments", moments, (2, 3), leading)
    first = None if initial is None else _shaped("initial", initial, (POSE_SIZE * system.n_epm,), leading)
    warm = _NONE if first is None else first
    fault = _fault(u_d.reshape(-1), p.reshape(-1), m.reshape(-1), warm.reshape(-1))
    if fault >= 0:
        name, must_be = _RULES[fault]
        require(False, name, must_be, {"target": u_d, "positions": p, "moments": m, "initial": warm}[name].tolist())
    return u_d, p, m, first


def check_limits(tolerance: float, max_iterations: int) -> None:
    """Raise ``InputError`` unless these are what a descent can stop at."""
    require(0.0 <= tolerance < math.inf, "tolerance", "a finite number of at least 0", tolerance)
    whole = is_whole(max_iterations) and max_iterations >= 0
    require(whole, "max_iterations", "a whole number of at least 0", max_iterations)


def draw_starts(system: System, starts: int, seed: int | np.random.Generator, warm: bool) -> Floats:
    """Return the random starts (starts, 5 N)."""
    enough = is_whole(starts) and starts >= (0 if warm else 1)
    require(enough, "starts", "a whole number of at least 1 (0 with an initial pose)", starts)
    if isinstance(seed, np.random.Generator):
        return random_starts(system, starts, seed)
    require(is_whole(seed) and seed >= 0, "seed", "a whole number of at least 0 or a numpy Generator", seed)
    return _seeded_starts(system, starts, int(seed))
