"""Planar motion of the two robots under magnetic wrench, viscous drag and contact: one step of the integrator.

A robot's state is a row (x, y, heading, v_x, v_y, rate) in m, rad, m/s, rad/s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.kernels import kernel
from magenv.params import Plant, System
from magenv.wrench import dipole_wrench

Floats = NDArray[np.float64]

TOUCH = 1
WALL = 2
_CONTACT_TURNS = 200


class Physics(NamedTuple):
    """Physical parameters of ``n`` episodes, one row each, per robot where they are a robot's."""

    mass: Floats
    """(n, 2) kg."""
    inertia: Floats
    """(n, 2) kg m^2."""
    drag_linear: Floats
    """(n, 2) N s/m."""
    drag_rotational: Floats
    """(n, 2) N m s/rad."""
    ipm_moment: Floats
    """(n, 2) A m^2."""
    epm_moment: Floats
    """(n,) A m^2."""
    body_diameter: float
    """m."""
    wall_radius: float
    """m."""

    @classmethod
    def of(cls, system: System, plant: Plant, n: int) -> Physics:
        """Return ``n`` equal rows of the parameters of ``system`` and ``plant``."""
        body = plant.body
        return cls(
            mass=np.full((n, 2), body.mass_kg),
            inertia=np.full((n, 2), body.inertia_kgm2),
            drag_linear=np.full((n, 2), body.drag_linear_nspm),
            drag_rotational=np.full((n, 2), body.drag_rotational_nmsprad),
            ipm_moment=np.full((n, 2), system.ipm_moment_am2),
            epm_moment=np.full(n, system.epm_moment_am2),
            body_diameter=body.diameter_m,
            wall_radius=plant.workspace_radius_m,
        )


@kernel
def planar_wrench(robots: Floats, epms: Floats, ipm_moment: Floats, epm_moment: float, out: Floats) -> None:
    """Write F_x, F_y (N) and tau_z (N m) on both robots, global frame, into ``out`` (2, 3).

    Out-of-plane components are borne by the plane. The force between the robots is computed once and obeys Newton's
    third law exactly; the torques differ.
    """
    x1, y1, x2, y2 = robots[0, 0], robots[0, 1], robots[1, 0], robots[1, 1]
    m1x, m1y = ipm_moment[0] * math.cos(robots[0, 2]), ipm_moment[0] * math.sin(robots[0, 2])
    m2x, m2y = ipm_moment[1] * math.cos(robots[1, 2]), ipm_moment[1] * math.sin(robots[1, 2])
    _, _, tz2, fx, fy, _ = dipole_wrench(m1x, m1y, 0.0, m2x, m2y, 0.0, x2 - x1, y2 - y1, 0.0)
    _, _, tz1, _, _, _ = dipole_wrench(m2x, m2y, 0.0, m1x, m1y, 0.0, x1 - x2, y1 - y2, 0.0)
    f1x, f1y, f2x, f2y = -fx, -fy, fx, fy
    for k in range(len(epms)):
        ex, ey, ez = epms[k, 0], epms[k, 1], epms[k, 2]
        sx, sy, sz = epm_moment * epms[k, 3], epm_moment * epms[k, 4], epm_moment * epms[k, 5]
        _, _, tz, fx, fy, _ = dipole_wrench(sx, sy, sz, m1x, m1y, 0.0, x1 - ex, y1 - ey, -ez)
        f1x, f1y, tz1 = f1x + fx, f1y + fy, tz1 + tz
        _, _, tz, fx, fy, _ = dipole_wrench(sx, sy, sz, m2x, m2y, 0.0, x2 - ex, y2 - ey, -ez)
        f2x, f2y, tz2 = f2x + fx, f2y + fy, tz2 + tz
    out[0, 0], out[0, 1], out[0, 2] = f1x, f1y, tz1
    out[1, 0], out[1, 1], out[1, 2] = f2x, f2y, tz2


@kernel
def _drag(drag: float, inertia: float, h: float) -> tuple[float, float]:
    decay = math.exp(-drag * h / inertia)
    return decay, (1.0 - decay) / drag if drag > 0.0 else h / inertia


