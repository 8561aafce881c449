"""Reference trajectories of both robots: the named scenarios and the seeded random family for training.

A trajectory is a cubic spline through position and heading of both robots, in equal segments of time.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magenv.arithmetic import fma
from magenv.kernels import kernel, law
from magenv.params import require
from magenv.random_knots import RANDOM_SEPARATION_M, RANDOM_TURN_MAX_RADPS, try_knots
from magenv.shape_knots import SHAPES, shape_knots
from magenv.streams import Keys

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SEGMENTS = 32
"""Spline segments of every trajectory."""
_KNOTS = SEGMENTS + 1
_AXES = 6  # x, y, heading of both robots
DURATION_S = 100.0

LEAST_MM, MOST_MM, FAMILY_MOST_MM = 12, 100, 80
"""Range of the separations of shapes, and greatest of a random family's least ones, which begin at the same."""
SCENARIO_HELP = (
    f"random, {', '.join(f'{shape}-<s>' for shape in SHAPES)} or approach-<s>-anti with s from {LEAST_MM} to {MOST_MM} "
    f"(mm), or random-<s> with s from {LEAST_MM} to {FAMILY_MOST_MM}"
)
_FAMILY = re.compile(r"random-(\d+(?:\.\d+)?)", re.ASCII)
_NAMED = re.compile(rf"({'|'.join(SHAPES)})-(\d+(?:\.\d+)?)(-anti)?", re.ASCII)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Spline of both robots' reference: ``coefficients`` (32 segments, 2 robots, x / y / heading, 4 powers)."""

    duration_s: float
    coefficients: Floats

    @classmethod
    def through(cls, duration_s: float, knots: Floats) -> Trajectory:
        """Return the twice continuously differentiable spline through ``knots`` (33, 2, 3), equally spaced in time."""
        fits = np.shape(knots) == (_KNOTS, 2, 3) and bool(np.isfinite(knots).all())
        require(fits, "knots", f"a finite array of shape {(_KNOTS, 2, 3)}", np.shape(knots))
        require(0.0 < duration_s < math.inf, "duration_s", "a positive, finite number", duration_s)
        coefficients = np.empty((SEGMENTS, 2, 3, 4))
        spline_through(np.ascontiguousarray(knots), np.empty((SEGMENTS + 1, 2, 3)), coefficients)
        return cls(duration_s, coefficients)

    def at(self, time_s: float) -> Floats:
        """Return x, y (m) and heading (rad, not wrapped) of both robots (2, 3), held still outside the duration."""
        out = np.empty((2, 3))
        reference_kernel(self.coefficients, self.duration_s, float(time_s), out)
        return out


def extent(trajectory: Trajectory) -> tuple[float, float]:
    """Return how far the references go from the workspace's centre, and how near they come to each other, m."""
    times = np.linspace(0.0, trajectory.duration_s, 8 * SEGMENTS + 1)
    places = np.stack([trajectory.at(time)[:, :2] for time in times.tolist()])
    reach, gap = np.hypot(places[..., 0], places[..., 1]), np.hypot(*(places[:, 1] - places[:, 0]).T)
    return float(reach.max()), float(gap.min())


@law
def cubic(c0: float, c1: float, c2: float, c3: float, u: float) -> float:
    """Return the value at ``u`` segments after a segment's beginning."""
    return fma(u, fma(u, fma(u, c3, c2), c1), c0)


@law
def spline_position(time: float, rate: float) -> float:
    """Return where on the spline, in segments, it is at ``time``; ``rate`` is in segments per second."""
    return min(max(time * rate, 0.0), 1.0 * SEGMENTS)


@law
def trajectory_of(row: int, trajectories: int) -> int:
    """Return which of a table of trajectories an episode follows: its own, or the only one."""
    return min(row, trajectories - 1)


@law
def _place_on_spline(time: float, duration: float) -> tuple[int, float]:
    """Return the segment at ``time`` (s) and how far in it it is, in segments."""
    position = spline_position(time, SEGMENTS / duration)
    segment = min(int(position), SEGMENTS - 1)
    return segment, position - segment


