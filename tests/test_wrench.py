"""The wrench on the robots: laws of mechanics, frames, superposition, Jacobian."""

from __future__ import annotations

from collections.abc import Callable

import magpylib
import numpy as np
import pytest
from numpy.typing import NDArray

from magenv.dipole import field, gradient
from magenv.params import System
from magenv.poses import from_cartesian, pose_bounds, to_cartesian
from magenv.wrench import (
    dipole_wrench,
    magnet_frame,
    planar_moments,
    robot_frames,
    robot_wrench,
    wrench_curvature,
    wrench_gradients,
    wrench_jacobian,
)

Floats = NDArray[np.float64]

IPM = System().ipm_moment_am2
EPM = System().epm_moment_am2
TORQUE, FORCE = slice(0, 3), slice(3, 6)


def pair(source: Floats, target: Floats, offset: Floats) -> Floats:
    """Torque and force (6,) of one dipole on another."""
    return np.array(dipole_wrench(*source, *target, *offset))


def scene(rng: np.random.Generator, n_epm: int) -> tuple[Floats, Floats, Floats]:
    """Positions and moments of the robots, in space, and a pose vector."""
    low, high = pose_bounds(System(n_epm=n_epm))
    moments = rng.normal(size=(2, 3))
    moments *= IPM / np.linalg.norm(moments, axis=-1, keepdims=True)
    positions = np.array([[0.04, 0.01, 0.0], [-0.03, -0.02, 0.01]]) + rng.normal(0.0, 0.01, (2, 3))
    return positions, moments, rng.uniform(low, high)


def frame_of(moment: Floats) -> Floats:
    """Magnet frame by its definition: x along the moment, y = z_global cross x, z = x cross y; axes as rows."""
    x = moment / np.linalg.norm(moment)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)])


def test_coaxial_aligned_epm_attracts() -> None:
    """The sign trap: a robot beside an EPM, both moments along the line between them, is pulled towards it."""
    positions = np.array([[0.0, 0.0, 0.0], [0.0, 5.0, 0.0]])  # the other robot far away
    moments = np.array([[IPM, 0.0, 0.0], [0.0, IPM, 0.0]])
    pose = from_cartesian([[0.2, 0.0, 0.0]], [[1.0, 0.0, 0.0]])
    u = robot_wrench(positions, moments, pose, EPM)
    expected = 3 * 4e-7 * np.pi * EPM * IPM / (2 * np.pi * 0.2**4)
    assert u[2] > 0
    np.testing.assert_allclose(u[2], expected, rtol=1e-6)
    np.testing.assert_allclose(u[[0, 1, 3, 4]], 0.0, atol=1e-9)
    against = from_cartesian([[0.2, 0.0, 0.0]], [[-1.0, 0.0, 0.0]])
    assert robot_wrench(positions, moments, against, EPM)[2] < 0