@kernel
def drag_factors(physics: Physics, row: int, h: float, factors: Floats) -> None:
    """Write (decay, gain) of v(t + h) = decay v + gain F per robot and axis x, y, heading into ``factors`` (2, 3, 2).

    Exact for constant force F under viscous drag; the same for every substep of length ``h``.
    """
    for robot in range(2):
        linear = _drag(physics.drag_linear[row, robot], physics.mass[row, robot], h)
        factors[robot, 0, 0], factors[robot, 0, 1] = linear
        factors[robot, 1, 0], factors[robot, 1, 1] = linear
        turning = _drag(physics.drag_rotational[row, robot], physics.inertia[row, robot], h)
        factors[robot, 2, 0], factors[robot, 2, 1] = turning


@kernel
def resolve_contact(robots: Floats, mass: Floats, diameter: float, wall_radius: float) -> int:
    """Part overlapping bodies, keep them inside the wall, stop approaching motion (inelastic); return TOUCH | WALL."""
    contact = 0
    for _ in range(_CONTACT_TURNS):  # the wall may push a body back into the other
        found = _part_bodies(robots, mass, diameter) | _keep_inside(robots, wall_radius - 0.5 * diameter)
        contact |= found
        if found == 0:
            break
    return contact


@kernel
def _part_bodies(robots: Floats, mass: Floats, diameter: float) -> int:
    dx, dy = robots[1, 0] - robots[0, 0], robots[1, 1] - robots[0, 1]
    distance = math.hypot(dx, dy)
    if not distance < diameter:
        return 0
    nx, ny = (dx / distance, dy / distance) if distance > 0.0 else (1.0, 0.0)
    share = mass[1] / (mass[0] + mass[1])
    impulse = min((robots[1, 3] - robots[0, 3]) * nx + (robots[1, 4] - robots[0, 4]) * ny, 0.0)
    for robot, part in ((0, share), (1, share - 1.0)):
        robots[robot, 0] -= part * (diameter - distance) * nx
        robots[robot, 1] -= part * (diameter - distance) * ny
        robots[robot, 3] += part * impulse * nx
        robots[robot, 4] += part * impulse * ny
    return TOUCH


@kernel
def _keep_inside(robots: Floats, limit: float) -> int:
    found = 0
    for robot in range(2):
        x, y = robots[robot, 0], robots[robot, 1]
        radius = math.hypot(x, y)
        if radius > limit:
            found = WALL
            nx, ny = x / radius, y / radius
            outward = max(robots[robot, 3] * nx + robots[robot, 4] * ny, 0.0)
            robots[robot, 0], robots[robot, 1] = limit * nx, limit * ny
            robots[robot, 3] -= outward * nx
            robots[robot, 4] -= outward * ny
    return found


@kernel
def advance(robots: Floats, epms: Floats, physics: Physics, row: int, h: float, factors: Floats, force: Floats) -> int:
    """Advance both robots (2, 6) by ``h`` in place; return the contact flags.

    ``factors`` are those of ``drag_factors`` for ``h``, ``force`` (2, 3) is scratch.

    Half a drift, a kick with drag integrated exactly, half a drift: symmetric, so of second order, with one evaluation
    of the wrench; exact for the terminal velocity however strong the drag.
    """
    for robot in range(2):
        for axis in range(3):
            robots[robot, axis] += 0.5 * h * robots[robot, 3 + axis]
    planar_wrench(robots, epms, physics.ipm_moment[row], physics.epm_moment[row], force)
    for robot in range(2):
        for axis in range(3):
            decay, gain = factors[robot, axis, 0], factors[robot, axis, 1]
            robots[robot, 3 + axis] = decay * robots[robot, 3 + axis] + gain * force[robot, axis]
            robots[robot, axis] += 0.5 * h * robots[robot, 3 + axis]
    return resolve_contact(robots, physics.mass[row], physics.body_diameter, physics.wall_radius)
