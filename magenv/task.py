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

from magenv.kernels import kernel
from magenv.params import System, require
from magenv.poses import robots_frame
from magenv.trajectories import reference_kernel
from magenv.world import wrap

Floats = NDArray[np.float64]
Frame = Literal["robots", "global"]
ObservationMode = Literal["full", "errors"]

PREVIEW = 5
"""Periods of reference that an observation tells."""
ERROR_SCALE_M = 0.03
LENGTH_SCALE_M = 0.1
SPEED_SCALE_MPS = 0.01
PREVIEW_SCALE_M = 0.01

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


@kernel
def _turn(x: float, y: float, c: float, s: float) -> tuple[float, float]:
    """Return the vector seen in a frame whose heading has cosine c and sine s."""
    return c * x + s * y, c * y - s * x


@kernel
def _observe(
    measured: Floats,
    before: Floats,
    references: Floats,
    epms: Floats,
    period: float,
    r_max: float,
    carried: bool,
    bounds: NDArray[np.float32],
    full: Floats,
    out: NDArray[np.float32],
) -> None:
    """Write one observation; ``references`` (5, 2, 3), ``full`` is scratch for all parts."""
    frame = robots_frame(measured[0, 2], measured[1, 2])
    turn = frame if carried else 0.0
    c, s = math.cos(turn), math.sin(turn)
    for robot in range(2):
        now, error, pose, rate = (
            measured[robot],
            full[4 * robot :],
            full[_ROBOTS + 4 * robot :],
            full[_RATES + 3 * robot :],
        )
        target = references[0, robot]
        x, y = _turn(target[0] - now[0], target[1] - now[1], c, s)
        error[0], error[1] = x / ERROR_SCALE_M, y / ERROR_SCALE_M
        error[2], error[3] = math.sin(target[2] - now[2]), math.cos(target[2] - now[2])
        x, y = _turn(now[0], now[1], c, s)
        pose[0], pose[1] = x / LENGTH_SCALE_M, y / LENGTH_SCALE_M
        pose[2], pose[3] = math.sin(now[2] - turn), math.cos(now[2] - turn)
        x, y = _turn(now[0] - before[robot, 0], now[1] - before[robot, 1], c, s)
        rate[0], rate[1] = x / period / SPEED_SCALE_MPS, y / period / SPEED_SCALE_MPS
        rate[2] = wrap(now[2] - before[robot, 2]) / period
        for k in range(1, PREVIEW):
            ahead, preview = references[k, robot], full[_PREVIEW + 6 * (k - 1) + 3 * robot :]
            x, y = _turn(ahead[0] - target[0], ahead[1] - target[1], c, s)
            preview[0], preview[1] = x / PREVIEW_SCALE_M, y / PREVIEW_SCALE_M
            preview[2] = wrap(ahead[2] - target[2])
    full[_SEPARATION] = math.hypot(measured[1, 0] - measured[0, 0], measured[1, 1] - measured[0, 1]) / LENGTH_SCALE_M
    full[_FRAME], full[_FRAME + 1] = math.sin(frame), math.cos(frame)
    for k in range(len(epms)):
        epm, part = epms[k], full[_EPMS + _EPM_SIZE * k :]
        radius = math.sqrt(epm[0] * epm[0] + epm[1] * epm[1] + epm[2] * epm[2])
        part[0], part[1] = _turn(epm[0] / radius, epm[1] / radius, c, s)
        part[2], part[3] = epm[2] / radius, radius / r_max
        part[4], part[5] = _turn(epm[3], epm[4], c, s)
        part[6] = epm[5]
    for i in range(len(out)):
        value = np.float32(full[i]) if math.isfinite(full[i]) else np.float32(0.0)
        out[i] = min(max(value, -bounds[i]), bounds[i])


@kernel
def observe_rows(
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
    """Write the observations (n, d) of all episodes; the arguments are those of ``_observe`` and of ``World``."""
    references = np.empty((PREVIEW, 2, 3))
    full = np.empty(_EPMS + _EPM_SIZE * epms.shape[1])
    for i in range(len(out)):
        for k in range(PREVIEW):
            reference_kernel(coefficients[i], duration[i], (step[i] + 1 + k) * period, references[k])
        _observe(measured[i], before[i], references, epms[i], period, r_max, carried, bounds, full, out[i])


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


@kernel
def _closeness(error: float, scales: tuple[float, float, float]) -> float:
    """Return one at zero error, falling through three scales to zero: near and far errors both have a slope."""
    if not error < math.inf:  # NaN: the state was lost, nothing is paid
        return 0.0
    total = 0.0
    for scale in scales:
        total += 1.0 / (1.0 + (error / scale) ** 2)
    return total / 3.0


@kernel
def reward_rows(position_error: Floats, heading_error: Floats, position: Floats, heading: Floats) -> None:
    """Write the reward terms (n,), each in [0, 1], of mean errors (n,) over the hold in m and rad."""
    for i in range(len(position)):
        position[i] = _closeness(position_error[i], POSITION_SCALES_M)
        heading[i] = _closeness(heading_error[i], HEADING_SCALES_RAD)
