"""Knots of the random trajectories, from a key for each: the family that agents are trained on."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.angles import arctan2, sincos, wrap
from magenv.kernels import kernel
from magenv.streams import Keys, normal, uniform

Floats = NDArray[np.float64]

_AXES = 6  # x, y, heading of both robots
RANDOM_SEPARATION_M = (0.020, 0.100)
"""Range of the least separation in the random family; in others of its kind it begins elsewhere."""
RANDOM_RADIUS_M = 0.082
"""Greatest distance of a knot from the workspace's centre."""
_RANDOM_SPEED_MIN_MPS = 2e-4
RANDOM_TURN_MAX_RADPS = 0.1


@kernel
def try_knots(stream: Keys, duration: float, turn_max: float, nearest: float, lanes: Floats, knots: Floats) -> bool:
    """Draw a candidate and write its knots (33, 2, 3); return whether it is allowed, with knots written only then.

    The robots' midpoint travels through the workspace in a random direction on a bent path, while the line between
    them turns slowly and its length falls to a random least separation, ``nearest`` (m) or more, and grows again;
    either robot may be on the left. Headings are along the paths. Draws that leave the workspace, nearly stop or turn
    fast are not allowed. ``lanes`` (8, 33), scratch, has all knots side by side, in one array and filled without
    branches, so that loops over them are vectorised.
    """
    a, b = uniform(stream, nearest, RANDOM_SEPARATION_M[1]), uniform(stream, nearest, RANDOM_SEPARATION_M[1])
    closest, wider = min(a, b), abs(a - b)
    moment = uniform(stream, -0.6, 0.6)
    bend0, bend1, bend2 = normal(stream, 0.010), normal(stream, 0.010), normal(stream, 0.006)
    line0, line1, line2 = normal(stream, 0.35), normal(stream, 0.25), normal(stream, 0.25)
    line0 += -0.5 * math.pi if uniform(stream, 0.0, 1.0) < 0.5 else 0.5 * math.pi
    half_length = uniform(stream, 0.030, 0.065)
    turn_s, turn_c = sincos(uniform(stream, -math.pi, math.pi))
    speed_min = 0.5 * duration * _RANDOM_SPEED_MIN_MPS  # per unit of u
    forbidden, segments = 0, lanes.shape[1] - 1
    for k in range(segments + 1):
        u = 2.0 * k / segments - 1.0  # time from -1 to 1
        since = (u - moment) / (1.0 + abs(moment))
        distance, distance_rate = closest + wider * since * since, 2.0 * wider * since / (1.0 + abs(moment))
        x, y = half_length * u, bend0 + u * u * (bend1 + u * bend2)
        x_rate, y_rate = half_length, u * (2.0 * bend1 + 3.0 * u * bend2)
        s, c = sincos(line0 + u * (line1 + u * line2))
        angle_rate = line1 + 2.0 * u * line2
        half_x, half_y = 0.5 * distance * c, 0.5 * distance * s
        half_x_rate = 0.5 * (distance_rate * c - distance * angle_rate * s)
        half_y_rate = 0.5 * (distance_rate * s + distance * angle_rate * c)
        for robot in range(2):
            side, at = 2.0 * robot - 1.0, 3 * robot
            px, py = x + side * half_x, y + side * half_y
            vx, vy = x_rate + side * half_x_rate, y_rate + side * half_y_rate
            forbidden += px * px + py * py > RANDOM_RADIUS_M * RANDOM_RADIUS_M
            forbidden += vx * vx + vy * vy < speed_min * speed_min
            lanes[at, k], lanes[at + 1, k] = turn_c * px - turn_s * py, turn_s * px + turn_c * py
            lanes[at + 2, k], lanes[_AXES + robot, k] = turn_c * vx - turn_s * vy, turn_s * vx + turn_c * vy
    if forbidden > 0:
        return False
    turn_most = turn_max * duration / segments
    for robot in range(2):
        heading, turned = 3 * robot + 2, _AXES + robot  # first: both components of the velocity
        for k in range(segments + 1):
            lanes[heading, k] = arctan2(lanes[turned, k], lanes[heading, k])
        for k in range(1, segments + 1):
            lanes[turned, k] = wrap(lanes[heading, k] - lanes[heading, k - 1])
            forbidden += abs(lanes[turned, k]) > turn_most
        for k in range(1, segments + 1):
            lanes[heading, k] = lanes[heading, k - 1] + lanes[turned, k]
    if forbidden > 0:
        return False
    for k in range(segments + 1):
        for j in range(_AXES):
            knots[k, j // 3, j % 3] = lanes[j, k]
    return True
