"""The action mode ``home``: offsets from the home configuration in the frame that the robots carry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magenv.angles import sincos
from magenv.kernels import kernel, law
from magenv.poses import (
    HOME_RADIUS_M,
    LANES,
    LANES_SIZE,
    POSE_SIZE,
    command_lanes,
    frame_direction,
    home_pose,
    place_lanes,
)
from magenv.reach import make_allowed

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

HOME_ANGLE_RAD = 1.2
"""Largest offset of an angle in ``home``."""
HOME_RADIUS_OUT_M = 0.15
"""Largest offset of a radius outwards in ``home``; inwards it reaches r_min."""


def home_epms(n_epm: int, turn: float = 0.0) -> Floats:
    """Return the EPMs (N, 6) at home in the robots' frame, as ``home_rows`` would place them (see ``home_pose``)."""
    lanes = np.zeros((LANES_SIZE, LANES))
    lanes[:POSE_SIZE, :n_epm] = home_pose(n_epm, turn).reshape(-1, POSE_SIZE).T
    place_lanes(lanes)
    return lanes[POSE_SIZE:, :n_epm].T.copy()


@law
def _turn(x: float, y: float, c: float, s: float) -> tuple[float, float]:
    """Return a vector turned about the vertical by the angle with cosine c and sine s."""
    return c * x - s * y, s * x + c * y


@kernel
def home_rows(
    first: int,
    last: int,
    active: Bools,
    actions: Floats,
    measured: Floats,
    home: Floats,
    limits: Floats,
    targets: Floats,
    projected: Bools,
) -> None:
    """Write the EPMs (n, N, 6) offset by ``actions`` (n, 5 N) from ``home`` (5 N) in the robots' frame."""
    inwards = HOME_RADIUS_M - limits[0]
    lanes = np.zeros((LANES_SIZE + 2, LANES))
    frame_c, frame_s = LANES_SIZE, LANES_SIZE + 1
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        for i in range(count):
            lanes[0, i], lanes[1, i] = measured[start + i, 0, 2], measured[start + i, 1, 2]
        for i in range(LANES):
            lanes[frame_c, i], lanes[frame_s, i] = frame_direction(*sincos(lanes[0, i]), *sincos(lanes[1, i]))
        for k in range(targets.shape[1]):
            at = POSE_SIZE * k
            for i in range(count):
                for j in (0, 1, 3, 4):
                    lanes[j, i] = home[at + j] + HOME_ANGLE_RAD * actions[start + i, at + j]
                out = actions[start + i, at + 2]
                radius = home[at + 2] + out * (HOME_RADIUS_OUT_M if out > 0.0 else inwards)
                lanes[2, i] = min(max(radius, limits[0]), limits[1])
            place_lanes(lanes)
            for i in range(LANES):
                c, s = lanes[frame_c, i], lanes[frame_s, i]
                for x in (5, 8):
                    lanes[x, i], lanes[x + 1, i] = _turn(lanes[x, i], lanes[x + 1, i], c, s)
            command_lanes(lanes, start, count, k, active, targets)
        for i in range(start, start + count):
            if active[i]:
                projected[i] = make_allowed(targets, i, limits)


@kernel
def start_rows(first: int, last: int, mask: Bools, measured: Floats, home: Floats, epms: Floats) -> None:
    """Put the EPMs (n, N, 6) at ``home`` (N, 6) in the robots' frame where ``mask`` says."""
    lanes = np.zeros((4, LANES))  # headings, frame
    for start in range(first, last, LANES):
        end, count = min(start + LANES, last), 0
        for i in range(start, end):
            if mask[i]:
                lanes[0, count], lanes[1, count] = measured[i, 0, 2], measured[i, 1, 2]
                count += 1
        if count == 0:
            continue
        for i in range(LANES):
            lanes[2, i], lanes[3, i] = frame_direction(*sincos(lanes[0, i]), *sincos(lanes[1, i]))
        count = 0
        for i in range(start, end):
            if mask[i]:
                c, s = lanes[2, count], lanes[3, count]
                count += 1
                for k in range(len(home)):
                    epms[i, k, 0], epms[i, k, 1] = _turn(home[k, 0], home[k, 1], c, s)
                    epms[i, k, 3], epms[i, k, 4] = _turn(home[k, 3], home[k, 4], c, s)
                    epms[i, k, 2], epms[i, k, 5] = home[k, 2], home[k, 5]
