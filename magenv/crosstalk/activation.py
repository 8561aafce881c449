"""Activation of each of the ten wrench components, and the crosstalk that comes with it (paper, section III-A)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.allocation import allocate_batch, checked_components, component_scales
from magenv.params import System, require
from magenv.wrench import WRENCH_SIZE, planar_moments

Floats = NDArray[np.float64]

COMPONENTS = tuple(f"{name} {robot}" for robot in (1, 2) for name in ("tau_y", "tau_z", "F_x", "F_y", "F_z"))
"""The components of U by index: torque about y and z, force along x, y and z of the magnet frames of robots 1 and 2."""


def is_positive(value: object) -> bool:
    """Return whether a value is a positive, finite number."""
    return not isinstance(value, bool) and isinstance(value, Real) and 0.0 < float(value) < math.inf


@dataclass(frozen=True)
class Pair:
    """Two robots on the x axis, as far from the workspace centre as each other, their magnets in the plane."""

    distance_m: float
    angle_deg: float = 0.0
    """Angle from the first robot's moment to the second's; 0 is parallel, 90 orthogonal."""
    first_deg: float = 0.0
    """Angle of the first robot's moment against the line from it to the second: 0 in line with it, 90 side by side."""
    second_ratio: float = 1.0
    """Moment of the second robot's magnet over that of the first."""

    def __post_init__(self) -> None:
        for name in ("distance_m", "second_ratio"):
            require(is_positive(getattr(self, name)), name, "a positive, finite number", getattr(self, name))
        for name in ("angle_deg", "first_deg"):
            value = getattr(self, name)
            fits = not isinstance(value, bool) and isinstance(value, Real) and math.isfinite(value)
            require(fits, name, "a finite number", value)

    @property
    def positions(self) -> Floats:
        """Positions (2, 3) in m."""
        return np.array([[-0.5 * self.distance_m, 0.0, 0.0], [0.5 * self.distance_m, 0.0, 0.0]])

    def moments(self, system: System) -> Floats:
        """Return the moments (2, 3) in A m^2."""
        headings = np.radians([self.first_deg, self.first_deg + self.angle_deg])
        moments: Floats = planar_moments(headings, system.ipm_moment_am2) * np.array([[1.0], [self.second_ratio]])
        return moments


@dataclass(frozen=True)
class Activations:
    """What was found for targets of which one component each is not zero; arrays over these components."""

    component: NDArray[np.int64]
    """Index into U (n)."""
    target: Floats
    """Wanted U (n, 10), N m and N."""
    pose: Floats
    """EPM poses (n, 5 N)."""
    wrench: Floats
    """U at these poses (n, 10), N m and N."""

    @property
    def reached(self) -> Floats:
        """|U_i| over its target (n)."""
        rows = np.arange(len(self.component))
        return np.abs(self.wrench[rows, self.component] / self.target[rows, self.component])


def activate(
    pair: Pair,
    system: System,
    amplitude: float,
    *,
    components: Sequence[int] = range(WRENCH_SIZE),
    starts: int = 10,
    seed: int = 0,
) -> Activations:
    """Ask for each component alone, all others zero, and find the EPM poses that come nearest.

    Parameters
    ----------
    pair : Pair
        The robots.
    system : System
        Magnets and limits.
    amplitude : float
        Target as a share of the paper's 0.5 N and 0.05 N m.
    components : sequence of int
        Indices into U.
    starts, seed : int
        Random starts of the optimiser and their seed.

    Raises
    ------
    ValueError
        If the amplitude is not positive, or a component is none of U's.
    """
    require(is_positive(amplitude), "amplitude", "a positive, finite number", amplitude)
    chosen = np.array(checked_components(components), dtype=np.int64)
    target = amplitude * component_scales() * (np.arange(WRENCH_SIZE) == chosen[:, None])
    found = allocate_batch(target, pair.positions, pair.moments(system), system, starts=starts, seed=seed)
    return Activations(chosen, target, found.pose, found.wrench)


def crosstalk(wrench: ArrayLike, component: ArrayLike, scale: ArrayLike = 1.0) -> Floats:
    """Return C(U, i) = max over j != i of |U_j| / |U_i| (paper, section III-A); infinite where U_i is zero.

    Parameters
    ----------
    wrench : array_like, shape (..., 10)
        U in N m and N.
    component : array_like of int, shape (...)
        The index i.
    scale : array_like, shape (10,), optional
        What each component is divided by before; without, N and N m are mixed, as in the paper's formula.

    Raises
    ------
    ValueError
        If the wrench has not ten components.
    """
    u = np.abs(np.asarray(wrench, dtype=np.float64) / np.asarray(scale, dtype=np.float64))
    require(u.shape[-1:] == (WRENCH_SIZE,), "wrench", f"an array of shape (..., {WRENCH_SIZE})", u.shape)
    i = np.asarray(component)
    fits = bool(np.isin(i, np.arange(WRENCH_SIZE)).all())
    require(fits, "component", f"indices from 0 to {WRENCH_SIZE - 1}", component)
    own = np.arange(WRENCH_SIZE) == i[..., None]
    wanted, others = np.where(own, u, 0.0).sum(axis=-1), np.where(own, 0.0, u).max(axis=-1)
    ratio: Floats = np.divide(others, wanted, out=np.full(wanted.shape, np.inf), where=wanted > 0)
    return ratio
