"""Magnetic wrench on the two robots: superposition, frames, the paper's ten-vector U and its Jacobian by EPM pose.

U holds per robot (tau_y, tau_z, F_x, F_y, F_z), N m and N, in the robot's magnet frame: x along its moment, z the
global z made orthogonal to x, y = z cross x. The torque about x is always zero.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.dipole import (
    dipole_field,
    dipole_force,
    dipole_force_gradient,
    dipole_force_hessian,
    dipole_gradient,
)
from magenv.kernels import kernel, law
from magenv.params import common_shape, require
from magenv.poses import POSE_SIZE, pose_to_epm

Floats = NDArray[np.float64]

N_ROBOTS = 2
WRENCH_SIZE = 10
IN_PLANE = (1, 2, 3, 6, 7, 8)
"""Components of U that act on robots in the plane: tau_z, F_x, F_y of each; the plane bears the others."""


@law
def dipole_wrench(
    sx: float, sy: float, sz: float, mx: float, my: float, mz: float, rx: float, ry: float, rz: float
) -> tuple[float, float, float, float, float, float]:
    """Return torque (N m) and force (N) of the dipole s on the dipole m, r = position of m - position of s.

    tau = m x B and F = (grad B)^T m (paper, section II-A).
    """
    bx, by, bz = dipole_field(sx, sy, sz, rx, ry, rz)
    fx, fy, fz = dipole_force(sx, sy, sz, mx, my, mz, rx, ry, rz)
    return my * bz - mz * by, mz * bx - mx * bz, mx * by - my * bx, fx, fy, fz


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


@law
def _add_dipole(frame: Floats, source: Floats, target: Floats, r: Floats, out: Floats) -> None:
    """Add the wrench of the moment ``source`` on ``target`` at offset ``r``, in the magnet frame, to ``out`` (5,)."""
    tx, ty, tz, fx, fy, fz = dipole_wrench(
        source[0], source[1], source[2], target[0], target[1], target[2], r[0], r[1], r[2]
    )
    for i in range(2):
        out[i] += frame[1 + i, 0] * tx + frame[1 + i, 1] * ty + frame[1 + i, 2] * tz
    for i in range(3):
        out[2 + i] += frame[i, 0] * fx + frame[i, 1] * fy + frame[i, 2] * fz


@kernel
def robot_frames(positions: Floats, moments: Floats, frames: Floats, mutual: Floats) -> None:
    """Write what no EPM changes: the magnet frames (2, 3, 3) and the robots' mutual wrench (10)."""
    r = np.empty(3)
    mutual[:] = 0.0
    for robot in range(N_ROBOTS):
        other = 1 - robot
        magnet_frame(moments[robot], frames[robot])
        for i in range(3):
            r[i] = positions[robot, i] - positions[other, i]
        _add_dipole(frames[robot], moments[other], moments[robot], r, mutual[5 * robot : 5 * robot + 5])


@law
def epm_offset(positions: Floats, robot: int, epm: Floats, epm_moment: float, r: Floats, source: Floats) -> None:
    """Write the offset (3,) of a robot from an EPM and the EPM's moment (3,)."""
    for i in range(3):
        r[i] = positions[robot, i] - epm[i]
        source[i] = epm_moment * epm[3 + i]


@kernel
def add_epms(
    positions: Floats, moments: Floats, frames: Floats, epms: Floats, epm_moment: float, work: Floats, wrench: Floats
) -> None:
    """Add the wrench of the EPMs (N, 6) on both robots to ``wrench`` (10); ``work`` (2, 3) is scratch."""
    r, source = work[0], work[1]
    for robot in range(N_ROBOTS):
        for k in range(len(epms)):
            epm_offset(positions, robot, epms[k], epm_moment, r, source)
            _add_dipole(frames[robot], source, moments[robot], r, wrench[5 * robot : 5 * robot + 5])


@kernel
def wrench_kernel(positions: Floats, moments: Floats, pose: Floats, epm_moment: float, wrench: Floats) -> None:
    """Write U (10,) for robots at ``positions`` (2, 3) with ``moments`` (2, 3) under EPMs at ``pose`` (5 N)."""
    n = len(pose) // POSE_SIZE
    frames, epms, work = np.empty((N_ROBOTS, 3, 3)), np.empty((n, 6)), np.empty((2, 3))
    for k in range(n):
        pose_to_epm(pose[POSE_SIZE * k : POSE_SIZE * k + POSE_SIZE], epms[k])
    robot_frames(positions, moments, frames, wrench)
    add_epms(positions, moments, frames, epms, epm_moment, work, wrench)


