"""Layout of the array in which episodes move side by side: ``lanes`` (fields, width), one episode a column.

All quantities of all lanes stand in one array of fixed width, so that LLVM sees that they do not overlap and
vectorises the loops over lanes. Every field is named here and nowhere else.
"""

from __future__ import annotations

from magenv.kernels import law
from magenv.poses import EPM_SIZE

STATE_SIZE = 6
"""Numbers of a robot's state: x, y, heading, v_x, v_y, rate."""
# Both robots' values stand side by side, so that in a single lane one vector holds the two.
X1, X2, Y1, Y2, HEADING1, HEADING2, VX1, VX2, VY1, VY2, RATE1, RATE2 = range(12)

# Constants of an episode, in the order of ``dynamics.constants``: decay and gain of translation and rotation, moments.
CONSTANTS = 12
DECAY1, DECAY2, GAIN1, GAIN2, TURN_DECAY1, TURN_DECAY2, TURN_GAIN1, TURN_GAIN2, MOMENT1, MOMENT2 = range(12, 22)
CONSTANTS_SIZE = 10

# The hold: its beginning (s), substeps done, contact flags found.
START, DONE, CONTACT = 22, 23, 24

# The reference: segments per second, present segment, position in it, its coefficients (3 axes, 4 powers, 2 robots).
SEGMENT_RATE, SEGMENT, PROGRESS = 25, 26, 27
COEFFICIENTS = 28
COEFFICIENTS_SIZE = 24

# What is measured, in the order of ``world.Measurements.numbers``; until the hold ends the first two are sums and the
# separations squared.
MEASURED = 52
POSITION_ERROR, HEADING_ERROR, POSITION_END, HEADING_END, SEPARATION_MIN, SEPARATION_TRACKED = range(52, 58)
MEASURED_SIZE = 6

# What else acts on a robot on a rough plant: a force and a torque that push it, and dry friction against both motions.
PUSH_X1, PUSH_X2, PUSH_Y1, PUSH_Y2, PUSH_TURN1, PUSH_TURN2, FRICTION, TURN_FRICTION = range(58, 66)

EPMS = 66
"""First field of the EPMs: six numbers of each, in the order of ``magnets.place_epm``."""


ROUTE_SIZE = 48
"""Fields of an EPM of finite speed, see ``travel``."""


@law
def carried_moment(n_epm: int) -> int:
    """Return the first field of the moments of EPMs of finite speed, A m^2."""
    return EPMS + EPM_SIZE * n_epm


@law
def route(n_epm: int, k: int) -> int:
    """Return the first field of the ``k``-th EPM's route."""
    return carried_moment(n_epm) + n_epm + ROUTE_SIZE * k


@law
def fields(n_epm: int, travels: bool) -> int:
    """Return the number of fields, with routes or without."""
    return route(n_epm, n_epm) if travels else EPMS + EPM_SIZE * n_epm
