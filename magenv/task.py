"""What an agent is told and paid: observation layout, packing and unpacking, reward terms.

Observation, float32, all parts scaled to about one (N = number of EPMs; "frame" = robots' or global, see ``Layout``):

=========  ==================================================================  ==========
Index      Part                                                                 Unit
=========  ==================================================================  ==========
0-7        per robot: x, y, sin and cos of the error, reference at the end      30 mm
           of the coming hold minus measured pose, in the frame
8-15       per robot: x, y, sin and cos of the heading, in the frame            100 mm
16-21      per robot: v_x, v_y, rate, differences of measured poses             10 mm/s, rad/s
22         separation of the robots                                             100 mm
23-24      sin and cos of the frame's heading
25-48      preview: for 2 to 5 periods ahead and per robot x, y, heading of     10 mm, rad
           the reference minus the one at the end of the coming hold
49-        per EPM: unit position (3), radius (1), unit moment (3)              r_max
=========  ==================================================================  ==========
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.angles import sincos_all, wrap
from magenv.kernels import kernel, law
from magenv.params import System, require
from magenv.poses import frame_direction
from magenv.trajectories import reference_of, trajectory_of

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Frame = Literal["robots", "global"]
ObservationMode = Literal["full", "errors"]

PREVIEW = 5
"""Periods of reference that an observation tells."""
ERROR_SCALE_M = 0.03
LENGTH_SCALE_M = 0.1
SPEED_SCALE_MPS = 0.01
PREVIEW_SCALE_M = 0.01

_PER_ERROR, _PER_LENGTH, _PER_PREVIEW = 1.0 / ERROR_SCALE_M, 1.0 / LENGTH_SCALE_M, 1.0 / PREVIEW_SCALE_M
_BLOCK = 16  # rows told together
_ROBOTS, _RATES, _SEPARATION, _FRAME, _PREVIEW, _EPMS = 8, 16, 22, 23, 25, 49
_EPM_SIZE = 7
ERRORS_SIZE = 8
"""Length of the pose errors, with which an observation begins whatever its mode."""

POSITION_SCALES_M = (0.002, 0.006, 0.020)
HEADING_SCALES_RAD = (0.04, 0.15, 0.5)
REWARD_TERMS = ("position", "heading")


@dataclass(frozen=True)
class Parts:
    """An observation's parts in SI units and the global frame; leading axes (...) as observed."""

    error: Floats
    """(..., 2, 3) x, y (m), heading (rad): reference at the end of the coming hold minus measured pose."""
    robots: Floats
    """(..., 2, 3) measured x, y (m), heading (rad)."""
    rates: Floats
    """(..., 2, 3) differences of measured poses, m/s and rad/s."""
    separation: Floats
    """(...) m."""
    reference: Floats
    """(..., 5, 2, 3) reference 1 to 5 periods ahead, m and rad."""
    epm_positions: Floats
    """(..., N, 3) m."""
    epm_directions: Floats
    """(..., N, 3) unit moments."""


@dataclass(frozen=True)
class Layout:
    """Which observation: its mode, frame, system, workspace and control period decide size and bounds."""

    system: System
    workspace_radius_m: float
    period_s: float
    mode: ObservationMode = "full"
    frame: Frame = "robots"

    def __post_init__(self) -> None:
        for name, value, kinds in (("observation", self.mode, ObservationMode), ("frame", self.frame, Frame)):
            require(value in get_args(kinds), name, "one of " + ", ".join(get_args(kinds)), value)

    @property
    def size(self) -> int:
        """Length of an observation."""
        return ERRORS_SIZE if self.mode == "errors" else _EPMS + _EPM_SIZE * self.system.n_epm

    def bounds(self) -> NDArray[np.float32]:
        """Return the largest magnitude of each entry; noisy measurements beyond are clipped."""
        span = 2 * self.workspace_radius_m
        error = [span / ERROR_SCALE_M, span / ERROR_SCALE_M, 1.0, 1.0]
        pose = [1.5 * self.workspace_radius_m / LENGTH_SCALE_M] * 2 + [1.0, 1.0]
        rates = [span / self.period_s / SPEED_SCALE_MPS] * 2 + [math.pi / self.period_s]
        preview = [span / PREVIEW_SCALE_M] * 2 + [math.pi]
        full = 2 * error + 2 * pose + 2 * rates + [1.5 * span / LENGTH_SCALE_M, 1.0, 1.0]
        full += (PREVIEW - 1) * 2 * preview + self.system.n_epm * [1.0] * _EPM_SIZE
        # float32 rounding of a unit vector may exceed one
        return (1.001 * np.array(full[: self.size])).astype(np.float32)


@law
def _turn(x: float, y: float, c: float, s: float) -> tuple[float, float]:
    """Return the vector seen in a frame whose heading has cosine c and sine s."""
    return c * x + s * y, c * y - s * x


