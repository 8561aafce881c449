"""What of a plant differs from episode to episode, and what of it is seen: drawn parameters, disturbance, noise.

All of it comes from one key of the episode, whatever the controller does.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.dynamics import Physics, constants
from magenv.kernels import kernel, law
from magenv.params import Plant, System
from magenv.streams import Keys, normal, open_stream, uniform

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SLOW_PERIODS_S = (20.0, 60.0)
"""Range of the periods of what disturbs a robot."""
_PLANT, _DISTURBANCE, _NOISE = 0, 1, 2
"""Streams of an episode's key; the noise of each control instant is one of its own, from the last on."""


def is_uncertain(plant: Plant) -> bool:
    """Return whether anything of a plant is drawn."""
    return plant.mismatch > 0.0 or plant.is_noisy or plant.disturbance_n > 0.0


def nominal(system: System, plant: Plant) -> tuple[float, ...]:
    """Return mass, inertia, drags and moments (robots', EPMs') from which those of the episodes are drawn, SI units."""
    body = plant.body
    drags = (body.drag_linear_nspm, body.drag_rotational_nmsprad)
    return body.mass_kg, body.inertia_kgm2, *drags, system.ipm_moment_am2, system.epm_moment_am2


@law
def _draw_around(stream: Keys, mismatch: float, value: float, out: Floats) -> None:
    """Write numbers (k,) drawn within the mismatch of a value."""
    for j in range(len(out)):
        out[j] = value * uniform(stream, 1.0 - mismatch, 1.0 + mismatch)


@kernel
def draw_plants(
    first: int,
    last: int,
    mask: Bools,
    keys: Keys,
    used: NDArray[np.int64],
    mismatch: float,
    around: tuple[float, ...],
    substep: float,
    physics: Physics,
    current: Keys,
    slow: Floats,
    out: Floats,
) -> None:
    """Draw the plants of the episodes to come where ``mask`` says, each from the next of its row's keys (n, k).

    Writes the key into ``current`` (n,), parameters into ``physics``, constants of a substep into ``out`` (n, 10), and
    what disturbs the robots into ``slow`` (n, 2, 3), where that has rows.
    """
    stream = np.empty(1, np.uint64)
    for i in range(first, last):
        if not mask[i]:
            continue
        current[i] = keys[i, used[i]]
        if mismatch > 0.0:
            open_stream(stream, current[i], _PLANT)
            mass, inertia, linear, rotational, ipm, epm = around
            _draw_around(stream, mismatch, mass, physics.mass[i])
            for robot in range(2):  # fluid that is carried along makes both heavier
                physics.inertia[i, robot] = inertia * (physics.mass[i, robot] / mass)
            _draw_around(stream, mismatch, linear, physics.drag_linear[i])
            _draw_around(stream, mismatch, rotational, physics.drag_rotational[i])
            _draw_around(stream, mismatch, ipm, physics.ipm_moment[i])
            _draw_around(stream, mismatch, epm, physics.epm_moment[i])
            row = slice(i, i + 1)
            one = Physics(
                physics.mass[row],
                physics.inertia[row],
                physics.drag_linear[row],
                physics.drag_rotational[row],
                physics.ipm_moment[row],
                physics.epm_moment[row],
                physics.epm_size,
                physics.body_diameter,
                physics.wall_radius,
            )
            constants(one, substep, out[row])
        if len(slow) > 0:
            open_stream(stream, current[i], _DISTURBANCE)
            for robot in range(2):
                slow[i, robot, 0] = 2.0 * math.pi / uniform(stream, *SLOW_PERIODS_S)
                for axis in range(2):
                    slow[i, robot, 1 + axis] = uniform(stream, 0.0, 2.0 * math.pi)


@law
def add_noise(measured: Floats, i: int, key: int, instant: int, position: float, heading: float, stream: Keys) -> None:
    """Add the noise of a control instant to the measured poses (n, 2, 3) of row ``i``; ``stream`` (1,) is scratch."""
    open_stream(stream, key, _NOISE + instant)
    for robot in range(2):
        measured[i, robot, 0] += normal(stream, position)
        measured[i, robot, 1] += normal(stream, position)
        measured[i, robot, 2] += normal(stream, heading)