@law
def reference_of(coefficients: Floats, which: int, duration: float, time: float, out: Floats, row: int) -> None:
    """Write the reference at ``time`` (s) of one of many trajectories into a row of ``out`` (k, 2, 3)."""
    segment, u = _place_on_spline(time, duration)
    for robot in range(2):
        for axis in range(3):
            c0, c1 = coefficients[which, segment, robot, axis, 0], coefficients[which, segment, robot, axis, 1]
            c2, c3 = coefficients[which, segment, robot, axis, 2], coefficients[which, segment, robot, axis, 3]
            out[row, robot, axis] = cubic(c0, c1, c2, c3, u)


@kernel
def reference_kernel(coefficients: Floats, duration: float, time: float, out: Floats) -> None:
    """Write the reference (2, 3) at ``time`` (s) into ``out``."""
    segment, u = _place_on_spline(time, duration)
    for robot in range(2):
        for axis in range(3):
            c = coefficients[segment, robot, axis]
            out[robot, axis] = cubic(c[0], c[1], c[2], c[3], u)


def _inverse_pivots() -> Floats:
    """Return the reciprocal pivots (32,) of the Gaussian elimination in ``spline_through``, from the second on."""
    inverse = np.full(SEGMENTS, 0.5)
    for k in range(2, SEGMENTS):
        inverse[k] = 1.0 / ((2.0 if k == SEGMENTS - 1 else 4.0) - inverse[k - 1])
    return inverse


_INVERSE_PIVOTS = _inverse_pivots()


