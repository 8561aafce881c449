"""Knots of the named trajectories: shapes that are held out of the random family."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SHAPES = ("approach", "crossing", "meeting", "eight", "still")
_HALF_LENGTH_M = 0.060
"""Approaches run from -60 mm to 60 mm in x."""
_HALF_WIDTH_M = 0.050
"""Distance of each robot from the x axis at both ends of an approach."""
_CROSSING_M = 0.045
"""Half the way of each robot in ``crossing``."""
_EIGHT_M = 0.050, 0.014
"""Half length and half width of ``eight``."""


def _parabola(u: Floats, separation_m: float, side: float, way: float = 1.0) -> tuple[Floats, Floats]:
    """Return places and velocities (k, 2) along x at constant speed, y a parabola down to half the separation."""
    depth = _HALF_WIDTH_M - separation_m / 2
    places = np.stack([way * _HALF_LENGTH_M * u, side * (separation_m / 2 + depth * u**2)], axis=-1)
    return places, np.stack([np.full_like(u, way * _HALF_LENGTH_M), side * 2 * depth * u], axis=-1)


def _eight(u: Floats, centre_y: float) -> tuple[Floats, Floats]:
    """Return places and velocities (k, 2) once round a figure of eight that crosses itself at (0, ``centre_y``)."""
    angle = math.pi * u
    places = np.stack([_EIGHT_M[0] * np.sin(angle), centre_y + _EIGHT_M[1] * np.sin(2 * angle)], axis=-1)
    rates = np.stack([_EIGHT_M[0] * np.cos(angle), 2 * _EIGHT_M[1] * np.cos(2 * angle)], axis=-1)
    return places, math.pi * rates


def shape_knots(shape: str, separation_m: float, anti: bool, segments: int) -> Floats:
    """Return knots (segments + 1, 2, 3) of robots that come to ``separation_m``, headings along their paths.

    ``approach``  side by side along x at constant speed, y a parabola from 50 mm to half the separation, one mirrored
    ``meeting``   the same paths, but robot 2 comes the other way
    ``still``     robot 1 as in ``approach``; robot 2 stands where it is passed by, heading along x
    ``crossing``  straight along x and along y, one after the other through the same point
    ``eight``     each round a figure of eight, side by side, the separation between them all the time

    In ``anti`` robot 2 heads against its way.
    """
    u = np.linspace(-1.0, 1.0, segments + 1)
    rest, going = np.zeros_like(u), np.ones_like(u)
    one, two = _parabola(u, separation_m, -1.0), _parabola(u, separation_m, 1.0)
    if shape == "meeting":
        two = _parabola(u, separation_m, 1.0, way=-1.0)
    elif shape == "still":
        two = np.stack([rest, rest + separation_m / 2], axis=-1), np.stack([going, rest], axis=-1)
    elif shape == "crossing":
        early, way = separation_m / math.sqrt(2.0), _CROSSING_M * u
        one = np.stack([way + early, rest], axis=-1), np.stack([going, rest], axis=-1)
        two = np.stack([rest, way - early], axis=-1), np.stack([rest, going], axis=-1)
    elif shape == "eight":
        one, two = _eight(u, -separation_m / 2), _eight(u, separation_m / 2)
    positions, velocities = (np.stack([a, b], axis=1) for a, b in zip(one, two, strict=True))
    headings = np.unwrap(np.arctan2(velocities[..., 1], velocities[..., 0]), axis=0)
    if anti:
        headings[:, 1] += math.pi
    return np.concatenate([positions, headings[..., None]], axis=-1)