@law
def _preview(
    coefficients: Floats,
    which: int,
    duration: float,
    now: int,
    period: float,
    references: Floats,
    previews: Floats,
    at: int,
) -> None:
    """Write the references at the ends of the coming holds from row ``at`` on, and what the later ones add, scaled."""
    for k in range(PREVIEW):
        reference_of(coefficients, which, duration, (now + 1 + k) * period, references, at + k)
    for k in range(1, PREVIEW):
        for robot in range(2):
            for axis in range(3):
                ahead = references[at + k, robot, axis] - references[at, robot, axis]
                previews[at + k, robot, axis] = wrap(ahead) if axis == 2 else ahead * _PER_PREVIEW


@law
def _observe(
    i: int,
    measured: Floats,
    before: Floats,
    target: int,
    references: Floats,
    previews: Floats,
    epms: Floats,
    period: float,
    r_max: float,
    carried: bool,
    turns: Floats,
    full: Floats,
    row: int,
) -> None:
    """Write all parts of the observation of row ``i`` into a row of ``full``.

    Its references and previews (5, 2, 3) stand from ``target`` on; ``turns`` (3, 4 k) holds, four a row, both headings
    and both heading errors, their sines and their cosines.
    """
    sines, cosines, angle = turns[1], turns[2], 4 * row
    frame_c, frame_s = frame_direction(sines[angle], cosines[angle], sines[angle + 1], cosines[angle + 1])
    c, s = (frame_c, frame_s) if carried else (1.0, 0.0)
    per_period, per_speed = 1.0 / period, 1.0 / (period * SPEED_SCALE_MPS)
    for robot in range(2):
        error, pose, rate = 4 * robot, _ROBOTS + 4 * robot, _RATES + 3 * robot
        x, y, heading = measured[i, robot, 0], measured[i, robot, 1], measured[i, robot, 2]
        along, across = _turn(references[target, robot, 0] - x, references[target, robot, 1] - y, c, s)
        full[row, error], full[row, error + 1] = along * _PER_ERROR, across * _PER_ERROR
        full[row, error + 2], full[row, error + 3] = sines[angle + 2 + robot], cosines[angle + 2 + robot]
        along, across = _turn(x, y, c, s)
        full[row, pose], full[row, pose + 1] = along * _PER_LENGTH, across * _PER_LENGTH
        full[row, pose + 3], full[row, pose + 2] = _turn(cosines[angle + robot], sines[angle + robot], c, s)
        along, across = _turn(x - before[i, robot, 0], y - before[i, robot, 1], c, s)
        full[row, rate], full[row, rate + 1] = along * per_speed, across * per_speed
        full[row, rate + 2] = wrap(heading - before[i, robot, 2]) * per_period
        for k in range(1, PREVIEW):
            at, ahead = _PREVIEW + 6 * (k - 1) + 3 * robot, target + k
            full[row, at], full[row, at + 1] = _turn(previews[ahead, robot, 0], previews[ahead, robot, 1], c, s)
            full[row, at + 2] = previews[ahead, robot, 2]
    dx, dy = measured[i, 1, 0] - measured[i, 0, 0], measured[i, 1, 1] - measured[i, 0, 1]
    full[row, _SEPARATION] = math.sqrt(dx * dx + dy * dy) * _PER_LENGTH
    full[row, _FRAME], full[row, _FRAME + 1] = frame_s, frame_c
    for k in range(epms.shape[1]):
        at = _EPMS + _EPM_SIZE * k
        x, y, z = epms[i, k, 0], epms[i, k, 1], epms[i, k, 2]
        radius = math.sqrt(x * x + y * y + z * z)
        per_radius = 1.0 / radius
        full[row, at], full[row, at + 1] = _turn(x * per_radius, y * per_radius, c, s)
        full[row, at + 2], full[row, at + 3] = z * per_radius, radius * (1.0 / r_max)
        full[row, at + 4], full[row, at + 5] = _turn(epms[i, k, 3], epms[i, k, 4], c, s)
        full[row, at + 6] = epms[i, k, 5]


