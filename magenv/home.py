"""The action mode ``home``: offsets from the home configuration in the frame that the robots carry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magenv.angles import sincos, sincos_all
from magenv.kernels import kernel, law
from magenv.poses import EPM_SIZE, HOME_RADIUS_M, POSE_SIZE, frame_direction, home_pose, place_epm, project_epms

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

HOME_ANGLE_RAD = 1.2
"""Largest offset of an angle in ``home``."""
HOME_RADIUS_OUT_M = 0.15
"""Largest offset of a radius outwards in ``home``; inwards it reaches r_min."""
_BLOCK = 64  # rows whose angles are vectorised together


def home_epms(n_epm: int) -> Floats:
    """Return the EPMs (N, 6) at home in the robots' frame, as ``home_rows`` would place them."""
    epms = np.empty((n_epm, EPM_SIZE))
    for epm, (a, e, radius, b, f) in zip(epms, home_pose(n_epm).reshape(-1, POSE_SIZE), strict=True):
        place_epm(radius, *sincos(a), *sincos(e), *sincos(b), *sincos(f), epm)
    return epms


@law
def _turn(epms: Floats, c: float, s: float) -> None:
    """Turn EPMs (N, 6) about the vertical by the angle with cosine c and sine s."""
    for k in range(len(epms)):
        e = epms[k]
        e[0], e[1] = c * e[0] - s * e[1], s * e[0] + c * e[1]
        e[3], e[4] = c * e[3] - s * e[4], s * e[3] + c * e[4]


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
    n_epm = targets.shape[1]
    each = 2 + 4 * n_epm  # angles of a row: both headings, four of each EPM
    angles, s, c = np.empty(_BLOCK * each), np.empty(_BLOCK * each), np.empty(_BLOCK * each)
    for start in range(first, last, _BLOCK):
        end, count = min(start + _BLOCK, last), 0
        for i in range(start, end):
            if active[i]:
                angles[count], angles[count + 1] = measured[i, 0, 2], measured[i, 1, 2]
                count += 2
                for at in range(0, POSE_SIZE * n_epm, POSE_SIZE):
                    for j in (0, 1, 3, 4):
                        angles[count] = home[at + j] + HOME_ANGLE_RAD * actions[i, at + j]
                        count += 1
        sincos_all(angles, count, s, c)
        at = 0
        for i in range(start, end):
            if active[i]:
                frame_c, frame_s = frame_direction(s[at], c[at], s[at + 1], c[at + 1])
                at += 2
                for k in range(n_epm):
                    a = actions[i, POSE_SIZE * k + 2]
                    radius = home[POSE_SIZE * k + 2] + a * (HOME_RADIUS_OUT_M if a > 0.0 else HOME_RADIUS_M - limits[0])
                    epm = targets[i, k]
                    place_epm(
                        radius, s[at], c[at], s[at + 1], c[at + 1], s[at + 2], c[at + 2], s[at + 3], c[at + 3], epm
                    )
                    at += 4
                _turn(targets[i], frame_c, frame_s)
                projected[i] = project_epms(targets[i], limits[0], limits[1], limits[2])


@kernel
def start_rows(first: int, last: int, mask: Bools, measured: Floats, home: Floats, epms: Floats) -> None:
    """Put the EPMs (n, N, 6) at ``home`` (N, 6) in the robots' frame where ``mask`` says."""
    for i in range(first, last):
        if mask[i]:
            s1, c1 = sincos(measured[i, 0, 2])
            s2, c2 = sincos(measured[i, 1, 2])
            frame_c, frame_s = frame_direction(s1, c1, s2, c2)
            for k in range(len(home)):
                for j in range(EPM_SIZE):
                    epms[i, k, j] = home[k, j]
            _turn(epms[i], frame_c, frame_s)
