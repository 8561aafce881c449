"""Stability of a hold: how fast a small deviation in the plane grows while the EPMs stand still.

Earnshaw's theorem forbids that all directions in space are stable, not that all in a plane are, whose normal is borne.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.crosstalk.activation import Pair, is_positive
from magenv.params import Body, System, require
from magenv.stiffness import planar_stiffness

Floats = NDArray[np.float64]


def growth_rates(pair: Pair, system: System, pose: ArrayLike, body: Body) -> NDArray[np.complex128]:
    """Return the rates (12, 1/s) at which small deviations from a hold grow, the fastest first; real parts above 0 do.

    They are the eigenvalues of the linear motion M q'' + D q' = K q of both robots' x, y and heading, of mass and
    inertia M, viscous drag D and magnetic stiffness K (see ``magenv.stiffness``).

    Parameters
    ----------
    pair : Pair
        The robots.
    system : System
        Magnets.
    pose : array_like, shape (5 N,)
        EPM poses of the hold.
    body : Body
        Mass, inertia, drag.
    """
    stiffness = planar_stiffness(pair.positions, pair.moments(system), pose, system.epm_moment_am2)
    inertia = np.tile([body.mass_kg, body.mass_kg, body.inertia_kgm2], 2)
    drag = np.tile([body.drag_linear_nspm, body.drag_linear_nspm, body.drag_rotational_nmsprad], 2)
    motion = np.zeros((12, 12))
    motion[:6, 6:] = np.eye(6)
    motion[6:, :6] = stiffness / inertia[:, None]
    motion[6:, 6:] = np.diag(-drag / inertia)
    rates = np.linalg.eigvals(motion).astype(np.complex128)
    return rates[np.argsort(-rates.real, kind="stable")]


def slowest_control_hz(rate: float, growth: float = 10.0) -> float:
    """Return the control rate (Hz) at which a deviation grows no more than ``growth``-fold from command to command.

    A controller that meets a deviation after it has grown can still bring it back, however large it is by then, as
    long as it stays where the motion is about linear: growth, not stability, is what limits the rate.
    """
    require(is_positive(growth) and growth > 1, "growth", "a number above 1", growth)
    return max(rate, 0.0) / math.log(growth)
