"""The motion of the robots with its derivatives: what the state becomes, and how that depends on what was before.

A state (12,) has per robot x, y and heading, then their rates: (x_1, y_1, heading_1, x_2, ..., v_x1, v_y1, ...). The
derivatives are those of ``dynamics.advance`` itself, substep by substep, in closed form (stiffness and control
gradient of the wrench); contact and dry friction have none and are left out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magenv.dynamics import Physics, advance, constants
from magenv.kernels import kernel, law
from magenv.lanes import (
    CONSTANTS,
    CONSTANTS_SIZE,
    DECAY1,
    FRICTION,
    GAIN1,
    MOMENT1,
    PUSH_X1,
    TURN_DECAY1,
    TURN_FRICTION,
    TURN_GAIN1,
    X1,
    fields,
)
from magenv.magnets import place_epm, robots_wrench
from magenv.params import Plant, System
from magenv.poses import EPM_SIZE
from magenv.stiffness import planar_kernel

Floats = NDArray[np.float64]

COORDINATES = 6
"""x, y and heading of both robots."""


class Model(NamedTuple):
    """What a controller believes of the plant, EPMs that are dipoles among it, and room to compute in."""

    lane: Floats
    """(fields, 1): the plant's own layout, with the constants of a substep in place."""
    epm_moment: Floats
    """(N,) A m^2."""
    nominal: Floats
    """(N + 2,) moments of the EPMs and of the robots as they should be, A m^2."""
    substep: float
    """s."""
    positions: Floats
    """(2, 3) of the robots, in m and A m^2, halfway through a substep; so are the moments."""
    moments: Floats
    stiffness: Floats
    """(6, 6) of the substep to come, see ``differentiate``; so is the next."""
    gradients: Floats
    """(6, 6 N)"""

    @classmethod
    def of(cls, system: System, plant: Plant, substep_s: float) -> Model:
        """Return the model of a plant stepped by ``substep_s``."""
        n, physics = system.n_epm, Physics.of(system, plant, 1)
        lane, row = np.zeros((fields(n, False), 1)), np.empty((1, CONSTANTS_SIZE))
        constants(physics, substep_s, row)
        lane[CONSTANTS : CONSTANTS + CONSTANTS_SIZE, 0] = row
        lane[FRICTION, 0], lane[TURN_FRICTION, 0] = plant.dry_friction_n, plant.dry_friction_nm
        return cls(
            lane,
            np.full(n, system.epm_moment_am2),
            np.concatenate([np.full(n, system.epm_moment_am2), np.full(2, system.ipm_moment_am2)]),
            substep_s,
            np.zeros((2, 3)),
            np.zeros((2, 3)),
            np.empty((COORDINATES, COORDINATES)),
            np.empty((COORDINATES, EPM_SIZE * n)),
        )


