"""EPMs that are cylinders in the plant: the wrench on the robots against magpylib and dipoles."""

from __future__ import annotations

import math
from dataclasses import replace

import magpylib
import numpy as np
import pytest
from lane import SYSTEM, magnets, one_lane, wrenches
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magenv.crosstalk import exact_wrench
from magenv.dynamics import Physics
from magenv.lanes import EPMS, fields
from magenv.params import PLANTS, Body, Magnet, System, TaskParams
from magenv.poses import EPM_SIZE, from_cartesian
from magenv.trajectories import shaped
from magenv.travel import Motion, carry, go_on, take_up
from magenv.world import World
from magenv.wrench import planar_moments

Floats = NDArray[np.float64]

CYLINDERS = PLANTS["cylinders"]


def scene(rng: np.random.Generator, system: System = SYSTEM) -> tuple[Floats, Floats]:
    """Robots (2, 6) at rest up to 60 mm from the centre and 15 mm or more apart; EPMs (N, 6)."""
    robots = np.zeros((2, 6))
    while np.linalg.norm(robots[1, :2] - robots[0, :2]) < 0.015:
        robots[:, :2] = rng.uniform(-0.04, 0.04, (2, 2))
    robots[:, 2] = rng.uniform(-math.pi, math.pi, 2)
    return robots, magnets(rng, system)


def cylinder(magnet: Magnet, moment: Floats, centre: Floats) -> magpylib.magnet.Cylinder:
    """magpylib's cylinder of the magnet's size and the moment (A m^2)."""
    size = float(np.linalg.norm(moment))
    turn, _ = Rotation.align_vectors(moment[None] / size, np.array([[0.0, 0.0, 1.0]]))
    return magpylib.magnet.Cylinder(
        magnetization=(0.0, 0.0, size / magnet.volume_m3),
        dimension=(magnet.diameter_m, magnet.length_m),
        position=centre,
        orientation=turn,
    )


def magpylibs(robots: Floats, epms: Floats, system: System, ipm: Magnet | None = None) -> tuple[Floats, Floats]:
    """Force and torque (2, 3) on the robots, which make the field of a dipole, or of a cylinder of size ``ipm``."""
    positions = np.concatenate([robots[:, :2], np.zeros((2, 1))], axis=-1)
    moments = planar_moments(robots[:, 2], system.ipm_moment_am2)
    sources = [cylinder(system.epm, system.epm_moment_am2 * epm[3:], epm[:3]) for epm in epms]
    dipoles = [magpylib.misc.Dipole(moment=m, position=p) for m, p in zip(moments, positions, strict=True)]
    out = []
    for me, other in ((0, 1), (1, 0)):
        mutual = dipoles[other] if ipm is None else cylinder(ipm, moments[other], positions[other])
        out.append(np.sum(magpylib.getFT([*sources, mutual], dipoles[me], squeeze=False), axis=1).reshape(2, 3))
    force, torque = np.swapaxes(out, 0, 1)
    return force, torque


def assert_near(found: Floats, expected: Floats, tolerance: float) -> None:
    """Compare planar wrenches (..., 2, 3), force and torque each in units of its own size."""
    for part in (slice(0, 2), slice(2, 3)):
        scale = np.abs(expected[..., part]).max()
        np.testing.assert_allclose(found[..., part] / scale, expected[..., part] / scale, atol=tolerance)


@pytest.mark.parametrize("n_epm", [2, 3])
def test_wrench_of_cylinders_is_magpylibs(rng: np.random.Generator, n_epm: int) -> None:
    system = System(n_epm=n_epm)
    for _ in range(20):
        robots, epms = scene(rng, system)
        force, torque = magpylibs(robots, epms, system)
        expected = np.concatenate([force[:, :2], torque[:, 2:]], axis=-1)
        assert_near(wrenches(robots, epms, Physics.of(system, CYLINDERS, 1)), expected, 1e-6)


def test_the_plant_moves_robots_by_magpylibs_wrench(rng: np.random.Generator) -> None:
    """Under drag that takes the speed away within a substep there remains wrench over drag: in lanes side by side."""
    body = Body(mass_kg=1e-6, inertia_kgm2=1e-10, drag_linear_nspm=10.0, drag_rotational_nmsprad=1e-3)
    task, n = TaskParams(control_hz=200.0, loss_distance_m=10.0), 20
    world = World(n, SYSTEM, replace(CYLINDERS, body=body), task, shaped("approach", 0.06))
    assert world.substeps == 1
    scenes = [scene(rng) for _ in range(n)]
    world.robots[:], targets = (np.array(part) for part in zip(*scenes, strict=True))
    world.begin(np.ones(n, np.bool_))
    world.step(targets, np.ones(n, np.bool_))
    for row, (robots, epms) in enumerate(scenes):
        force, torque = magpylibs(robots, epms, SYSTEM)
        expected = np.concatenate([force[:, :2], torque[:, 2:]], axis=-1)
        assert_near(world.robots[row, :, 3:] * [10.0, 10.0, 1e-3], expected, 1e-6)


@pytest.mark.parametrize("system", [SYSTEM, System(n_epm=3)])
def test_exact_wrench_is_magpylibs(rng: np.random.Generator, system: System) -> None:
    """U of all magnets as cylinders, in the magnet frames: x along the moment, z upward."""
    for _ in range(5):
        robots, epms = scene(rng, system)
        positions = np.concatenate([robots[:, :2], np.zeros((2, 1))], axis=-1)
        moments = planar_moments(robots[:, 2], system.ipm_moment_am2)
        u = exact_wrench(positions, moments, from_cartesian(epms[:, :3], epms[:, 3:]), system).reshape(2, 5)
        c, s = np.cos(robots[:, 2]), np.sin(robots[:, 2])
        (fx, fy, fz), (tx, ty, tz) = (part.T for part in magpylibs(robots, epms, system, system.ipm))
        expected = np.stack([c * ty - s * tx, tz, c * fx + s * fy, c * fy - s * fx, fz], axis=-1)
        for part in (slice(0, 2), slice(2, 5)):
            scale = np.abs(expected[:, part]).max()
            np.testing.assert_allclose(u[:, part] / scale, expected[:, part] / scale, atol=1e-6)


def test_small_cylinders_are_dipoles(rng: np.random.Generator) -> None:
    """Of the same moments, and of the shape without octupole."""
    for _ in range(20):
        robots, epms = scene(rng)
        dipoles = Physics.of(SYSTEM, PLANTS["paper"], 1)
        small = dipoles._replace(epm_size=(2e-4, 1e-4 * math.sqrt(3.0)))
        assert_near(wrenches(robots, epms, small), wrenches(robots, epms, dipoles), 1e-9)


def test_epms_on_their_way_are_the_same_cylinders(rng: np.random.Generator) -> None:
    robots, epms = scene(rng)
    physics, motion = Physics.of(SYSTEM, CYLINDERS, 1), Motion.of(SYSTEM, PLANTS["moving"], 0.005, 100)
    lane = np.zeros((fields(2, True), 1))
    take_up(lane, 0, physics.epm_moment[0], epms, np.zeros((2, 48)))
    assert not go_on(lane, 0, 2, motion)
    for k in range(2):
        carry(lane, 0, 2, k, physics.epm_size)
    placed = slice(EPMS, EPMS + 2 * EPM_SIZE)
    np.testing.assert_array_equal(lane[placed], one_lane(robots, epms, physics, 0.005)[placed])