@kernel
def spline_through(knots: Floats, slopes: Floats, coefficients: Floats) -> None:
    """Write the coefficients (32, 2, 3, 4) of the cubic spline through ``knots`` (33, 2, 3), ends not-a-knot.

    The slopes at the knots (scratch, like ``knots``) make the second derivative continuous,
    s[k-1] + 4 s[k] + s[k+1] = 3 (y[k+1] - y[k-1]), and the third at the first and last inner knot,
    s[0] + 2 s[1] = (-5 y[0] + 4 y[1] + y[2]) / 2 and its mirror image: a tridiagonal system without the end slopes.
    """
    end, y, s, inverse = SEGMENTS, knots.reshape(-1, _AXES), slopes.reshape(-1, _AXES), _INVERSE_PIVOTS
    for j in range(_AXES):
        s[0, j] = 0.5 * (-5.0 * y[0, j] + 4.0 * y[1, j] + y[2, j])
        s[end, j] = 0.5 * (5.0 * y[end, j] - 4.0 * y[end - 1, j] - y[end - 2, j])
        s[1, j] = 3.0 * (y[2, j] - y[0, j]) - s[0, j]
    for k in range(2, end):
        for j in range(_AXES):
            s[k, j] = 3.0 * (y[k + 1, j] - y[k - 1, j]) - s[k - 1, j] * inverse[k - 1]
    for j in range(_AXES):
        s[end - 1, j] = (s[end - 1, j] - s[end, j]) * inverse[end - 1]
    for k in range(end - 2, 0, -1):
        for j in range(_AXES):
            s[k, j] = (s[k, j] - s[k + 1, j]) * inverse[k]
    for j in range(_AXES):
        s[0, j] -= 2.0 * s[1, j]
        s[end, j] -= 2.0 * s[end - 1, j]
    for k in range(end):
        for j in range(_AXES):
            c, rise, s0, s1 = coefficients[k, j // 3, j % 3], y[k + 1, j] - y[k, j], s[k, j], s[k + 1, j]
            c[0], c[1], c[2], c[3] = y[k, j], s0, 3.0 * rise - 2.0 * s0 - s1, s0 + s1 - 2.0 * rise


def shaped(shape: str, separation_m: float, anti: bool = False) -> Trajectory:
    """Return a named shape on which the robots come to ``separation_m`` of each other: see ``shape_knots``.

    Raises
    ------
    ValueError
        If there is no such shape, or the separation is not from 12 to 100 mm.
    """
    require(shape in SHAPES, "shape", f"one of {', '.join(SHAPES)}", shape)
    low, high = 1e-3 * LEAST_MM, 1e-3 * MOST_MM
    require(low <= separation_m <= high, "separation_m", f"from {low:.3f} to {high:.3f}", separation_m)
    return Trajectory.through(DURATION_S, shape_knots(shape, separation_m, anti, SEGMENTS))


def family_separation(scenario: str) -> float | None:
    """Return the least separation (m) of the random family that a scenario names; None where it names none.

    ``random`` goes down to 20 mm, ``random-<s>`` to s mm.
    """
    if scenario == "random":
        return RANDOM_SEPARATION_M[0]
    match = _FAMILY.fullmatch(scenario) if isinstance(scenario, str) else None
    if match is None or not LEAST_MM <= float(match[1]) <= FAMILY_MOST_MM:
        return None
    return float(match[1]) / 1000


def named_trajectory(scenario: str) -> Trajectory | None:
    """Return the trajectory of a named scenario; None for a random family, of which every episode has its own.

    Raises
    ------
    ValueError
        If the name is unknown.
    """
    if family_separation(scenario) is not None:
        return None
    match = _NAMED.fullmatch(scenario) if isinstance(scenario, str) else None
    in_range = match is not None and LEAST_MM <= float(match[2]) <= MOST_MM
    known = match is not None and in_range and (match[1] == SHAPES[0] or match[3] is None)
    require(known, "scenario", SCENARIO_HELP, scenario)
    assert match is not None
    return shaped(match[1], float(match[2]) / 1000, anti=match[3] is not None)


@kernel
def draw_rows(
    first: int,
    last: int,
    mask: Bools,
    keys: Keys,
    used: NDArray[np.int64],
    duration_s: float,
    turn_max: float,
    nearest: float,
    coefficients: Floats,
    duration: Floats,
) -> None:
    """Draw trajectories (n, 32, 2, 3, 4) and (n,) where ``mask`` says, of rows first to last.

    Each from the first of its row's keys (n, k) after the ``used`` ones (n,). ``nearest`` (m) is the least of their
    separations.
    """
    knots, slopes, stream = np.empty((_KNOTS, 2, 3)), np.empty((_KNOTS, 2, 3)), np.empty(1, np.uint64)
    lanes = np.empty((_AXES + 2, _KNOTS))
    for i in range(first, last):
        if mask[i]:
            stream[0] = keys[i, used[i]]
            while not try_knots(stream, duration_s, turn_max, nearest, lanes, knots):
                pass
            spline_through(knots, slopes, coefficients[i])
            duration[i] = duration_s


def random_limits() -> tuple[float, float]:
    """Return duration (s) and greatest turn rate (rad/s) of the random family."""
    return DURATION_S, RANDOM_TURN_MAX_RADPS


def draw_keys(rng: np.random.Generator, n: int) -> Keys:
    """Return the next ``n`` keys of an episode's generator; each stands for a trajectory."""
    return rng.integers(0, 2**64, n, dtype=np.uint64)


def draw(scenario: str, rng: np.random.Generator) -> Trajectory:
    """Return the trajectory that an episode of a scenario follows, drawing from ``rng`` for a random family alone.

    Raises
    ------
    ValueError
        If the name is unknown.
    """
    named = named_trajectory(scenario)
    if named is not None:
        return named
    coefficients, duration = np.empty((1, SEGMENTS, 2, 3, 4)), np.empty(1)
    keys, used = draw_keys(rng, 1)[None], np.zeros(1, np.int64)
    nearest = family_separation(scenario)
    assert nearest is not None
    draw_rows(0, 1, np.ones(1, np.bool_), keys, used, *random_limits(), nearest, coefficients, duration)
    return Trajectory(float(duration[0]), coefficients[0])
