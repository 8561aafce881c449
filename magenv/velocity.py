"""The action mode ``velocity``: how fast both robots should go in the coming hold, in the frame that they carry."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.angles import sincos, wrap
from magenv.forecast import STATE
from magenv.kernels import keep, kernel, uncounted
from magenv.outcome import CONVERGED, FELL_BACK, NOT_CONVERGED
from magenv.poses import robots_frame
from magenv.sensitivity import COORDINATES
from magenv.steering import MET, steer
from magenv.steering_cost import Steering, workspace

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]

VELOCITY_MPS, VELOCITY_RADPS = 0.010, 0.5
"""Greatest velocity along each axis and of turning in ``velocity``."""


@kernel
def velocity_rows(
    first: int,
    last: int,
    active: Bools,
    actions: Floats,
    measured: Floats,
    expected: Floats,
    period: float,
    epms: Floats,
    steering: Steering,
    limits: Floats,
    targets: Floats,
    projected: Bools,
    solver: Integers,
) -> None:
    """Write the EPMs (n, N, 6) under which robots go with ``actions`` (n, 6), sought from ``epms``, where they are now.

    ``measured`` (n, 2, 3) are the robots' poses, ``expected`` (n, 12) the states in which the last commands were to
    leave them. Their rates are taken to be those expected, and more by as much as, over a period, makes up for where
    they are. The states expected next are written there, and into ``solver`` (n,) how the search ended, codes into
    ``outcome.OUTCOMES``. Where nothing can be foreseen, ``targets`` stay: the last command.
    """
    state, ahead = np.empty(STATE), np.empty(COORDINATES)
    own = workspace(steering)
    room = uncounted(own)
    found = np.empty(epms.shape[1:])
    for i in range(first, last):
        if not active[i]:
            continue
        heading = robots_frame(measured[i, 0, 2], measured[i, 1, 2])
        sine, cosine = sincos(heading)
        for robot in range(2):
            at = 3 * robot
            for j in range(3):
                more, rate = measured[i, robot, j] - expected[i, at + j], COORDINATES + at + j
                state[at + j] = measured[i, robot, j]
                state[rate] = expected[i, rate] + (wrap(more) if j == 2 else more) / period
            along, across = VELOCITY_MPS * actions[i, at], VELOCITY_MPS * actions[i, at + 1]
            ahead[at] = period * (cosine * along - sine * across)
            ahead[at + 1] = period * (sine * along + cosine * across)
            ahead[at + 2] = period * VELOCITY_RADPS * actions[i, at + 2]
        found[:] = epms[i]
        miss = steer(steering, room, state, ahead, heading, limits, found)
        projected[i] = False  # what is found is within reach
        solver[i] = CONVERGED if miss <= MET else NOT_CONVERGED if miss < math.inf else FELL_BACK
        if solver[i] == FELL_BACK:
            expected[i, :COORDINATES], expected[i, COORDINATES:] = state[:COORDINATES], 0.0
        else:
            targets[i], expected[i] = found, room.landed
    keep(own)
