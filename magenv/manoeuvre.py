"""The motion of EPMs from one command to the next as a controller foresees it, and what of it is within their reach."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.forecast import Motion
from magenv.kernels import kernel
from magenv.params import System

Floats = NDArray[np.float64]


class Arms(NamedTuple):
    """What limits commands and the EPMs' motion to them."""

    r_min: float
    """m"""
    r_max: float
    """m"""
    gap: float
    """m"""

    @classmethod
    def of(cls, system: System) -> Arms:
        """Return the limits of a system."""
        return cls(system.r_min_m, system.r_max_m, system.gap_min_m)


@kernel
def move(arms: Arms, before: Floats, command: Floats, bases: Floats, motion: Motion) -> None:
    """Write the motion from one command to the next, (N, 6) each; ``bases`` (2, N, 6, 5) are theirs."""
    motion.path[0] = command
    motion.by[0, 1] = bases[1]


@kernel
def within_reach(arms: Arms, before: Floats, command: Floats) -> None:
    """Draw a command (N, 6) towards the one before until the EPMs arrive in its time."""
