"""Poses of the external magnets (EPMs): spherical vector, Cartesian form, bounds, least gap, home configuration.

A pose vector holds five numbers per EPM in the paper's order: azimuth, elevation and radius of its centre, azimuth and
elevation of its moment (rad, rad, m, rad, rad). Inside the kernels an EPM is a row of six: centre (m), unit moment.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.angles import arctan2, sincos
from magenv.kernels import kernel, law
from magenv.params import System, require

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Pair = tuple[float, float]

POSE_SIZE = 5
"""Numbers per EPM in a pose vector."""
EPM_SIZE = 6
"""Numbers per EPM in Cartesian form: centre, unit moment."""
LANES = 8
"""EPMs computed side by side: a lane holds its pose in rows 0 to 4 and its centre and moment in rows 5 to 10. All stand
in one array (rows, lanes), so that LLVM sees that they do not overlap and vectorises what is done to each lane."""
LANES_SIZE = POSE_SIZE + EPM_SIZE
_STUCK_TURNS = 100
GAP_TOLERANCE_M = 1e-9
"""Within this the least gap and the radius limits hold after ``project``."""

HOME_RADIUS_M = 0.2
HOME_TILT_RAD = {2: math.radians(34.0), 3: math.radians(10.0)}
"""Angle of the first EPM above the plane, by number of EPMs. Untilted, the EPMs lie in the robots' plane or opposite
each other in it, and out-of-plane moments do nothing to first order."""
SECOND_ROBOT_WEIGHT = 0.8
"""Share of robot 2 in the robots' frame: below one, so that the frame exists for antiparallel robots too."""


@law
def _placed(radius: float, a: Pair, e: Pair, b: Pair, f: Pair) -> tuple[float, float, float, float, float, float]:
    """Return centre and unit moment.

    Radius in m; (sine, cosine) of the centre's azimuth a and elevation e and of the moment's, b and f.
    """
    (sa, ca), (se, ce), (sb, cb), (sf, cf) = a, e, b, f
    return radius * ce * ca, radius * ce * sa, radius * se, cf * cb, cf * sb, sf


@law
def place_lanes(lanes: Floats) -> None:
    """Write the EPMs of the poses in ``lanes`` (11, lanes)."""
    for i in range(LANES):
        lanes[5, i], lanes[6, i], lanes[7, i], lanes[8, i], lanes[9, i], lanes[10, i] = _placed(
            lanes[2, i], sincos(lanes[0, i]), sincos(lanes[1, i]), sincos(lanes[3, i]), sincos(lanes[4, i])
        )


@law
def _pose_of(x: float, y: float, z: float, mx: float, my: float, mz: float) -> tuple[float, float, float, float, float]:
    """Return the pose of a centre and a moment, azimuths in [-pi, pi], elevations in [-pi/2, pi/2]."""
    across, moment_across = math.sqrt(x * x + y * y), math.sqrt(mx * mx + my * my)
    radius = math.sqrt(x * x + y * y + z * z)
    return arctan2(y, x), arctan2(z, across), radius, arctan2(my, mx), arctan2(mz, moment_across)


@law
def pose_lanes(lanes: Floats) -> None:
    """Write the poses of the EPMs in ``lanes`` (11, lanes)."""
    for i in range(LANES):
        lanes[0, i], lanes[1, i], lanes[2, i], lanes[3, i], lanes[4, i] = _pose_of(
            lanes[5, i], lanes[6, i], lanes[7, i], lanes[8, i], lanes[9, i], lanes[10, i]
        )


@law
def pose_to_epm(pose: Floats, epm: Floats) -> None:
    """Write centre and unit moment of one pose (5,) into ``epm`` (6,)."""
    a, e, b, f = pose[0], pose[1], pose[3], pose[4]
    centre_angles = (math.sin(a), math.cos(a)), (math.sin(e), math.cos(e))
    moment_angles = (math.sin(b), math.cos(b)), (math.sin(f), math.cos(f))
    epm[0], epm[1], epm[2], epm[3], epm[4], epm[5] = _placed(pose[2], *centre_angles, *moment_angles)


@kernel
def epm_to_pose(epm: Floats, pose: Floats) -> None:
    """Write the pose (5,) of ``epm`` (6,)."""
    pose[0], pose[1], pose[2], pose[3], pose[4] = _pose_of(epm[0], epm[1], epm[2], epm[3], epm[4], epm[5])


