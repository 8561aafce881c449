"""The tables of calm holds: what they hold, how they are looked up, and that the search finds them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from magenv import calm_search
from magenv.calm_holds import CalmHolds, nearest, put_hold
from magenv.params import InputError, System
from magenv.poses import from_cartesian, keeps_gap
from magenv.stiffness import planar_stiffness
from magenv.wrench import robot_wrench

Floats = NDArray[np.float64]


def robots_of(placed: Floats) -> Floats:
    """State (12,) of robots at rest so placed (3,), about the origin, their frame along x."""
    state = np.zeros(12)
    for robot, side in enumerate((-0.5, 0.5)):
        state[3 * robot] = side * placed[0] * math.cos(placed[1])
        state[3 * robot + 1] = side * placed[0] * math.sin(placed[1])
        state[3 * robot + 2] = 2.0 * side * placed[2]
    return state


def vectors(state: Floats, moment: float) -> tuple[Floats, Floats]:
    """Positions and moments (2, 3) of the robots of a state."""
    robots = state[:6].reshape(2, 3)
    moments = moment * np.stack([np.cos(robots[:, 2]), np.sin(robots[:, 2]), np.zeros(2)], axis=-1)
    return np.concatenate([robots[:, :2], np.zeros((2, 1))], axis=1), moments


@pytest.mark.parametrize("n_epm", [2, 3])
def test_robots_at_rest_nearly_stay_so(n_epm: int) -> None:
    """By the wrench itself: what is left moves most robots by less than 0.2 mm in half a second, and none by 5 mm.

    Or turns them by a third of a degree, and none by nine. EPMs are within their limits.
    """
    system, table = System(n_epm=n_epm), CalmHolds.load(n_epm)
    assert len(table.placed) > 1000
    units = np.array([1.0e-4, 1.0e-4, 3.0e-3]) / 0.5 * np.array([0.15, 0.15, 6.8e-5])
    left = []
    for placed, epms in zip(table.placed, table.epms, strict=True):
        positions, moments = vectors(robots_of(placed), system.ipm_moment_am2)
        exerted = robot_wrench(positions, moments, from_cartesian(epms[:, :3], epms[:, 3:]), system.epm_moment_am2)
        left.append(np.linalg.norm(exerted.reshape(2, 5)[:, [2, 3, 1]] / units))
        radii = np.linalg.norm(epms[:, :3], axis=-1)
        assert radii.min() > system.r_min_m - 1e-6
        assert radii.max() < system.r_max_m + 1e-6
        assert keeps_gap(epms[None], 0, system.gap_min_m - 1e-6)
    assert np.median(left) < 2.0
    assert max(left) < 50.0


def test_side_by_side_robots_are_held_stably(rng: np.random.Generator) -> None:
    """At 26 mm and more no error of parallel robots side by side grows: docs/analysis.md says that such holds exist."""
    system, table = System(), CalmHolds.load(2)
    beside = (np.abs(table.placed[:, 1] - 0.5 * math.pi) < 1e-3) & (np.abs(table.placed[:, 2]) < 1e-3)
    far = beside & (table.placed[:, 0] > 0.0255) & (table.placed[:, 0] < 0.05)
    assert far.sum() >= 5
    for placed, epms in zip(table.placed[far], table.epms[far], strict=True):
        positions, moments = vectors(robots_of(placed), system.ipm_moment_am2)
        k = planar_stiffness(positions, moments, from_cartesian(epms[:, :3], epms[:, 3:]), system.epm_moment_am2)
        assert np.linalg.eigvalsh(0.5 * (k + k.T)).max() < 0.2 * 0.15  # 0.2 per second at most


def test_the_nearest_are_found(rng: np.random.Generator) -> None:
    table = CalmHolds.load(2)
    scale = np.array([0.15, 0.4, 0.25])
    for _ in range(20):
        placed = np.array([rng.uniform(0.02, 0.06), rng.uniform(-math.pi, math.pi), rng.uniform(-1.5, 1.5)])
        heading, shift = rng.uniform(-math.pi, math.pi), rng.normal(0.0, 0.01, 2)
        state = robots_of(placed)
        c, s = math.cos(heading), math.sin(heading)
        for robot in range(2):
            x, y = state[3 * robot : 3 * robot + 2]
            state[3 * robot : 3 * robot + 3] += [c * x - s * y - x + shift[0], s * x + c * y - y + shift[1], heading]
        which = np.empty(5, np.int64)
        nearest(table, state, heading, which)
        away = table.placed - placed
        away[:, 0] = np.log(table.placed[:, 0] / placed[0])
        away[:, 1] = (away[:, 1] + math.pi) % (2.0 * math.pi) - math.pi
        distances = ((away / scale) ** 2).sum(axis=1)
        np.testing.assert_allclose(distances[which], np.sort(distances)[:5], rtol=1e-6, atol=1e-9)


def test_a_hold_holds_wherever_the_robots_are(rng: np.random.Generator) -> None:
    """Turned and moved with the robots, the wrench turns with them."""
    table, system = CalmHolds.load(2), System()
    row, heading, shift = 700, 0.7, np.array([0.02, -0.01])
    state = robots_of(table.placed[row])
    c, s = math.cos(heading), math.sin(heading)
    there = state.copy()
    for robot in range(2):
        x, y = state[3 * robot : 3 * robot + 2]
        there[3 * robot : 3 * robot + 3] = [
            c * x - s * y + shift[0],
            s * x + c * y + shift[1],
            state[3 * robot + 2] + heading,
        ]
    epms = np.empty((2, 6))
    put_hold(table, row, there, heading, epms)
    stiffness = []
    for at, hold in ((state, table.epms[row]), (there, epms)):
        positions, moments = vectors(at, system.ipm_moment_am2)
        pose = from_cartesian(hold[:, :3], hold[:, 3:])
        stiffness.append(np.linalg.eigvals(planar_stiffness(positions, moments, pose, system.epm_moment_am2)))
    np.testing.assert_allclose(*(np.sort_complex(k) for k in stiffness), rtol=1e-4, atol=1e-8)


def test_robots_in_one_place_have_no_nearest() -> None:
    which = np.full(3, 99, np.int64)
    nearest(CalmHolds.load(2), np.zeros(12), 0.0, which)
    assert ((which >= 0) & (which < len(CalmHolds.load(2).placed))).all()
    nearest(CalmHolds.load(2), np.full(12, math.nan), 0.0, which)
    np.testing.assert_array_equal(which, 0)


def test_the_search_finds_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Few tries, two separations: the same file twice, and robots 60 mm apart are held in most ways."""
    monkeypatch.setattr(calm_search, "SEPARATIONS_M", np.array([0.046, 0.060]))
    contents = []
    for name in ("a.npz", "b.npz"):
        calm_search.run(calm_search.Options(tries=2, out=tmp_path / name))
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]
    with np.load(tmp_path / "a.npz", allow_pickle=False) as stored:
        assert len(stored["placed"]) > 0.5 * 2 * calm_search.LINES * calm_search.HALVES


@pytest.mark.parametrize(("name", "value"), [("n_epm", 4), ("tries", 0), ("seed", -1)])
def test_bad_input_is_told(name: str, value: int) -> None:
    with pytest.raises(InputError, match=f"Input {name} must be"):
        calm_search.Options(**{name: value})
