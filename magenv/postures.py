"""Where commanded EPMs should rather not stand: costs of the commands themselves, beside those of the motion."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.arithmetic import dot3
from magenv.kernels import kernel
from magenv.poses import EPM_SIZE, POSE_SIZE

Floats = NDArray[np.float64]

_PER_RADIUS = 10.0
"""Weight of a metre of the centre's way in that of the way from home."""
_ROOM_M = 0.03
"""By so much more than the least gap should EPMs be apart."""
_CROWDED_M = 0.01
"""What lacks of it, to count one."""


@kernel
def away(
    command: Floats, home: Floats, bases: Floats, weight: float, residuals: Floats, jacobian: Floats, at: int
) -> float:
    """Write what a command's way from home, (N, 6) both, costs into the residuals from row ``at`` on; return it.

    ``bases`` (N, 6, 5) are those of the command, by which its derivatives go into the last columns of ``jacobian``.
    """
    cost, n_epm, first = 0.0, len(command), jacobian.shape[1] - POSE_SIZE * len(command)
    for k in range(n_epm):
        for a in range(EPM_SIZE):
            w, row = weight * (_PER_RADIUS if a < 3 else 1.0), at + EPM_SIZE * k + a
            residuals[row] = w * (command[k, a] - home[k, a])
            cost += residuals[row] * residuals[row]
            for c in range(POSE_SIZE):
                jacobian[row, first + POSE_SIZE * k + c] = w * bases[k, a, c]
    return cost


@kernel
def crowd(
    command: Floats, gap: float, bases: Floats, weight: float, residuals: Floats, jacobian: Floats, at: int
) -> float:
    """Write what EPMs (N, 6) that stand hardly farther apart than the least gap cost, from row ``at`` on; return it.

    At the gap they could not go on: commands there are cut off. ``gap`` is in metres; ``bases`` and ``jacobian`` as
    in ``away``.
    """
    cost, n_epm, first = 0.0, len(command), jacobian.shape[1] - POSE_SIZE * len(command)
    for k in range(n_epm):
        for other in range(k):
            p, q = command[k], command[other]
            x, y, z = p[0] - q[0], p[1] - q[1], p[2] - q[2]
            distance = math.sqrt(dot3(x, y, z, x, y, z))
            short, row = max(gap + _ROOM_M - distance, 0.0), at + k * (k - 1) // 2 + other
            w = weight / _CROWDED_M if short > 0.0 else 0.0
            residuals[row] = w * short
            cost += residuals[row] * residuals[row]
            for c in range(3):
                for which, slope in ((k, -w / distance), (other, w / distance)):
                    b = bases[which]
                    column = first + POSE_SIZE * which + c
                    jacobian[row, column] = slope * (x * b[0, c] + y * b[1, c] + z * b[2, c])
    return cost
