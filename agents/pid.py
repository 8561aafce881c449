"""PID: pose error to desired planar wrench on both robots (paper, section IV)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magenv.params import require

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Gains:
    """Gains of the two loops of each robot: force from position error, torque from heading error."""

    force_p: float
    """N/m."""
    force_i: float
    """N/(m s)."""
    force_d: float
    """N s/m."""
    torque_p: float
    """N m/rad."""
    torque_i: float = 0.0
    """N m/(rad s)."""
    torque_d: float = 0.0
    """N m s/rad."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require(math.isfinite(value) and value >= 0, name, "a finite number of at least 0", value)


@dataclass
class PIDState:
    """What a PID remembers of ``n`` episodes; arrays (n, 2 robots, x / y / heading)."""

    integral: Floats
    """Integrated error, m s and rad s."""
    previous: Floats
    """Last error, m and rad."""
    fresh: NDArray[np.bool_]
    """(n,) where no error has been seen yet."""

    @classmethod
    def start(cls, n: int) -> PIDState:
        """Return the state of ``n`` episodes that begin."""
        return cls(np.zeros((n, 2, 3)), np.zeros((n, 2, 3)), np.ones(n, np.bool_))

    def restart(self, mask: NDArray[np.bool_]) -> None:
        """Forget the masked episodes."""
        self.integral[mask] = 0.0
        self.fresh[mask] = True


def pid_wrench(error: Floats, state: PIDState, gains: Gains, period_s: float) -> Floats:
    """Return F_x, F_y (N) and tau_z (N m) per robot (n, 2, 3), global frame, and update ``state``.

    Parameters
    ----------
    error : ndarray, shape (n, 2, 3)
        Reference minus pose, m and rad.
    state : PIDState
        Memory of the same episodes.
    gains : Gains
        The loops' gains.
    period_s : float
        Control period.
    """
    state.integral += error * period_s
    change = error - state.previous
    change[..., 2] = np.remainder(change[..., 2] + math.pi, 2 * math.pi) - math.pi
    change[state.fresh] = 0.0
    state.previous = error.copy()
    state.fresh[:] = False
    p = np.array([gains.force_p, gains.force_p, gains.torque_p])
    i = np.array([gains.force_i, gains.force_i, gains.torque_i])
    d = np.array([gains.force_d, gains.force_d, gains.torque_d])
    wrench: Floats = p * error + i * state.integral + d * change / period_s
    return wrench