@kernel
def clip_radius(epm: Floats, r_min: float, r_max: float) -> None:
    """Move the centre of ``epm`` (6,) along its radius into [r_min, r_max]."""
    radius = math.sqrt(epm[0] * epm[0] + epm[1] * epm[1] + epm[2] * epm[2])
    if r_min <= radius <= r_max:
        return
    if radius == 0.0:  # no radius to move along: any will do
        epm[0] = r_min
        return
    scale = min(max(radius, r_min), r_max) / radius
    for i in range(3):
        epm[i] *= scale


@kernel
def tangent(epm: Floats) -> tuple[float, float, float]:
    """Return a horizontal unit vector at right angles to the radius of ``epm``."""
    horizontal = math.hypot(epm[0], epm[1])
    if horizontal < 1e-9:
        return 1.0, 0.0, 0.0
    return -epm[1] / horizontal, epm[0] / horizontal, 0.0


@kernel
def separate(first: Floats, second: Floats, gap: float) -> float:
    """Move two EPM centres apart along their joining line to the gap; return by how much they were too close (m)."""
    dx, dy, dz = second[0] - first[0], second[1] - first[1], second[2] - first[2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    short = gap - distance
    if short <= 0.0:
        return 0.0
    if distance < 1e-9:  # no joining line: take a tangent of the sphere, the flattest way out
        dx, dy, dz = tangent(first)
        distance = 1.0
    push = 0.5 * short / distance
    first[0] -= push * dx
    first[1] -= push * dy
    first[2] -= push * dz
    second[0] += push * dx
    second[1] += push * dy
    second[2] += push * dz
    return short


@kernel
def project_epms(epms: Floats, r_min: float, r_max: float, gap: float) -> bool:
    """Make ``epms`` (N, 6) feasible in place, moments kept; return whether any centre moved by over 1e-9 m."""
    n = len(epms)
    for i in range(n):
        clip_radius(epms[i], r_min, r_max)
    moved = False
    for turn in range(10_000):
        worst = 0.0
        for i in range(n):
            for j in range(i + 1, n):
                worst = max(worst, separate(epms[i], epms[j], gap))
        if worst <= GAP_TOLERANCE_M:
            break
        moved = True
        if turn % _STUCK_TURNS == _STUCK_TURNS - 1:  # on one ray there may be no room: leave it sideways
            for i in range(n):
                x, y, z = tangent(epms[i])
                for axis, part in ((0, x), (1, y), (2, z)):
                    epms[i, axis] += (i - 0.5 * (n - 1)) * 0.1 * gap * part
        for i in range(n):
            clip_radius(epms[i], r_min, r_max)
    return moved


@law
def command_lanes(lanes: Floats, start: int, count: int, k: int, active: Bools, targets: Floats) -> None:
    """Write the ``k``-th EPMs of ``count`` rows from ``lanes`` into the active rows of ``targets`` (n, N, 6)."""
    for i in range(count):
        if active[start + i]:
            for j in range(EPM_SIZE):
                targets[start + i, k, j] = lanes[POSE_SIZE + j, i]


@law
def keeps_gap(epms: Floats, row: int, gap: float) -> bool:
    """Return whether no two centres of a row of EPMs (n, N, 6) are closer than ``gap``."""
    keeps = True
    for k in range(1, epms.shape[1]):
        for j in range(k):
            x, y = epms[row, k, 0] - epms[row, j, 0], epms[row, k, 1] - epms[row, j, 1]
            z = epms[row, k, 2] - epms[row, j, 2]
            keeps &= x * x + y * y + z * z >= gap * gap
    return keeps


@law
def frame_direction(s1: float, c1: float, s2: float, c2: float) -> tuple[float, float]:
    """Return the direction (cosine, sine) of the frame the robots carry: along h1 + 0.8 h2, of headings (s, c).

    For parallel robots it is their mean heading. The plain mean does not exist for antiparallel ones, and no rule
    that treats both alike does; here robot 1 decides, smoothly.
    """
    x, y = c1 + SECOND_ROBOT_WEIGHT * c2, s1 + SECOND_ROBOT_WEIGHT * s2
    norm = math.sqrt(x * x + y * y)
    return x / norm, y / norm


@kernel
def robots_frame(heading_1: float, heading_2: float) -> float:
    """Return the heading (rad) of the frame the robots carry."""
    s1, c1 = sincos(heading_1)
    s2, c2 = sincos(heading_2)
    c, s = frame_direction(s1, c1, s2, c2)
    return arctan2(s, c)


def home_pose(n_epm: int, turn: float = 0.0) -> Floats:
    """Return the home pose vector (5 N) in the robots' frame, whose x axis is the heading.

    The EPMs stand on a ring round the heading through the workspace centre, broadside to it, their moments against
    the heading: there the fields of all add up along the robots' moments. The ring may be turned about the heading
    (rad).
    """
    require(n_epm in HOME_TILT_RAD, "n_epm", "2 or 3", n_epm)
    poses = np.empty((n_epm, POSE_SIZE))
    for k, pose in enumerate(poses):
        angle = HOME_TILT_RAD[n_epm] + turn + 2 * math.pi * k / n_epm
        place = (0.0, HOME_RADIUS_M * math.cos(angle), HOME_RADIUS_M * math.sin(angle))
        epm_to_pose(np.array([*place, -1.0, 0.0, 0.0]), pose)
    return poses.reshape(-1)


def pose_bounds(system: System) -> tuple[Floats, Floats]:
    """Return the lower and upper bounds (5 N each) of a pose vector."""
    low = [-math.pi, -math.pi / 2, system.r_min_m, -math.pi, -math.pi / 2]
    high = [math.pi, math.pi / 2, system.r_max_m, math.pi, math.pi / 2]
    return np.tile(low, system.n_epm), np.tile(high, system.n_epm)


@kernel
def _to_epms(poses: Floats, epms: Floats) -> None:
    for i in range(len(poses)):
        pose_to_epm(poses[i], epms[i])


@kernel
def epms_to_poses(epms: Floats, first: int, last: int, poses: Floats) -> None:
    """Write the poses (n, 5) of the EPMs (n, 6) from ``first`` to ``last``, in blocks whose angles are vectorised."""
    lanes = np.zeros((LANES_SIZE, LANES))
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        for i in range(count):
            for j in range(EPM_SIZE):
                lanes[POSE_SIZE + j, i] = epms[start + i, j]
        pose_lanes(lanes)
        for i in range(count):
            for j in range(POSE_SIZE):
                poses[start + i, j] = lanes[j, i]


def _as_rows(values: ArrayLike, width: int, name: str, must_be: str) -> Floats:
    array = np.ascontiguousarray(values, dtype=np.float64)
    require(array.ndim >= 1 and array.shape[-1] > 0 and array.shape[-1] % width == 0, name, must_be, array.shape)
    return array


def to_cartesian(pose: ArrayLike) -> tuple[Floats, Floats]:
    """Return centres (..., N, 3) in m and unit moments (..., N, 3) of pose vectors (..., 5 N).

    Raises
    ------
    ValueError
        If the last axis is not a multiple of 5.
    """
    array = _as_rows(pose, POSE_SIZE, "pose", "an array of shape (..., 5 N)")
    rows = array.reshape(-1, POSE_SIZE)
    epms = np.empty((len(rows), 6))
    _to_epms(rows, epms)
    epms = epms.reshape(*array.shape[:-1], -1, 6)
    return epms[..., :3].copy(), epms[..., 3:].copy()


def from_cartesian(positions: ArrayLike, directions: ArrayLike) -> Floats:
    """Return the pose vectors (..., 5 N) of centres (..., N, 3) in m and moment directions (..., N, 3)."""
    centres = _as_rows(positions, 3, "positions", "an array of shape (..., N, 3)")
    moments = _as_rows(directions, 3, "directions", "an array of shape (..., N, 3)")
    require(centres.shape == moments.shape, "directions", f"of the shape of positions {centres.shape}", moments.shape)
    epms = np.concatenate([centres, moments], axis=-1).reshape(-1, 6)
    poses = np.empty((len(epms), POSE_SIZE))
    epms_to_poses(epms, 0, len(epms), poses)
    return poses.reshape(*centres.shape[:-2], -1)


def project(pose: ArrayLike, system: System) -> tuple[Floats, bool]:
    """Return the nearest allowed pose vector (5 N) and whether the least gap made it differ.

    Centres that are too close are moved apart symmetrically along their joining line and their radii clipped, in
    turns, until both hold within 1e-9 m; moments are kept.

    Raises
    ------
    ValueError
        If the pose is not of the system's size or not finite.
    """
    array = np.asarray(pose, dtype=np.float64)
    size = POSE_SIZE * system.n_epm
    require(array.shape == (size,), "pose", f"an array of shape ({size},)", array.shape)
    require(bool(np.isfinite(array).all()), "pose", "finite", array.tolist())
    centres, moments = to_cartesian(array)
    epms = np.concatenate([centres, moments], axis=-1)
    moved = project_epms(epms, system.r_min_m, system.r_max_m, system.gap_min_m)
    return from_cartesian(epms[:, :3], epms[:, 3:]), bool(moved)
