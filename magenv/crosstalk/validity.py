"""Where the dipole model breaks down: the same poses with magnets that are cylinders, by magpylib (an extra)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.allocation import component_scales
from magenv.allocation_input import draw_starts
from magenv.crosstalk.activation import Activations, Pair
from magenv.margins import clearances, gap_margins, minimise_within
from magenv.params import Magnet, System, require
from magenv.poses import POSE_SIZE, project, to_cartesian
from magenv.wrench import WRENCH_SIZE, robot_frames, robot_wrench, wrench_jacobian

if TYPE_CHECKING:
    import magpylib

Floats = NDArray[np.float64]

_OFFSET_M = 2e-4
"""Of central differences: their error is 1e-5 of a gradient that changes over 5 cm."""

_OPTIONS: Any = {"maxiter": 300, "ftol": 1e-12}
_SLACK = 1e-6
"""Share by which a found distance may be below its limit and still count."""
_LEAST_RADIUS_M = 0.01
"""Of a centre, where it is the robots that it must keep from: the pose vector is undefined at the workspace centre."""


def _magpylib() -> Any:
    try:
        import magpylib
    except ImportError as error:
        raise ImportError('Finite cylinders need magpylib: python -m pip install -e ".[exact]"') from error
    return magpylib


def _cylinder(magnet: Magnet, centre: Floats, moment: Floats) -> magpylib.magnet.Cylinder:
    """Return a cylinder of the magnet's size along the moment's direction, of the moment's size."""
    from scipy.spatial.transform import Rotation

    size = float(np.linalg.norm(moment))
    turn, _ = Rotation.align_vectors(moment[None] / size, np.array([[0.0, 0.0, 1.0]]))
    cylinder: magpylib.magnet.Cylinder = _magpylib().magnet.Cylinder(
        magnetization=(0.0, 0.0, size / magnet.volume_m3),
        dimension=(magnet.diameter_m, magnet.length_m),
        position=centre,
        orientation=turn,
    )
    return cylinder


def epm_magnet(system: System) -> Magnet:
    """Return the magnet that each EPM is: of the reference's shape and of its share of the volume."""
    share = (system.epm_moment_am2 / system.reference_epm.moment_am2) ** (1.0 / 3.0)
    one = system.reference_epm
    return replace(one, diameter_m=share * one.diameter_m, length_m=share * one.length_m)


def exact_wrench(positions: ArrayLike, moments: ArrayLike, pose: ArrayLike, system: System) -> Floats:
    """Wrench U (10) as ``magenv.wrench.robot_wrench`` gives it, but the sources are cylinders and not dipoles.

    EPMs and robots' magnets alike make the field of a uniformly magnetised cylinder; what it does to a robot is what it
    does to the dipole at its centre, which is 5 mm across.

    Parameters
    ----------
    positions, moments : array_like, shape (2, 3)
        Robots' positions in m and moments in A m^2.
    pose : array_like, shape (5 N,)
        EPM poses.
    system : System
        Magnets.

    Raises
    ------
    ImportError
        If magpylib is not installed.
    ValueError
        If a shape does not fit or a number is not finite.
    """
    p, m, x = (np.asarray(value, dtype=np.float64) for value in (positions, moments, pose))
    for name, value, shape in (("positions", p, (2, 3)), ("moments", m, (2, 3)), ("pose", x, (5 * system.n_epm,))):
        fits = value.shape == shape and bool(np.isfinite(value).all())
        require(fits, name, f"a finite array of shape {shape}", value.shape)
    centres, directions = to_cartesian(x)
    epm = epm_magnet(system)
    epms = [_cylinder(epm, c, system.epm_moment_am2 * u) for c, u in zip(centres, directions, strict=True)]
    steps = np.concatenate([np.zeros((1, 3)), _OFFSET_M * np.eye(3), -_OFFSET_M * np.eye(3)])
    frames, mutual = np.empty((2, 3, 3)), np.empty(WRENCH_SIZE)
    robot_frames(p, m, frames, mutual)
    u = np.empty(WRENCH_SIZE)
    for robot in range(2):
        sources = [*epms, _cylinder(system.ipm, p[1 - robot], m[1 - robot])]
        field = np.asarray(_magpylib().getB(sources, p[robot] + steps, sumup=True))
        gradient = (field[1:4] - field[4:7]) / (2.0 * _OFFSET_M)  # [j, i] = dB_i / dp_j
        torque, force = frames[robot] @ np.cross(m[robot], field[0]), frames[robot] @ (gradient @ m[robot])
        u[5 * robot : 5 * robot + 5] = [torque[1], torque[2], *force]
    return u


def _solve_clear(pair: Pair, system: System, target: Floats, begun: Sequence[Floats]) -> Floats:
    """Return the poses that come nearest to a target (10) with r_min kept from each robot, from several beginnings."""
    positions, moments, scale = pair.positions, pair.moments(system), component_scales()
    weights = 1.0 / scale / np.linalg.norm(target / scale)
    low, high = np.full(len(begun[0]), -np.inf), np.full(len(begun[0]), np.inf)
    low[2::POSE_SIZE], high[2::POSE_SIZE] = _LEAST_RADIUS_M, system.r_max_m

    def error(x: Floats) -> Floats:
        return weights * (robot_wrench(positions, moments, x, system.epm_moment_am2) - target)

    def cost(x: Floats) -> float:
        return 0.5 * float(error(x) @ error(x))

    def cost_slopes(x: Floats) -> Floats:
        by_pose: Floats = weights[:, None] * wrench_jacobian(positions, moments, x, system.epm_moment_am2)
        return np.asarray(by_pose.T @ error(x))

    def margins(x: Floats) -> Floats:
        return np.concatenate([clearances(x, positions, system.r_min_m)[0], gap_margins(x, system.gap_min_m)[0]])

    def margin_slopes(x: Floats) -> Floats:
        return np.concatenate([clearances(x, positions, system.r_min_m)[1], gap_margins(x, system.gap_min_m)[1]])

    least, best = math.inf, np.full(len(begun[0]), np.nan)
    for start in begun:
        found, reached = minimise_within(cost, cost_slopes, margins, margin_slopes, low, high, start, _OPTIONS)
        if reached < least and (margins(found) >= -_SLACK).all():
            least, best = reached, found
    return best


def clear_of_robots(pair: Pair, system: System, found: Activations, *, starts: int = 10, seed: int = 0) -> Activations:
    """Solve the same targets with r_min kept from each robot instead of from the workspace centre.

    By SciPy's sequential quadratic programming, from the poses that were found and from random ones; slow.

    Parameters
    ----------
    pair, system
        The robots, magnets and limits.
    found : Activations
        Targets and poses with r_min from the centre.
    starts, seed : int
        Random starts and their seed.
    """
    random = [project(start, system)[0] for start in draw_starts(system, starts, seed, False)]
    poses = np.array(
        [
            _solve_clear(pair, system, target, [pose, *random])
            for target, pose in zip(found.target, found.pose, strict=True)
        ]
    )
    wrench = robot_wrench(pair.positions, pair.moments(system), poses, system.epm_moment_am2)
    return replace(found, pose=poses, wrench=wrench)
