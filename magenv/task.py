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
from magenv.trajectories import reference_kernel, trajectory_of

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

_BLOCK = 64  # rows whose angles are vectorised together
_ROBOTS, _RATES, _SEPARATION, _FRAME, _PREVIEW, _EPMS = 8, 16, 22, 23, 25, 49
_EPM_SIZE = 7
_ERRORS_SIZE = 8

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
        return _ERRORS_SIZE if self.mode == "errors" else _EPMS + _EPM_SIZE * self.system.n_epm

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
def _observe(
    measured: Floats,
    before: Floats,
    references: Floats,
    epms: Floats,
    period: float,
    r_max: float,
    carried: bool,
    sines: Floats,
    cosines: Floats,
    full: Floats,
) -> None:
    """Write all parts of one observation into ``full``.

    ``references`` (5, 2, 3); sines and cosines (4,) of both headings and of both heading errors.
    """
    frame_c, frame_s = frame_direction(sines[0], cosines[0], sines[1], cosines[1])
    c, s = (frame_c, frame_s) if carried else (1.0, 0.0)
    for robot in range(2):
        error, pose, rate = 4 * robot, _ROBOTS + 4 * robot, _RATES + 3 * robot
        x, y, heading = measured[robot, 0], measured[robot, 1], measured[robot, 2]
        target_x, target_y, target_heading = references[0, robot, 0], references[0, robot, 1], references[0, robot, 2]
        along, across = _turn(target_x - x, target_y - y, c, s)
        full[error], full[error + 1] = along / ERROR_SCALE_M, across / ERROR_SCALE_M
        full[error + 2], full[error + 3] = sines[2 + robot], cosines[2 + robot]
        along, across = _turn(x, y, c, s)
        full[pose], full[pose + 1] = along / LENGTH_SCALE_M, across / LENGTH_SCALE_M
        full[pose + 3], full[pose + 2] = _turn(cosines[robot], sines[robot], c, s)
        along, across = _turn(x - before[robot, 0], y - before[robot, 1], c, s)
        full[rate], full[rate + 1] = along / (period * SPEED_SCALE_MPS), across / (period * SPEED_SCALE_MPS)
        full[rate + 2] = wrap(heading - before[robot, 2]) / period
        for k in range(1, PREVIEW):
            at = _PREVIEW + 6 * (k - 1) + 3 * robot
            along, across = _turn(references[k, robot, 0] - target_x, references[k, robot, 1] - target_y, c, s)
            full[at], full[at + 1] = along / PREVIEW_SCALE_M, across / PREVIEW_SCALE_M
            full[at + 2] = wrap(references[k, robot, 2] - target_heading)
    full[_SEPARATION] = math.hypot(measured[1, 0] - measured[0, 0], measured[1, 1] - measured[0, 1]) / LENGTH_SCALE_M
    full[_FRAME], full[_FRAME + 1] = frame_s, frame_c
    for k in range(len(epms)):
        at = _EPMS + _EPM_SIZE * k
        x, y, z = epms[k, 0], epms[k, 1], epms[k, 2]
        radius = math.sqrt(x * x + y * y + z * z)
        full[at], full[at + 1] = _turn(x / radius, y / radius, c, s)
        full[at + 2], full[at + 3] = z / radius, radius / r_max
        full[at + 4], full[at + 5] = _turn(epms[k, 3], epms[k, 4], c, s)
        full[at + 6] = epms[k, 5]


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
    references = np.empty((block, PREVIEW, 2, 3))
    angles, sines, cosines = np.empty(4 * block), np.empty(4 * block), np.empty(4 * block)
    full = np.empty(_EPMS + _EPM_SIZE * epms.shape[1])
    for start in range(first, last, _BLOCK):
        end, count = min(start + _BLOCK, last), 0
        for i in range(start, end):
            if mask[i]:
                which, reference = trajectory_of(i, len(duration)), references[count]
                for k in range(PREVIEW):
                    reference_kernel(coefficients[which], duration[which], (step[i] + 1 + k) * period, reference[k])
                for robot in range(2):
                    angles[4 * count + robot] = measured[i, robot, 2]
                    angles[4 * count + 2 + robot] = reference[0, robot, 2] - measured[i, robot, 2]
                count += 1
        sincos_all(angles, 4 * count, sines, cosines)
        count = 0
        for i in range(start, end):
            if not mask[i]:
                continue
            at = slice(4 * count, 4 * count + 4)
            reference, s, c = references[count], sines[at], cosines[at]
            count += 1
            _observe(measured[i], before[i], reference, epms[i], period, r_max, carried, s, c, full)
            for j in range(out.shape[1]):
                value = np.float32(full[j]) if abs(full[j]) < math.inf else np.float32(0.0)
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
