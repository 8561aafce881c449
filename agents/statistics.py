"""Statistics over few runs of learned agents.

After Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice".

Scores are matrices (runs, tasks): a run is one training, by its seed; a task is what all runs are measured on.
Intervals are 95 % bootstrap intervals, percentile method, always from the same resamples. As in the paper, runs are
resampled within each task, independently of the other tasks; with ``whole_runs`` a run's scores are resampled together.
That is for scores of one agent on many tasks, which are good or bad together: independent resamples would tell too
little of the doubt. Infinite scores are allowed where only their order counts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.metrics import CONFIDENCE, Interval
from magenv.params import require

Floats = NDArray[np.float64]
Statistic = Callable[..., Floats]
"""Score matrices (..., runs, tasks), as many as it takes, to numbers (..., *shape)."""

RESAMPLES = 5000
_CUT = 0.25
_AT_ONCE = 2_000_000
"""Scores resampled at once, which bounds the memory."""


def as_scores(scores: ArrayLike, name: str = "scores") -> Floats:
    """Return a score matrix (runs, tasks), or raise ``InputError`` where it is none."""
    matrix = np.asarray(scores, np.float64)
    fits = matrix.ndim == 2 and matrix.size > 0 and not np.isnan(matrix).any()
    require(fits, name, "a matrix of runs and tasks without NaN", f"shape {matrix.shape}")
    return matrix


def interquartile_mean(scores: Floats) -> Floats:
    """Return the mean of the middle half of all scores (..., runs, tasks), of each matrix.

    Of n scores the least and the greatest n/4, rounded down, are left out.
    """
    flat = np.sort(scores.reshape(*scores.shape[:-2], -1))
    cut = int(_CUT * flat.shape[-1])
    return cast("Floats", flat[..., cut : flat.shape[-1] - cut].mean(axis=-1))


def share_above(scores: Floats, thresholds: ArrayLike) -> Floats:
    """Return the share of all scores (..., runs, tasks) above each of the thresholds (k,): (..., k), a profile."""
    flat = scores.reshape(*scores.shape[:-2], -1)
    return np.stack([(flat > tau).mean(axis=-1) for tau in np.asarray(thresholds, np.float64)], axis=-1)


def probability_of_improvement(better: Floats, than: Floats) -> Floats:
    """Return the chance that a run of ``better`` scores above one of ``than`` on a task, mean over the tasks.

    Ties count half, as in the statistic of Mann and Whitney.

    Parameters
    ----------
    better, than : ndarray, shapes (..., runs, tasks)
        Scores of both on the same tasks, of any number of runs each.
    """
    mine, theirs = better[..., :, None, :], than[..., None, :, :]
    return cast("Floats", ((mine > theirs) + 0.5 * (mine == theirs)).mean(axis=(-3, -2, -1)))


def bounds(statistic: Statistic, *scores: ArrayLike, whole_runs: bool = False, seed: int = 0) -> Floats:
    """Return the 95 % bootstrap interval of a statistic: lower and upper bounds (2, *shape).

    Parameters
    ----------
    statistic : callable
        Of as many matrices as are given; each is resampled for itself.
    *scores : array, shapes (runs, tasks)
        A single run leaves nothing to resample: the bounds are then the value.
    whole_runs : bool
        Whether a run's scores are resampled together.
    seed : int
        Of the resamples.

    Raises
    ------
    ValueError
        If a matrix is none, or has NaN.
    """
    matrices = [as_scores(matrix) for matrix in scores]
    rng = np.random.default_rng(seed)
    at_once = max(1, _AT_ONCE // sum(matrix.size for matrix in matrices))
    values = []
    for begun in range(0, RESAMPLES, at_once):
        count = min(at_once, RESAMPLES - begun)
        values.append(statistic(*(_resampled(matrix, count, whole_runs, rng) for matrix in matrices)))
    low, high = 0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE
    return cast("Floats", np.quantile(np.concatenate(values), (low, high), axis=0))


def interval(statistic: Statistic, *scores: ArrayLike, whole_runs: bool = False, seed: int = 0) -> Interval:
    """Return the interval of a statistic that is a single number (see ``bounds``)."""
    low, high = bounds(statistic, *scores, whole_runs=whole_runs, seed=seed)
    return float(low), float(high)


def _resampled(matrix: Floats, count: int, whole_runs: bool, rng: np.random.Generator) -> Floats:
    """Return ``count`` resamples (count, runs, tasks)."""
    runs, tasks = matrix.shape
    if whole_runs:
        return matrix[rng.integers(runs, size=(count, runs))]
    return matrix[rng.integers(runs, size=(count, runs, tasks)), np.arange(tasks)]
