"""How far EPM centres keep from each other and from points, with slopes by the pose vector: for SciPy's optimisers."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magenv.poses import POSE_SIZE, to_cartesian

Floats = NDArray[np.float64]


def _centre_slopes(x: Floats) -> Floats:
    """Return the derivatives of the centres by azimuth, elevation and radius, (N, 3, 3): [k, by, axis]."""
    azimuth, elevation, radius = x.reshape(-1, POSE_SIZE)[:, :3].T
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    by_azimuth = np.stack([-radius * ce * sa, radius * ce * ca, np.zeros_like(ca)], axis=-1)
    by_elevation = np.stack([-radius * se * ca, -radius * se * sa, radius * ce], axis=-1)
    by_radius = np.stack([ce * ca, ce * sa, se], axis=-1)
    return np.stack([by_azimuth, by_elevation, by_radius], axis=1)


def gap_margins(x: Floats, gap: float) -> tuple[Floats, Floats]:
    """Return by how much every two centres are farther apart than the gap, over the gap, and the slopes by the pose."""
    n, slopes_of = len(x) // POSE_SIZE, _centre_slopes(x)
    centres, _ = to_cartesian(x)
    first, second = np.triu_indices(n, 1)
    apart = centres[first] - centres[second]
    distance = np.linalg.norm(apart, axis=-1)
    slopes = np.zeros((len(first), len(x)))
    for row, (j, k) in enumerate(zip(first, second, strict=True)):
        along = apart[row] / distance[row] / gap
        slopes[row, POSE_SIZE * j : POSE_SIZE * j + 3] = slopes_of[j] @ along
        slopes[row, POSE_SIZE * k : POSE_SIZE * k + 3] = -slopes_of[k] @ along
    return distance / gap - 1.0, slopes


def clearances(x: Floats, points: Floats, least: float) -> tuple[Floats, Floats]:
    """Return by how much every centre is farther from every point (n, 3) than ``least``, over it, and the slopes."""
    n, slopes_of = len(x) // POSE_SIZE, _centre_slopes(x)
    centres, _ = to_cartesian(x)
    apart = centres[:, None] - points
    distance = np.linalg.norm(apart, axis=-1)
    slopes = np.zeros((n, len(points), len(x)))
    for k in range(n):
        slopes[k, :, POSE_SIZE * k : POSE_SIZE * k + 3] = (apart[k] / distance[k][:, None] / least) @ slopes_of[k].T
    return (distance / least - 1.0).ravel(), slopes.reshape(-1, len(x))


def minimise_within(
    cost: Callable[[Floats], float],
    slopes: Callable[[Floats], Floats],
    margins: Callable[[Floats], Floats],
    margin_slopes: Callable[[Floats], Floats],
    low: Floats,
    high: Floats,
    start: Floats,
    options: Any,
) -> tuple[Floats, float]:
    """Minimise ``cost`` where no margin is negative, within bounds, by SciPy's SLSQP; return where, and the cost there.

    Whether the margins hold there is for the caller to see.
    """
    from scipy.optimize import Bounds, NonlinearConstraint, minimize  # a quarter of a second that few need

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of steps that were clipped to the bounds
        found = minimize(
            cost,
            start,
            jac=slopes,
            method="SLSQP",
            bounds=Bounds(low, high),
            constraints=NonlinearConstraint(margins, 0.0, np.inf, jac=margin_slopes),
            options=options,
        )
    return found.x, float(found.fun)