@kernel
def wrench_gradients(
    positions: Floats, moments: Floats, frames: Floats, epms: Floats, epm_moment: float, work: Floats, out: Floats
) -> None:
    """Write dU / d (centre, unit moment) of the EPMs (N, 6) into ``out`` (10, 6 N); ``work`` (2, 3) is scratch.

    With the frame's axes x, y, z and n = |n| x the robot's moment, U = |n| (-z.B, y.B, x.Gx, y.Gx, z.Gx), and both B
    and G = grad B are linear in the EPM's moment m by symmetric tensors: a.B(m) = m.B(a) and a.G(m) n = m.G(n) a.
    """
    r, s = work[0], work[1]
    for robot in range(N_ROBOTS):
        n, frame = moments[robot], frames[robot]
        size = math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        for k in range(len(epms)):
            epm_offset(positions, robot, epms[k], epm_moment, r, s)
            gxx, gxy, gxz, gyy, gyz, gzz = dipole_gradient(s[0], s[1], s[2], r[0], r[1], r[2])
            hxx, hxy, hxz, hyy, hyz, hzz = dipole_force_gradient(s[0], s[1], s[2], n[0], n[1], n[2], r[0], r[1], r[2])
            lxx, lxy, lxz, lyy, lyz, lzz = dipole_gradient(n[0], n[1], n[2], r[0], r[1], r[2])
            for i in range(2):  # torques about y and z: along -z and y; the offset falls as the centre rises
                axis, sign = frame[2 - i], (-size if i == 0 else size)
                ax, ay, az = sign * axis[0], sign * axis[1], sign * axis[2]
                row = out[5 * robot + i, 6 * k : 6 * k + 6]
                row[0] = -(gxx * ax + gxy * ay + gxz * az)
                row[1] = -(gxy * ax + gyy * ay + gyz * az)
                row[2] = -(gxz * ax + gyz * ay + gzz * az)
                bx, by, bz = dipole_field(ax, ay, az, r[0], r[1], r[2])
                row[3], row[4], row[5] = epm_moment * bx, epm_moment * by, epm_moment * bz
            for i in range(3):
                ax, ay, az = frame[i, 0], frame[i, 1], frame[i, 2]
                row = out[5 * robot + 2 + i, 6 * k : 6 * k + 6]
                row[0] = -(hxx * ax + hxy * ay + hxz * az)
                row[1] = -(hxy * ax + hyy * ay + hyz * az)
                row[2] = -(hxz * ax + hyz * ay + hzz * az)
                row[3] = epm_moment * (lxx * ax + lxy * ay + lxz * az)
                row[4] = epm_moment * (lxy * ax + lyy * ay + lyz * az)
                row[5] = epm_moment * (lxz * ax + lyz * ay + lzz * az)


@kernel
def wrench_curvature(
    positions: Floats,
    moments: Floats,
    frames: Floats,
    epms: Floats,
    epm_moment: float,
    weights: Floats,
    work: Floats,
    out: Floats,
) -> None:
    """Write the second derivatives of ``weights`` (10) . U by the EPMs (N, 6) into ``out`` (N, 2, 6).

    ``[k, 0]`` is by the centre twice, ``[k, 1]`` by centre and unit moment, both symmetric: (xx, xy, xz, yy, yz, zz).
    By the moment twice it is zero, and so it is by two EPMs. ``work`` (2, 3) is scratch.
    """
    r, s = work[0], work[1]
    out[:] = 0.0
    for robot in range(N_ROBOTS):
        n, f = moments[robot], frames[robot]
        w = weights[5 * robot : 5 * robot + 5]
        size = math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        # weights . U = a.B + c.G n
        ax, ay, az = (
            size * (w[1] * f[1, 0] - w[0] * f[2, 0]),
            size * (w[1] * f[1, 1] - w[0] * f[2, 1]),
            size * (w[1] * f[1, 2] - w[0] * f[2, 2]),
        )
        cx, cy, cz = (
            w[2] * f[0, 0] + w[3] * f[1, 0] + w[4] * f[2, 0],
            w[2] * f[0, 1] + w[3] * f[1, 1] + w[4] * f[2, 1],
            w[2] * f[0, 2] + w[3] * f[1, 2] + w[4] * f[2, 2],
        )
        for k in range(len(epms)):
            epm_offset(positions, robot, epms[k], epm_moment, r, s)
            twice = dipole_force_gradient(s[0], s[1], s[2], ax, ay, az, r[0], r[1], r[2])
            third = dipole_force_hessian(s[0], s[1], s[2], n[0], n[1], n[2], cx, cy, cz, r[0], r[1], r[2])
            once = dipole_gradient(ax, ay, az, r[0], r[1], r[2])
            second = dipole_force_gradient(n[0], n[1], n[2], cx, cy, cz, r[0], r[1], r[2])
            for i in range(6):
                out[k, 0, i] += twice[i] + third[i]
                out[k, 1, i] -= epm_moment * (once[i] + second[i])


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
    n = len(pose) // POSE_SIZE
    frames, epms, work = np.empty((N_ROBOTS, 3, 3)), np.empty((n, 6)), np.empty((2, 3))
    gradients, mutual = np.empty((WRENCH_SIZE, 6 * n)), np.empty(WRENCH_SIZE)
    by_position, by_moment = np.empty((3, 3)), np.empty((3, 3))
    for k in range(n):
        pose_to_epm(pose[POSE_SIZE * k : POSE_SIZE * k + POSE_SIZE], epms[k])
    robot_frames(positions, moments, frames, mutual)
    wrench_gradients(positions, moments, frames, epms, epm_moment, work, gradients)
    for k in range(n):
        _pose_tangents(pose[POSE_SIZE * k : POSE_SIZE * k + POSE_SIZE], by_position, by_moment)
        for i in range(WRENCH_SIZE):
            g = gradients[i, 6 * k : 6 * k + 6]
            row = jacobian[i, POSE_SIZE * k : POSE_SIZE * k + POSE_SIZE]
            for c in range(3):
                row[c] = g[0] * by_position[c, 0] + g[1] * by_position[c, 1] + g[2] * by_position[c, 2]
            for c in range(2):
                row[3 + c] = g[3] * by_moment[c, 0] + g[4] * by_moment[c, 1] + g[5] * by_moment[c, 2]


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
    shape = common_shape(positions=p.shape[:-2], moments=m.shape[:-2], pose=x.shape[:-1])
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
