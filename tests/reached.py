"""How far EPMs are from the arms that carry them, and poses of which many are out of the arms' reach."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from numpy.typing import NDArray

from magenv.params import PLANTS, System
from magenv.poses import pose_bounds, to_cartesian
from magenv.reach import Shell, project_reach, shoulder

Floats = NDArray[np.float64]

PLANT = dataclasses.replace(PLANTS["arm-reach"], latency_s=0.0)
"""Commands act at once."""
SHELL = Shell.of(System(), PLANT)


def away(centres: Floats) -> Floats:
    """Distances (..., N) of centres (..., N, 3) from their arms' shoulders."""
    n_epm = centres.shape[-2]
    bases = np.array([shoulder(SHELL, k, n_epm) for k in range(n_epm)])
    distances: Floats = np.linalg.norm(centres - bases, axis=-1)
    return distances


def beyond(centres: Floats) -> float:
    """By how much centres (..., N, 3) are out of reach, m."""
    distances = away(centres)
    return float(max(SHELL.inner - distances.min(), distances.max() - SHELL.outer))


def nearest_pair(centres: Floats) -> float:
    """Least distance of two EPMs of (..., N, 3)."""
    pairs = itertools.combinations(range(centres.shape[-2]), 2)
    return min(float(np.linalg.norm(centres[..., j, :] - centres[..., k, :], axis=-1).min()) for j, k in pairs)


def anywhere(rng: np.random.Generator, system: System) -> Floats:
    """EPMs (N, 6) anywhere within the bounds of poses."""
    return np.concatenate(to_cartesian(rng.uniform(*pose_bounds(system))), axis=-1)


def project(epms: Floats, system: System) -> bool:
    return bool(project_reach(epms, system.r_min_m, system.r_max_m, system.gap_min_m, SHELL))
