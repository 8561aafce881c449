"""Magnetic wrench on the two robots: superposition, frames, the paper's ten-vector U and its Jacobian by EPM pose.

U holds per robot (tau_y, tau_z, F_x, F_y, F_z), N m and N, in the robot's magnet frame: x along its moment, z the
global z made orthogonal to x, y = z cross x. The torque about x is always zero.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.dipole import dipole_field, dipole_force_gradient, dipole_gradient
from magenv.kernels import kernel, law
from magenv.params import require
from magenv.poses import POSE_SIZE, pose_to_epm

Floats = NDArray[np.float64]

N_ROBOTS = 2
WRENCH_SIZE = 10


@kernel
def dipole_wrench(
    sx: float, sy: float, sz: float, mx: float, my: float, mz: float, rx: float, ry: float, rz: float
) -> tuple[float, float, float, float, float, float]:
    """Return torque (N m) and force (N) of the dipole s on the dipole m, r = position of m - position of s.

    tau = m x B and F = (grad B)^T m (paper, section II-A).
    """
    bx, by, bz = dipole_field(sx, sy, sz, rx, ry, rz)
    xx, xy, xz, yy, yz, zz = dipole_gradient(sx, sy, sz, rx, ry, rz)
    return (
        my * bz - mz * by,
        mz * bx - mx * bz,
        mx * by - my * bx,
        xx * mx + xy * my + xz * mz,
        xy * mx + yy * my + yz * mz,
        xz * mx + yz * my + zz * mz,
    )


@law
def planar_dipole_wrench(
    sx: float, sy: float, sz: float, mx: float, my: float, rx: float, ry: float, rz: float
) -> tuple[float, float, float]:
    """Return F_x, F_y (N) and tau_z (N m) of ``dipole_wrench`` for a moment m in the plane: no more is computed."""
    bx, by, _ = dipole_field(sx, sy, sz, rx, ry, rz)
    xx, xy, _, yy, _, _ = dipole_gradient(sx, sy, sz, rx, ry, rz)
    return xx * mx + xy * my, xy * mx + yy * my, mx * by - my * bx


@kernel
def magnet_frame(moment: Floats, frame: Floats) -> None:
    """Write the magnet frame's axes into the rows of ``frame`` (3, 3)."""
    norm = math.sqrt(moment[0] ** 2 + moment[1] ** 2 + moment[2] ** 2)
    x, y, z = moment[0] / norm, moment[1] / norm, moment[2] / norm
    # y axis = z_global cross x; where the moment is vertical, any horizontal axis serves: the global y.
    horizontal = math.hypot(x, y)
    if horizontal > 1e-9:
        yx, yy = -y / horizontal, x / horizontal
    else:
        yx, yy = 0.0, 1.0
    frame[0, 0], frame[0, 1], frame[0, 2] = x, y, z
    frame[1, 0], frame[1, 1], frame[1, 2] = yx, yy, 0.0
    frame[2, 0], frame[2, 1], frame[2, 2] = -z * yy, z * yx, x * yy - y * yx


@kernel
def _to_magnet_frame(frame: Floats, tau: Floats, force: Floats, out: Floats) -> None:
    """Add the global torque and force, seen in the magnet frame, to ``out`` (5,)."""
    for i in range(3):
        out[0] += frame[1, i] * tau[i]
        out[1] += frame[2, i] * tau[i]
        out[2] += frame[0, i] * force[i]
        out[3] += frame[1, i] * force[i]
        out[4] += frame[2, i] * force[i]


@kernel
def _cross(a: Floats, bx: float, by: float, bz: float, out: Floats) -> None:
    out[0] = a[1] * bz - a[2] * by
    out[1] = a[2] * bx - a[0] * bz
    out[2] = a[0] * by - a[1] * bx


@kernel
def _add_dipole(frame: Floats, source: Floats, target: Floats, r: Floats, out: Floats) -> None:
    """Add the wrench of the moment ``source`` on ``target`` at offset ``r`` to ``out`` (5,)."""
    tau, force = np.empty(3), np.empty(3)
    tau[0], tau[1], tau[2], force[0], force[1], force[2] = dipole_wrench(
        source[0], source[1], source[2], target[0], target[1], target[2], r[0], r[1], r[2]
    )
    _to_magnet_frame(frame, tau, force, out)