@law
def _field(j: int) -> int:
    """Return the lane's field of the j-th number of a state."""
    return X1 + 2 * (j % 3) + (j // 3) % 2 + COORDINATES * (j // COORDINATES)


@law
def load_state(model: Model, state: Floats) -> None:
    """Put a state (12,) into the model's lane."""
    for j in range(2 * COORDINATES):
        model.lane[_field(j), 0] = state[j]


@law
def read_state(model: Model, state: Floats) -> None:
    """Write the state (12,) of the model's lane."""
    for j in range(2 * COORDINATES):
        state[j] = model.lane[_field(j), 0]


@law
def push(model: Model, wrench: Floats) -> None:
    """Let a constant wrench (6,) push the robots: F_x, F_y (N), tau_z (N m) of both."""
    for j in range(COORDINATES):
        model.lane[PUSH_X1 + 2 * (j % 3) + j // 3, 0] = wrench[j]


@law
def place(model: Model, epms: Floats) -> None:
    """Put EPMs (N, 6), centres and unit moments, into the model's lane."""
    for k in range(len(epms)):
        e = epms[k]
        place_epm(model.lane, 0, k, None, model.epm_moment[k], e[0], e[1], e[2], e[3], e[4], e[5])


@law
def believe(model: Model, amiss: Floats) -> None:
    """Let the moments of EPMs and robots be off by these shares (N + 2,) of their nominal ones."""
    n = len(model.epm_moment)
    for k in range(n):
        model.epm_moment[k] = model.nominal[k] * (1.0 + amiss[k])
    for robot in range(2):
        model.lane[MOMENT1 + robot, 0] = model.nominal[n + robot] * (1.0 + amiss[n + robot])


@law
def go(model: Model) -> None:
    """Go on by a substep."""
    advance(model.lane, 0, len(model.epm_moment), None, model.substep, True)


@kernel
def differentiate(model: Model, epms: Floats, by_epms: bool) -> None:
    """Write the derivatives of the planar wrench halfway through the substep to come into the model.

    ``model.stiffness`` (6, 6) by the robots' coordinates; where ``by_epms``, ``model.gradients`` (6, 6 N) by the EPMs'
    centres and unit moments, of EPMs (N, 6) as in the lane.
    """
    lane, half = model.lane, 0.5 * model.substep
    for robot in range(2):
        at, moment = X1 + robot, lane[MOMENT1 + robot, 0]
        heading = lane[at + 4, 0] + half * lane[at + 10, 0]
        model.positions[robot, 0] = lane[at, 0] + half * lane[at + 6, 0]
        model.positions[robot, 1] = lane[at + 2, 0] + half * lane[at + 8, 0]
        model.moments[robot, 0], model.moments[robot, 1] = moment * math.cos(heading), moment * math.sin(heading)
    planar_kernel(model.positions, model.moments, epms, model.epm_moment, by_epms, model.stiffness, model.gradients)


@kernel
def by_moments(model: Model, epms: Floats, amiss: Floats, drive: Floats) -> None:
    """Write the derivatives of the wrench by ``amiss`` (N + 2,), which is believed, into the last columns of ``drive``.

    After ``differentiate`` by the EPMs (N, 6): the wrench is linear in each moment, and so in what is amiss with it.
    """
    n, (p, q), (m1, m2) = len(epms), model.positions, model.moments
    heading1, heading2 = math.atan2(m1[1], m1[0]), math.atan2(m2[1], m2[0])
    whole = robots_wrench(model.lane, 0, n, None, p[0], p[1], heading1, q[0], q[1], heading2)
    first = drive.shape[1] - n - 2
    for i in range(COORDINATES):
        mutual = whole[i]
        for k in range(n):
            e, part = 3 + EPM_SIZE * k, 0.0
            for a in range(3):
                part += model.gradients[i, e + a] * epms[k, 3 + a]
            mutual -= part
            drive[i, first + k] = part / (1.0 + amiss[k])
        for robot in range(2):
            depends = whole[i] if i // 3 == robot else mutual
            drive[i, first + n + robot] = depends / (1.0 + amiss[n + robot])


@kernel
def chain(model: Model, sensitivity: Floats, drive: Floats) -> None:
    """Carry the derivatives (12, m) of the state over a substep, ``differentiate`` before it.

    ``drive`` (6, m) holds those of the wrench, other than by the robots' coordinates.
    """
    s, k, half, m = sensitivity, model.stiffness, 0.5 * model.substep, sensitivity.shape[1]
    for i in range(COORDINATES):
        for j in range(m):
            s[i, j] += half * s[COORDINATES + i, j]
    for i in range(COORDINATES):
        robot, turns = i // 3, i % 3 == 2
        decay = model.lane[(TURN_DECAY1 if turns else DECAY1) + robot, 0]
        gain = model.lane[(TURN_GAIN1 if turns else GAIN1) + robot, 0]
        a, b, c = gain * k[i, 0], gain * k[i, 1], gain * k[i, 2]
        d, e, f = gain * k[i, 3], gain * k[i, 4], gain * k[i, 5]
        for j in range(m):  # written out, so that it is one pass, and vectorised
            first, second = a * s[0, j] + b * s[1, j] + c * s[2, j], d * s[3, j] + e * s[4, j] + f * s[5, j]
            s[COORDINATES + i, j] = decay * s[COORDINATES + i, j] + gain * drive[i, j] + (first + second)
    for i in range(COORDINATES):
        for j in range(m):
            s[i, j] += half * s[COORDINATES + i, j]
