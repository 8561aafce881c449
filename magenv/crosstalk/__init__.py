"""How independently two robots can be actuated: the paper's system analysis (section III) and what it left open.

Every result is a function first, arrays in and arrays out, built on ``wrench`` and ``allocation`` alone; ``python -m
magenv.crosstalk`` sweeps them all and draws the figures.
"""

from magenv.crosstalk.activation import COMPONENTS, Activations, Pair, activate, crosstalk
from magenv.crosstalk.frontier import Authority, authority
from magenv.crosstalk.holdable import hold, holdable_separation
from magenv.crosstalk.stability import growth_rates, most_stable_hold, slowest_control_hz
from magenv.crosstalk.validity import exact_wrench
from magenv.wrench import IN_PLANE

__all__ = [
    "COMPONENTS",
    "IN_PLANE",
    "Activations",
    "Authority",
    "Pair",
    "activate",
    "authority",
    "crosstalk",
    "exact_wrench",
    "growth_rates",
    "hold",
    "holdable_separation",
    "most_stable_hold",
    "slowest_control_hz",
]