@kernel
def wrench_kernel(positions: Floats, moments: Floats, pose: Floats, epm_moment: float, wrench: Floats) -> None:
    """Write U (10,) for robots at ``positions`` (2, 3) with ``moments`` (2, 3) under EPMs at ``pose`` (5 N)."""
    frame, epm, r, source = np.empty((3, 3)), np.empty(6), np.empty(3), np.empty(3)
    wrench[:] = 0.0
    for robot in range(N_ROBOTS):
        out = wrench[5 * robot : 5 * robot + 5]
        target = moments[robot]
        magnet_frame(target, frame)
        other = 1 - robot
        for i in range(3):
            r[i] = positions[robot, i] - positions[other, i]
        _add_dipole(frame, moments[other], target, r, out)
        for k in range(len(pose) // POSE_SIZE):
            pose_to_epm(pose[POSE_SIZE * k : POSE_SIZE * k + POSE_SIZE], epm)
            for i in range(3):
                r[i] = positions[robot, i] - epm[i]
                source[i] = epm_moment * epm[3 + i]
            _add_dipole(frame, source, target, r, out)


@kernel
def _pose_tangents(pose: Floats, position: Floats, moment: Floats) -> None:
    """Write d centre / d (azimuth, elevation, radius) and d unit moment / d (azimuth, elevation) as rows."""
    for tangents, azimuth, elevation, scale in (
        (position, pose[0], pose[1], pose[2]),
        (moment, pose[3], pose[4], 1.0),
    ):
        ca, sa, ce, se = math.cos(azimuth), math.sin(azimuth), math.cos(elevation), math.sin(elevation)
        tangents[0, 0], tangents[0, 1], tangents[0, 2] = -scale * ce * sa, scale * ce * ca, 0.0
        tangents[1, 0], tangents[1, 1], tangents[1, 2] = -scale * se * ca, -scale * se * sa, scale * ce
        tangents[2, 0], tangents[2, 1], tangents[2, 2] = ce * ca, ce * sa, se


@kernel
def jacobian_kernel(positions: Floats, moments: Floats, pose: Floats, epm_moment: float, jacobian: Floats) -> None:
    """Write dU/dpose (10, 5 N); the mutual wrench of the robots does not depend on the pose."""
    frame, epm, r, source = np.empty((3, 3)), np.empty(6), np.empty(3), np.empty(3)
    by_position, by_moment, tau, force, column = (
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(3),
        np.empty(3),
        np.empty(5),
    )
    for k in range(len(pose) // POSE_SIZE):
        block = pose[POSE_SIZE * k : POSE_SIZE * k + POSE_SIZE]
        pose_to_epm(block, epm)
        _pose_tangents(block, by_position, by_moment)
        for robot in range(N_ROBOTS):
            m = moments[robot]
            magnet_frame(m, frame)
            for i in range(3):
                r[i] = positions[robot, i] - epm[i]
                source[i] = epm_moment * epm[3 + i]
            gxx, gxy, gxz, gyy, gyz, gzz = dipole_gradient(source[0], source[1], source[2], r[0], r[1], r[2])
            hxx, hxy, hxz, hyy, hyz, hzz = dipole_force_gradient(
                source[0], source[1], source[2], m[0], m[1], m[2], r[0], r[1], r[2]
            )
            for c in range(3):  # the EPM's centre: r moves the other way
                x, y, z = -by_position[c, 0], -by_position[c, 1], -by_position[c, 2]
                _cross(m, gxx * x + gxy * y + gxz * z, gxy * x + gyy * y + gyz * z, gxz * x + gyz * y + gzz * z, tau)
                force[0] = hxx * x + hxy * y + hxz * z
                force[1] = hxy * x + hyy * y + hyz * z
                force[2] = hxz * x + hyz * y + hzz * z
                column[:] = 0.0
                _to_magnet_frame(frame, tau, force, column)
                for i in range(5):
                    jacobian[5 * robot + i, POSE_SIZE * k + c] = column[i]
            for c in range(2):  # the EPM's moment: the wrench is linear in it
                for i in range(3):
                    source[i] = epm_moment * by_moment[c, i]
                column[:] = 0.0
                _add_dipole(frame, source, m, r, column)
                for i in range(5):
                    jacobian[5 * robot + i, POSE_SIZE * k + 3 + c] = column[i]


@kernel
def _wrench_rows(positions: Floats, moments: Floats, poses: Floats, epm_moment: float, out: Floats) -> None:
    for i in range(len(out)):
        wrench_kernel(positions[i], moments[i], poses[i], epm_moment, out[i])


@kernel
def _jacobian_rows(positions: Floats, moments: Floats, poses: Floats, epm_moment: float, out: Floats) -> None:
    for i in range(len(out)):
        jacobian_kernel(positions[i], moments[i], poses[i], epm_moment, out[i])


def _rows(
    positions: ArrayLike, moments: ArrayLike, pose: ArrayLike, epm_moment_am2: float
) -> tuple[tuple[int, ...], Floats, Floats, Floats]:
    p, m, x = (np.asarray(value, dtype=np.float64) for value in (positions, moments, pose))
    for name, value in (("positions", p), ("moments", m)):
        require(value.ndim >= 2 and value.shape[-2:] == (2, 3), name, "an array of shape (..., 2, 3)", value.shape)
    require(
        x.ndim >= 1 and x.shape[-1] > 0 and x.shape[-1] % POSE_SIZE == 0,
        "pose",
        "an array of shape (..., 5 N)",
        x.shape,
    )
    require(math.isfinite(epm_moment_am2) and epm_moment_am2 > 0, "epm_moment_am2", "a positive number", epm_moment_am2)
    shape = np.broadcast_shapes(p.shape[:-2], m.shape[:-2], x.shape[:-1])
    return (
        shape,
        np.ascontiguousarray(np.broadcast_to(p, (*shape, 2, 3)).reshape(-1, 2, 3)),
        np.ascontiguousarray(np.broadcast_to(m, (*shape, 2, 3)).reshape(-1, 2, 3)),
        np.ascontiguousarray(np.broadcast_to(x, (*shape, x.shape[-1])).reshape(-1, x.shape[-1])),
    )


def robot_wrench(positions: ArrayLike, moments: ArrayLike, pose: ArrayLike, epm_moment_am2: float) -> Floats:
    """Wrench on both robots from all EPMs and from each other, each in its own magnet frame (the paper's U).

    Parameters
    ----------
    positions, moments : array_like, shape (..., 2, 3)
        Robots' positions in m and magnetic moments in A m^2, global frame.
    pose : array_like, shape (..., 5 N)
        EPM poses (see ``magenv.poses``), for any number N of EPMs. Leading axes broadcast.
    epm_moment_am2 : float
        Moment of each EPM in A m^2.

    Returns
    -------
    ndarray, shape (..., 10)
        Per robot tau_y, tau_z (N m), F_x, F_y, F_z (N).

    Raises
    ------
    ValueError
        If a shape does not fit or the moment is not positive.
    """
    shape, p, m, x = _rows(positions, moments, pose, epm_moment_am2)
    out = np.empty((len(x), WRENCH_SIZE))
    _wrench_rows(p, m, x, float(epm_moment_am2), out)
    return out.reshape(*shape, WRENCH_SIZE)


def wrench_jacobian(positions: ArrayLike, moments: ArrayLike, pose: ArrayLike, epm_moment_am2: float) -> Floats:
    """Return the derivative of ``robot_wrench`` by the pose vector, shape (..., 10, 5 N), in closed form.

    Parameters and errors are those of ``robot_wrench``; units are those of U per rad, and per m for the radii.
    """
    shape, p, m, x = _rows(positions, moments, pose, epm_moment_am2)
    out = np.empty((len(x), WRENCH_SIZE, x.shape[-1]))
    _jacobian_rows(p, m, x, float(epm_moment_am2), out)
    return out.reshape(*shape, WRENCH_SIZE, x.shape[-1])


def planar_moments(headings: ArrayLike, ipm_moment_am2: float) -> Floats:
    """Return the moments (..., 3) in A m^2 of robots with the given headings (...) in rad."""
    theta = np.asarray(headings, dtype=np.float64)
    return ipm_moment_am2 * np.stack([np.cos(theta), np.sin(theta), np.zeros_like(theta)], axis=-1)
