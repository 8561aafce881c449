"""How a solver behind a command ended, in the words that environment, controllers and records share."""

from __future__ import annotations

import math

from magenv.kernels import kernel

OUTCOMES = ("none", "converged", "not converged", "fell back")
NO_SOLVER, CONVERGED, NOT_CONVERGED, FELL_BACK = range(4)
"""Codes into ``OUTCOMES``: nothing is solved; the command does what is asked for; it is the best found, but does not;
nothing was found, and the last safe command is held."""
MISS = 0.1
"""Share of the wrench asked for by which the one found may miss it: a controller lives with errors of its gains of
that size, and few wrenches in all ten components are in reach exactly."""


@kernel
def outcome_of(relative_residual: float) -> int:
    """Return how an allocation ended that leaves this share of the wrench asked for."""
    if not abs(relative_residual) < math.inf:
        return FELL_BACK
    return CONVERGED if relative_residual <= MISS else NOT_CONVERGED
