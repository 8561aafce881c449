"""How the magnetic wrench in the plane changes as the robots move while the EPMs stand still: 6 x 6, in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.dipole import dipole_field, dipole_force, dipole_force_gradient, dipole_gradient
from magenv.kernels import kernel, law
from magenv.params import Body, require
from magenv.poses import POSE_SIZE, to_cartesian

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]
Vectors = tuple[Vector, Vector, Vector]


@law
def _add_source(out: Floats, robot: int, n: Vector, s: Vector, r: Vector) -> tuple[Vector, Vector, Vector]:
    """Add what the source s at the offset r makes of moves of ``robot``, moment n, to its block of ``out`` (6, 6).

    Returns the derivatives of F_x, F_y and tau_z by the offset, of which those by the robot's place are a part.
    """
    nx, ny, _ = n
    a = 3 * robot
    hxx, hxy, hxz, hyy, hyz, _ = dipole_force_gradient(*s, *n, *r)
    gxx, gxy, gxz, gyy, gyz, _ = dipole_gradient(*s, *r)
    bx, by, _ = dipole_field(*s, *r)
    fx, fy, _ = dipole_force(*s, -ny, nx, 0.0, *r)  # F = G n, and n turns as z cross n
    tx, ty, tz = nx * gxy - ny * gxx, nx * gyy - ny * gxy, nx * gyz - ny * gxz  # tau_z = n_x B_y - n_y B_x
    out[a, a] += hxx
    out[a, a + 1] += hxy
    out[a, a + 2] += fx
    out[a + 1, a] += hxy
    out[a + 1, a + 1] += hyy
    out[a + 1, a + 2] += fy
    out[a + 2, a] += tx
    out[a + 2, a + 1] += ty
    out[a + 2, a + 2] += -ny * by - nx * bx
    return (hxx, hxy, hxz), (hxy, hyy, hyz), (tx, ty, tz)


@law
def _add_mutual(out: Floats, robot: int, n: Vector, s: Vector, r: Vector) -> None:
    """Add what moves of the other robot, with moment s, make of the wrench on ``robot`` with moment n."""
    nx, ny, _ = n
    a, b = 3 * robot, 3 * (1 - robot)
    hxx, hxy, _, hyy, _, _ = dipole_force_gradient(*s, *n, *r)
    gxx, gxy, _, gyy, _, _ = dipole_gradient(*s, *r)
    turned = (-s[1], s[0], 0.0)
    fx, fy, _ = dipole_force(*turned, *n, *r)
    bx, by, _ = dipole_field(*turned, *r)
    out[a, b] -= hxx
    out[a, b + 1] -= hxy
    out[a, b + 2] += fx
    out[a + 1, b] -= hxy
    out[a + 1, b + 1] -= hyy
    out[a + 1, b + 2] += fy
    out[a + 2, b] -= nx * gxy - ny * gxx
    out[a + 2, b + 1] -= nx * gyy - ny * gxy
    out[a + 2, b + 2] += nx * by - ny * bx


@law
def _write_gradients(out: Floats, robot: int, k: int, n: Vector, r: Vector, moment: float, by: Vectors) -> None:
    """Write the derivatives of F_x, F_y and tau_z of ``robot``, moment n, by EPM ``k`` into ``out`` (6, 6 N).

    ``by`` holds those by the offset r, which falls as the EPM's centre rises. Force and field are linear in the EPM's
    moment by symmetric tensors: F_i(m) = m . G(n) e_i, and tau_z(m) = m . B(z cross n).
    """
    nx, ny, _ = n
    lxx, lxy, lxz, lyy, lyz, _ = dipole_gradient(*n, *r)
    turned = dipole_field(-ny, nx, 0.0, *r)
    rows = ((lxx, lxy, lxz), (lxy, lyy, lyz), turned)
    for i in range(3):
        for j in range(3):
            out[3 * robot + i, 6 * k + j] = -by[i][j]
            out[3 * robot + i, 6 * k + 3 + j] = moment * rows[i][j]


@kernel
def write_mutual(positions: Floats, moments: Floats, stiffness: Floats) -> None:
    """Write what the robots alone make of the stiffness; arguments as of ``planar_kernel``."""
    stiffness[:] = 0.0
    for robot in range(2):
        p, m = positions[robot], moments[robot]
        q, other = positions[1 - robot], moments[1 - robot]
        n, s = (m[0], m[1], m[2]), (other[0], other[1], other[2])
        r = (p[0] - q[0], p[1] - q[1], p[2] - q[2])
        _add_source(stiffness, robot, n, s, r)
        _add_mutual(stiffness, robot, n, s, r)


@kernel
def add_epm(
    positions: Floats,
    moments: Floats,
    epms: Floats,
    epm_moments: Floats,
    k: int,
    by_epms: bool,
    stiffness: Floats,
    gradients: Floats,
) -> None:
    """Add what EPM ``k`` makes of the stiffness; arguments as of ``planar_kernel``."""
    e, moment = epms[k], epm_moments[k]
    s = (moment * e[3], moment * e[4], moment * e[5])
    for robot in range(2):
        p, m = positions[robot], moments[robot]
        n, r = (m[0], m[1], m[2]), (p[0] - e[0], p[1] - e[1], p[2] - e[2])
        by = _add_source(stiffness, robot, n, s, r)
        if by_epms:
            _write_gradients(gradients, robot, k, n, r, moment, by)


@kernel
def planar_kernel(
    positions: Floats,
    moments: Floats,
    epms: Floats,
    epm_moments: Floats,
    by_epms: bool,
    stiffness: Floats,
    gradients: Floats,
) -> None:
    """Write the derivatives of (F_x, F_y, tau_z) of both robots by (x, y, heading) of both, and by the EPMs.

    Parameters
    ----------
    positions, moments : ndarray, shape (2, 3)
        Of the robots, in the plane.
    epms : ndarray, shape (N, 6)
        Centres and unit moments.
    epm_moments : ndarray, shape (N,)
        A m^2.
    stiffness : ndarray, shape (6, 6)
        Global frame, N and N m per m and rad.
    gradients : ndarray, shape (6, 6 N)
        Per m of the centre and per unit of the unit moment, written where ``by_epms``.
    """
    write_mutual(positions, moments, stiffness)
    for k in range(len(epms)):
        add_epm(positions, moments, epms, epm_moments, k, by_epms, stiffness, gradients)


def planar_stiffness(positions: ArrayLike, moments: ArrayLike, pose: ArrayLike, epm_moment_am2: float) -> Floats:
    """Return K = d(F_x, F_y, tau_z of both robots) / d(x, y, heading of both), global frame.

    Parameters
    ----------
    positions, moments : array_like, shape (2, 3)
        Robots' positions in m and moments in A m^2, in the plane.
    pose : array_like, shape (5 N,)
        EPM poses (see ``magenv.poses``).
    epm_moment_am2 : float
        Moment of each EPM in A m^2.

    Returns
    -------
    ndarray, shape (6, 6)
        N and N m per m and rad.

    Raises
    ------
    ValueError
        If a shape does not fit or a moment is out of the plane.
    """
    p, m, x = (np.asarray(value, dtype=np.float64) for value in (positions, moments, pose))
    for name, value in (("positions", p), ("moments", m)):
        require(value.shape == (2, 3), name, "an array of shape (2, 3)", value.shape)
    require(bool((m[:, 2] == 0.0).all()), "moments", "in the plane", m.tolist())
    require(x.ndim == 1 and len(x) > 0 and len(x) % POSE_SIZE == 0, "pose", "an array of shape (5 N,)", x.shape)
    out, epms = np.empty((6, 6)), np.concatenate(to_cartesian(x), axis=-1)
    planar_kernel(p, m, epms, np.full(len(epms), float(epm_moment_am2)), False, out, np.empty((6, 0)))
    return out


def growth_rates(stiffness: Floats, body: Body) -> NDArray[np.complex128]:
    """Return the rates (12, 1/s) at which small deviations grow while the EPMs stand still, the fastest first.

    They are the eigenvalues of the linear motion M q'' + D q' = K q of both robots' x, y and heading, of mass and
    inertia M, viscous drag D and magnetic stiffness K (6, 6); those with real parts above 0 grow.
    """
    inertia = np.tile([body.mass_kg, body.mass_kg, body.inertia_kgm2], 2)
    drag = np.tile([body.drag_linear_nspm, body.drag_linear_nspm, body.drag_rotational_nmsprad], 2)
    motion = np.zeros((12, 12))
    motion[:6, 6:] = np.eye(6)
    motion[6:, :6] = stiffness / inertia[:, None]
    motion[6:, 6:] = np.diag(-drag / inertia)
    rates = np.linalg.eigvals(motion).astype(np.complex128)
    return rates[np.argsort(-rates.real, kind="stable")]