@kernel
def observe_rows(
    first: int,
    last: int,
    mask: Bools,
    measured: Floats,
    before: Floats,
    coefficients: Floats,
    duration: Floats,
    step: NDArray[np.int64],
    epms: Floats,
    period: float,
    r_max: float,
    carried: bool,
    bounds: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Write the observations (n, d) of rows ``first`` to ``last`` where ``mask`` says; see ``World`` for the rest."""
    block = min(_BLOCK, last - first)
    references, previews = np.empty((PREVIEW * block, 2, 3)), np.empty((PREVIEW * block, 2, 3))
    turns = np.empty((3, 4 * block))
    full = np.empty((block, _EPMS + _EPM_SIZE * epms.shape[1]))
    rows, targets = np.empty(block, np.int64), np.empty(block, np.int64)
    for start in range(first, last, _BLOCK):
        count, target, which, now = 0, -PREVIEW, -1, -1
        for i in range(start, min(start + _BLOCK, last)):
            if mask[i]:
                if which != trajectory_of(i, len(duration)) or now != step[i]:  # else as the row before
                    which, now = trajectory_of(i, len(duration)), step[i]
                    target += PREVIEW
                    _preview(coefficients, which, duration[which], now, period, references, previews, target)
                rows[count], targets[count] = i, target
                for robot in range(2):
                    turns[0, 4 * count + robot] = measured[i, robot, 2]
                    turns[0, 4 * count + 2 + robot] = references[target, robot, 2] - measured[i, robot, 2]
                count += 1
        sincos_all(turns[0], 4 * count, turns[1], turns[2])
        for k in range(count):
            _observe(
                rows[k],
                measured,
                before,
                targets[k],
                references,
                previews,
                epms,
                period,
                r_max,
                carried,
                turns,
                full,
                k,
            )
        for k in range(count):
            i = rows[k]
            for j in range(out.shape[1]):
                value = np.float32(full[k, j]) if abs(full[k, j]) < math.inf else np.float32(0.0)
                out[i, j] = min(max(value, -bounds[j]), bounds[j])


def unpack(observation: ArrayLike, layout: Layout) -> Parts:
    """Return the named parts of observations (..., d) in SI units and the global frame.

    Raises
    ------
    ValueError
        If the layout has the errors alone, or the last axis is not of its size.
    """
    require(layout.mode == "full", "observation", "full: errors alone do not tell the poses", layout.mode)
    o = np.asarray(observation, dtype=np.float64)
    require(o.ndim >= 1 and o.shape[-1] == layout.size, "observation", f"of shape (..., {layout.size})", o.shape)
    lead = o.shape[:-1]
    frame = np.arctan2(o[..., _FRAME], o[..., _FRAME + 1])
    turn = frame if layout.frame == "robots" else np.zeros_like(frame)
    c, s = np.cos(turn), np.sin(turn)

    def globally(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        cc, ss = (np.reshape(v, v.shape + (1,) * (x.ndim - v.ndim)) for v in (c, s))
        return cc * x - ss * y, ss * x + cc * y

    def planar(part: Floats, scale: float, heading: Floats) -> Floats:
        x, y = globally(part[..., 0] * scale, part[..., 1] * scale)
        return np.stack([x, y, heading], axis=-1)

    error = o[..., :_ROBOTS].reshape(*lead, 2, 4)
    pose = o[..., _ROBOTS:_RATES].reshape(*lead, 2, 4)
    rate = o[..., _RATES:_SEPARATION].reshape(*lead, 2, 3)
    preview = o[..., _PREVIEW:_EPMS].reshape(*lead, PREVIEW - 1, 2, 3)
    epm = o[..., _EPMS:].reshape(*lead, -1, _EPM_SIZE)
    robots = planar(pose, LENGTH_SCALE_M, np.arctan2(pose[..., 2], pose[..., 3]) + turn[..., None])
    errors = planar(error, ERROR_SCALE_M, np.arctan2(error[..., 2], error[..., 3]))
    target = (robots + errors)[..., None, :, :]
    later = target + planar(preview, PREVIEW_SCALE_M, preview[..., 2])
    with np.errstate(invalid="ignore"):  # zeros tell no direction, and become NaN
        directions = epm[..., :3] / np.linalg.norm(epm[..., :3], axis=-1, keepdims=True)
    x, y = globally(directions[..., 0], directions[..., 1])
    radius = epm[..., 3] * layout.system.r_max_m
    mx, my = globally(epm[..., 4], epm[..., 5])
    return Parts(
        error=errors,
        robots=robots,
        rates=planar(rate, SPEED_SCALE_MPS, rate[..., 2]),
        separation=o[..., _SEPARATION] * LENGTH_SCALE_M,
        reference=np.concatenate([target, later], axis=-3),
        epm_positions=radius[..., None] * np.stack([x, y, directions[..., 2]], axis=-1),
        epm_directions=np.stack([mx, my, epm[..., 6]], axis=-1),
    )


@law
def _closeness(error: float, near: float, middle: float, far: float) -> float:
    """Return one at zero error, falling through three scales to zero: near and far errors both have a slope."""
    a, b, c = error / near, error / middle, error / far
    close = (1.0 / (1.0 + a * a) + 1.0 / (1.0 + b * b) + 1.0 / (1.0 + c * c)) / 3.0
    return close if error < math.inf else 0.0  # NaN: the state was lost, nothing is paid


@law
def reward_terms(position_error: float, heading_error: float) -> tuple[float, float]:
    """Return the reward terms, each in [0, 1], of the mean errors over a hold in m and rad."""
    return _closeness(position_error, *POSITION_SCALES_M), _closeness(heading_error, *HEADING_SCALES_RAD)