def test_torque_turns_the_moment_towards_the_field() -> None:
    positions = np.array([[0.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    moments = planar_moments(np.array([0.3, 0.0]), IPM)
    pose = from_cartesian([[0.2, 0.0, 0.0]], [[1.0, 0.0, 0.0]])  # field along +x, the robot 0.3 rad to its left
    u = robot_wrench(positions, moments, pose, EPM)
    b = np.linalg.norm(field([EPM, 0, 0], [0.2, 0, 0], [0, 0, 0]))
    np.testing.assert_allclose(u[1], -IPM * b * np.sin(0.3), rtol=1e-6)


def test_dipole_wrench_is_by_definition(rng: np.random.Generator) -> None:
    for _ in range(20):
        s, m, r = rng.normal(size=(3, 3))
        w = pair(s, m, r)
        np.testing.assert_allclose(w[TORQUE], np.cross(m, field(s, np.zeros(3), r)), rtol=1e-9, atol=1e-18)
        np.testing.assert_allclose(w[FORCE], gradient(s, np.zeros(3), r).T @ m, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize("n_epm", [1, 2, 3, 4])
def test_wrench_is_magpylibs_in_the_magnet_frame(rng: np.random.Generator, n_epm: int) -> None:
    """All EPMs and the other robot on each robot, global frame by magpylib, turned by the frame's definition."""
    for _ in range(5):
        positions, moments, pose = scene(rng, n_epm)
        centres, directions = to_cartesian(pose)
        robots = [magpylib.misc.Dipole(moment=m, position=p) for p, m in zip(positions, moments, strict=True)]
        epms = [magpylib.misc.Dipole(moment=EPM * d, position=c) for c, d in zip(centres, directions, strict=True)]
        expected = []
        for me, other in ((0, 1), (1, 0)):
            force, torque = magpylib.getFT([*epms, robots[other]], robots[me], squeeze=False)
            frame = frame_of(moments[me])
            tau, f = frame @ torque.sum(axis=0).reshape(3), frame @ force.sum(axis=0).reshape(3)
            assert abs(tau[0]) < 1e-9 * np.linalg.norm(tau)  # no torque about the moment
            expected += [*tau[1:], *f]
        u = robot_wrench(positions, moments, pose, EPM)
        scale = np.tile([np.linalg.norm(u[[0, 1, 5, 6]])] * 2 + [np.linalg.norm(u[[2, 3, 4, 7, 8, 9]])] * 3, 2)
        np.testing.assert_allclose(u / scale, np.array(expected) / scale, atol=1e-6)


@pytest.mark.parametrize("moment", [[1, 0, 0], [0, -2, 0], [-1, 1, 0], [1, 2, 3], [0.1, 0, -5]])
def test_magnet_frame(moment: list[float]) -> None:
    m, frame = np.array(moment, dtype=float), np.empty((3, 3))
    magnet_frame(m, frame)
    np.testing.assert_allclose(frame, frame_of(m), atol=1e-15)
    if m[2] == 0:
        np.testing.assert_array_equal(frame[2], [0, 0, 1])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_magnet_frame_of_a_vertical_moment_is_a_frame(sign: float) -> None:
    frame = np.empty((3, 3))
    magnet_frame(np.array([0.0, 0.0, 2 * sign]), frame)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0)
    np.testing.assert_allclose(frame[0], [0, 0, sign])


def test_newtons_third_law(rng: np.random.Generator) -> None:
    """Opposite forces, and no net torque on the pair when that of the forces is counted."""
    for _ in range(50):
        a, b, r = rng.normal(size=(3, 3))
        on_b, on_a = pair(a, b, r), pair(b, a, -r)
        size = np.linalg.norm(on_b[FORCE])
        np.testing.assert_allclose(on_b[FORCE], -on_a[FORCE], atol=1e-14 * size)
        total = on_a[TORQUE] + on_b[TORQUE] + np.cross(r, on_b[FORCE])
        np.testing.assert_allclose(total, 0.0, atol=1e-13 * (size * np.linalg.norm(r) + np.linalg.norm(on_a)))


def test_robots_push_each_other_alike(rng: np.random.Generator) -> None:
    """Third law in U: the forces, turned back from the magnet frames, cancel where EPMs are too weak to act."""
    for _ in range(10):
        positions, moments, pose = scene(rng, 2)
        u = robot_wrench(positions, moments, pose, 1e-12)
        forces = [frame_of(m).T @ u[5 * i + 2 : 5 * i + 5] for i, m in enumerate(moments)]
        np.testing.assert_allclose(forces[0], -forces[1], atol=1e-9 * np.linalg.norm(forces[0]))


def test_dipole_wrench_turns_with_the_scene(rng: np.random.Generator, rotations: Floats) -> None:
    for q in rotations:
        s, m, r = rng.normal(size=(3, 3))
        w, turned = pair(s, m, r), pair(q @ s, q @ m, q @ r)
        np.testing.assert_allclose(turned[TORQUE], q @ w[TORQUE], atol=1e-13 * np.linalg.norm(w))
        np.testing.assert_allclose(turned[FORCE], q @ w[FORCE], atol=1e-13 * np.linalg.norm(w))


@pytest.mark.parametrize("n_epm", [1, 2, 3])
def test_wrench_does_not_change_when_the_scene_turns(
    rng: np.random.Generator, n_epm: int, turn_about_z: Callable[[float], Floats]
) -> None:
    """U is told in frames that the magnets carry."""
    for angle in (0.7, -2.0, np.pi):
        q = turn_about_z(angle)
        positions, moments, pose = scene(rng, n_epm)
        centres, directions = to_cartesian(pose)
        u = robot_wrench(positions, moments, pose, EPM)
        turned = robot_wrench(positions @ q.T, moments @ q.T, from_cartesian(centres @ q.T, directions @ q.T), EPM)
        np.testing.assert_allclose(turned, u, atol=1e-12 * np.abs(u).max())


def test_epms_superpose(rng: np.random.Generator) -> None:
    positions, moments, pose = scene(rng, 3)
    mutual = robot_wrench(positions, moments, pose, 1e-300)
    singles = [robot_wrench(positions, moments, pose[5 * k : 5 * k + 5], EPM) - mutual for k in range(3)]
    together = robot_wrench(positions, moments, pose, EPM)
    np.testing.assert_allclose(together, mutual + sum(singles), atol=1e-13 * np.abs(together).max())
    np.testing.assert_allclose(
        robot_wrench(positions, moments, pose, 2 * EPM) - mutual, 2 * (together - mutual), rtol=1e-9
    )


@pytest.mark.parametrize("n_epm", [1, 2, 3, 4])
def test_jacobian_is_the_derivative(rng: np.random.Generator, n_epm: int) -> None:
    for _ in range(5):
        positions, moments, pose = scene(rng, n_epm)
        exact = wrench_jacobian(positions, moments, pose, EPM)
        assert exact.shape == (10, 5 * n_epm)
        for i in range(5 * n_epm):
            h = 1e-5 * np.eye(5 * n_epm)[i]
            numeric = (
                robot_wrench(positions, moments, pose + h, EPM) - robot_wrench(positions, moments, pose - h, EPM)
            ) / 2e-5
            np.testing.assert_allclose(exact[:, i], numeric, atol=2e-7 * np.abs(exact).max())


def test_batch_gives_the_bits_of_the_single_call(rng: np.random.Generator) -> None:
    positions, moments, poses = (np.stack(v) for v in zip(*(scene(rng, 2) for _ in range(6)), strict=True))
    u = robot_wrench(positions, moments, poses, EPM)
    j = wrench_jacobian(positions, moments, poses, EPM)
    assert u.shape == (6, 10)
    for i in range(6):
        np.testing.assert_array_equal(u[i], robot_wrench(positions[i], moments[i], poses[i], EPM))
        np.testing.assert_array_equal(j[i], wrench_jacobian(positions[i], moments[i], poses[i], EPM))
    np.testing.assert_array_equal(robot_wrench(positions[0], moments[0], poses[:, None], EPM)[0, 0], u[0])
    assert robot_wrench(positions[:, None], moments[0], poses, EPM).shape == (6, 6, 10)


def test_planar_moments() -> None:
    m = planar_moments([[0.0, np.pi / 2], [np.pi, -0.3]], 2.0)
    expected = 2 * np.array([[[1, 0, 0], [0, 1, 0]], [[-1, 0, 0], [np.cos(0.3), -np.sin(0.3), 0]]])
    np.testing.assert_allclose(m, expected, atol=1e-15)


def test_curvature_is_the_derivative_of_the_gradients(rng: np.random.Generator) -> None:
    positions, moments, pose = scene(rng, 2)
    centres, directions = to_cartesian(pose)
    epms, weights = np.concatenate([centres, directions], axis=-1), rng.normal(size=10)
    frames, mutual, work, curvature = np.empty((2, 3, 3)), np.empty(10), np.empty((2, 3)), np.empty((2, 2, 6))
    robot_frames(positions, moments, frames, mutual)
    wrench_curvature(positions, moments, frames, epms, EPM, weights, work, curvature)

    def slope(moved: Floats) -> Floats:
        gradients = np.empty((10, 12))
        wrench_gradients(positions, moments, frames, moved, EPM, work, gradients)
        return weights @ gradients

    h = 1e-6
    exact, numeric = np.zeros((12, 12)), np.empty((12, 12))
    for k in range(2):
        twice, mixed = (
            curvature[k, i][[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]  # (xx, xy, xz, yy, yz, zz) as a matrix
            for i in range(2)
        )
        at = slice(6 * k, 6 * k + 3), slice(6 * k + 3, 6 * k + 6)
        exact[at[0], at[0]], exact[at[0], at[1]], exact[at[1], at[0]] = twice, mixed, mixed
        for i in range(6):
            step = np.zeros((2, 6))
            step[k, i] = h
            numeric[6 * k + i] = (slope(epms + step) - slope(epms - step)) / (2 * h)
    np.testing.assert_allclose(exact, numeric, atol=1e-7 * np.abs(exact).max())
