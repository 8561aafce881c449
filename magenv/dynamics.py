"""Planar motion of the two robots under magnetic wrench, viscous drag and contact: one step of the integrator.

A robot's state is a row (x, y, heading, v_x, v_y, rate) in m, rad, m/s, rad/s. Episodes move side by side in the
columns of ``lanes`` (see ``magenv.lanes``); the laws here are those of one lane.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.arithmetic import dot2, fma
from magenv.kernels import kernel, law
from magenv.lanes import (
    DECAY1,
    DECAY2,
    FRICTION,
    GAIN1,
    GAIN2,
    HEADING1,
    HEADING2,
    PUSH_TURN1,
    PUSH_TURN2,
    PUSH_X1,
    PUSH_X2,
    PUSH_Y1,
    PUSH_Y2,
    RATE1,
    RATE2,
    TURN_DECAY1,
    TURN_DECAY2,
    TURN_FRICTION,
    TURN_GAIN1,
    TURN_GAIN2,
    VX1,
    VX2,
    VY1,
    VY2,
    X1,
    X2,
    Y1,
    Y2,
)
from magenv.magnets import Size, robots_wrench
from magenv.params import Plant, System

Floats = NDArray[np.float64]

TOUCH = 1
WALL = 2
_CONTACT_TURNS = 200
_NO_SPEED = 1e-300
"""Stands for zero where it is divided by."""
_SLIGHTLY_MORE = 1.0 + 1e-9  # more than rounding can be


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
    """(n, N) A m^2."""
    epm_size: Size
    """See ``magnets``."""
    body_diameter: float
    """m."""
    wall_radius: float
    """m."""

    @classmethod
    def of(cls, system: System, plant: Plant, n: int) -> Physics:
        """Return ``n`` equal rows of the parameters of ``system`` and ``plant``."""
        body, epm = plant.body, system.epm
        return cls(
            mass=np.full((n, 2), body.mass_kg),
            inertia=np.full((n, 2), body.inertia_kgm2),
            drag_linear=np.full((n, 2), body.drag_linear_nspm),
            drag_rotational=np.full((n, 2), body.drag_rotational_nmsprad),
            ipm_moment=np.full((n, 2), system.ipm_moment_am2),
            epm_moment=np.full((n, system.n_epm), system.epm_moment_am2),
            epm_size=(epm.diameter_m, epm.length_m) if plant.epm_cylinders else None,
            body_diameter=body.diameter_m,
            wall_radius=plant.workspace_radius_m,
        )


Pair = tuple[float, float]


@kernel
def _drag(drag: float, inertia: float, h: float) -> tuple[float, float]:
    decay = math.exp(-drag * h / inertia)
    return decay, (1.0 - decay) / drag if drag > 0.0 else h / inertia


@kernel
def constants(physics: Physics, h: float, out: Floats) -> None:
    """Write what a substep of ``h`` (s) needs of the physics into ``out`` (n, 10), in the order of ``lanes``.

    Decay and gain of v(t + h) = decay v + gain F, linear and turning: exact for constant force F under viscous drag.
    Then the moments (A m^2). Of each there are two, one a robot.
    """
    for row in range(len(out)):
        for robot in range(2):
            out[row, robot], out[row, 2 + robot] = _drag(physics.drag_linear[row, robot], physics.mass[row, robot], h)
            out[row, 4 + robot], out[row, 6 + robot] = _drag(
                physics.drag_rotational[row, robot], physics.inertia[row, robot], h
            )
            out[row, 8 + robot] = physics.ipm_moment[row, robot]


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


@law
def _rub(speed: float, gain: float, friction: float) -> float:
    """Return by what dry friction (N, or N m) multiplies a speed at the end of a kick: it brings to rest, not farther.

    Coulomb's law, implicit in the new speed, so that a robot at rest stays there while less than the friction acts.
    """
    return max(0.0, 1.0 - gain * friction / max(speed, _NO_SPEED))


@law
def _rub_both(lanes: Floats, i: int, gain: float, vx: float, vy: float) -> Pair:
    left = _rub(math.sqrt(dot2(vx, vy, vx, vy)), gain, lanes[FRICTION, i])
    return left * vx, left * vy


@law
def advance(lanes: Floats, i: int, n_epm: int, size: Size, h: float, rough: bool) -> None:
    """Advance both robots of lane ``i`` by ``h`` (s), contact apart; where ``rough``, pushed and rubbed as well.

    Half a drift, a kick with drag integrated exactly, half a drift: symmetric, so of second order, with one evaluation
    of the wrench; exact for the terminal velocity however strong the drag.
    """
    half = 0.5 * h
    vx1, vy1, rate1 = lanes[VX1, i], lanes[VY1, i], lanes[RATE1, i]
    vx2, vy2, rate2 = lanes[VX2, i], lanes[VY2, i], lanes[RATE2, i]
    x1, y1, heading1 = fma(half, vx1, lanes[X1, i]), fma(half, vy1, lanes[Y1, i]), fma(half, rate1, lanes[HEADING1, i])
    x2, y2, heading2 = fma(half, vx2, lanes[X2, i]), fma(half, vy2, lanes[Y2, i]), fma(half, rate2, lanes[HEADING2, i])
    f1x, f1y, tz1, f2x, f2y, tz2 = robots_wrench(lanes, i, n_epm, size, x1, y1, heading1, x2, y2, heading2)
    if rough:
        f1x, f1y, tz1 = f1x + lanes[PUSH_X1, i], f1y + lanes[PUSH_Y1, i], tz1 + lanes[PUSH_TURN1, i]
        f2x, f2y, tz2 = f2x + lanes[PUSH_X2, i], f2y + lanes[PUSH_Y2, i], tz2 + lanes[PUSH_TURN2, i]
    # v = decay v + gain F
    vx1, vy1 = dot2(lanes[DECAY1, i], lanes[GAIN1, i], vx1, f1x), dot2(lanes[DECAY1, i], lanes[GAIN1, i], vy1, f1y)
    vx2, vy2 = dot2(lanes[DECAY2, i], lanes[GAIN2, i], vx2, f2x), dot2(lanes[DECAY2, i], lanes[GAIN2, i], vy2, f2y)
    rate1 = dot2(lanes[TURN_DECAY1, i], lanes[TURN_GAIN1, i], rate1, tz1)
    rate2 = dot2(lanes[TURN_DECAY2, i], lanes[TURN_GAIN2, i], rate2, tz2)
    if rough:
        vx1, vy1 = _rub_both(lanes, i, lanes[GAIN1, i], vx1, vy1)
        vx2, vy2 = _rub_both(lanes, i, lanes[GAIN2, i], vx2, vy2)
        rate1 *= _rub(abs(rate1), lanes[TURN_GAIN1, i], lanes[TURN_FRICTION, i])
        rate2 *= _rub(abs(rate2), lanes[TURN_GAIN2, i], lanes[TURN_FRICTION, i])
    lanes[VX1, i], lanes[VY1, i], lanes[RATE1, i] = vx1, vy1, rate1
    lanes[VX2, i], lanes[VY2, i], lanes[RATE2, i] = vx2, vy2, rate2
    lanes[X1, i], lanes[Y1, i], lanes[HEADING1, i] = fma(half, vx1, x1), fma(half, vy1, y1), fma(half, rate1, heading1)
    lanes[X2, i], lanes[Y2, i], lanes[HEADING2, i] = fma(half, vx2, x2), fma(half, vy2, y2), fma(half, rate2, heading2)


@law
def may_touch(lanes: Floats, i: int, diameter: float, wall_radius: float) -> bool:
    """Return whether ``resolve_contact`` must look at lane ``i``: where it says no, there is no contact."""
    near, far = diameter * _SLIGHTLY_MORE, (wall_radius - 0.5 * diameter) / _SLIGHTLY_MORE
    x1, y1, x2, y2 = lanes[X1, i], lanes[Y1, i], lanes[X2, i], lanes[Y2, i]
    dx, dy = x2 - x1, y2 - y1
    touch: bool = dot2(dx, dy, dx, dy) < near * near
    return touch | (dot2(x1, y1, x1, y1) > far * far) | (dot2(x2, y2, x2, y2) > far * far)
