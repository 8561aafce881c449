"""Reference trajectories: the approach scenarios by their formula, the random family by its promises."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from magenv.params import Plant
from magenv.random_knots import RANDOM_SEPARATION_M
from magenv.trajectories import DURATION_S, Trajectory, draw, shaped

Floats = NDArray[np.float64]

TIMES = np.linspace(0.0, DURATION_S, 1001)
SEPARATIONS_MM = [14, 16, 18, 19, 20, 21, 22.5, 25, 27.5, 30, 35, 40, 45, 50, 60, 100]


def sampled(trajectory: Trajectory) -> Floats:
    """Reference (1001, 2, 3)."""
    return np.stack([trajectory.at(t) for t in TIMES])


def parabolas(separation_m: float) -> Floats:
    """The approach by its definition in the design: x, y and heading along the path (1001, 2, 3)."""
    u = 2 * TIMES / DURATION_S - 1
    x, depth = -0.060 + 0.120 * TIMES / DURATION_S, 0.050 - separation_m / 2
    y = -(separation_m / 2 + depth * u**2)
    heading = np.arctan2(-2 * depth * u, 0.060)
    return np.stack([np.stack([x, y, heading], axis=-1), np.stack([x, -y, -heading], axis=-1)], axis=1)


@pytest.mark.parametrize("separation_mm", SEPARATIONS_MM)
def test_approach_is_the_designs(separation_mm: float) -> None:
    path = sampled(draw(f"approach-{separation_mm:g}", np.random.default_rng(0)))
    expected = parabolas(separation_mm / 1000)
    np.testing.assert_allclose(path[..., :2], expected[..., :2], atol=1e-12)
    np.testing.assert_allclose(path[..., 2], expected[..., 2], atol=math.radians(0.01))
    distance = np.linalg.norm(path[:, 1, :2] - path[:, 0, :2], axis=-1)
    assert distance.min() == pytest.approx(separation_mm / 1000, abs=1e-9)
    assert TIMES[distance.argmin()] == DURATION_S / 2 or separation_mm == 100


@pytest.mark.parametrize("separation_mm", [20, 30, 60])
def test_anti_turns_the_second_robot_alone(separation_mm: int) -> None:
    rng = np.random.default_rng(0)
    path, anti = sampled(draw(f"approach-{separation_mm}", rng)), sampled(draw(f"approach-{separation_mm}-anti", rng))
    np.testing.assert_allclose(anti - path, np.broadcast_to([[0, 0, 0], [0, 0, math.pi]], path.shape), atol=1e-12)


def test_robots_meet_parallel() -> None:
    middle = shaped("approach", 0.030).at(DURATION_S / 2)
    np.testing.assert_allclose(middle, [[0, -0.015, 0], [0, 0.015, 0]], atol=1e-12)


SHAPES_AT = [
    f"{shape}-{separation}" for shape in ("crossing", "meeting", "eight", "still") for separation in (16, 30, 60)
]


@pytest.mark.parametrize("scenario", SHAPES_AT)
def test_shapes_come_to_their_separation_and_clear_the_wall(scenario: str) -> None:
    path = sampled(draw(scenario, np.random.default_rng(0)))
    distance = np.linalg.norm(path[:, 1, :2] - path[:, 0, :2], axis=-1)
    assert distance.min() == pytest.approx(float(scenario.split("-")[1]) / 1000, abs=2e-5)
    assert np.linalg.norm(path[..., :2], axis=-1).max() < 0.094
    assert np.abs(np.diff(path[..., 2], axis=0)).max() / (TIMES[1] - TIMES[0]) < 0.15  # rad/s


@pytest.mark.parametrize("scenario", SHAPES_AT)
def test_shapes_head_along_their_paths(scenario: str) -> None:
    path = sampled(draw(scenario, np.random.default_rng(0)))
    step, middle = np.diff(path[..., :2], axis=0), 0.5 * (path[1:, :, 2] + path[:-1, :, 2])
    moves = np.linalg.norm(step, axis=-1) > 0
    assert moves.all(axis=0).tolist() == [True, not scenario.startswith("still")]
    off = np.abs(np.angle(np.exp(1j * (np.arctan2(step[..., 1], step[..., 0]) - middle))))
    assert off[moves].max() < math.radians(0.5)


def test_shapes_are_what_they_are_called() -> None:
    def at(scenario: str, time: float) -> Floats:
        return draw(scenario, np.random.default_rng(0)).at(time)

    np.testing.assert_allclose(at("meeting-30", 50.0), [[0, -0.015, 0], [0, 0.015, -math.pi]], atol=1e-12)
    np.testing.assert_allclose(at("meeting-30", 0.0)[:, :2], [[-0.060, -0.050], [0.060, 0.050]], atol=1e-12)
    for time in (0.0, 50.0, 100.0):
        np.testing.assert_allclose(at("still-30", time)[1], [0, 0.015, 0], atol=1e-12)
    np.testing.assert_allclose(at("still-30", 0.0)[0], shaped("approach", 0.030).at(0.0)[0], atol=1e-12)
    crossing = sampled(draw("crossing-30", np.random.default_rng(0)))
    np.testing.assert_allclose(crossing[:, 0, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(crossing[:, 1, 0], 0.0, atol=1e-12)
    assert (crossing[0, 0, 0], crossing[0, 1, 1]) < (0, 0) < (crossing[-1, 0, 0], crossing[-1, 1, 1])
    eight = sampled(draw("eight-30", np.random.default_rng(0)))
    np.testing.assert_allclose(eight[0], eight[-1], atol=1e-12)
    sides = np.sign(eight[[125, 375, 625, 875], 0, 1] + 0.015)
    np.testing.assert_array_equal(sides, [1, -1, 1, -1])
    np.testing.assert_allclose(eight[500, 0, :2], [0, -0.015], atol=1e-12)
    np.testing.assert_allclose(eight[:, 1] - eight[:, 0], np.broadcast_to([0, 0.030, 0], (1001, 3)), atol=1e-12)


def test_reference_is_held_outside_its_time() -> None:
    trajectory = shaped("approach", 0.030)
    np.testing.assert_array_equal(trajectory.at(-5.0), trajectory.at(0.0))
    np.testing.assert_array_equal(trajectory.at(DURATION_S + 7.0), trajectory.at(DURATION_S))
    np.testing.assert_allclose(trajectory.at(DURATION_S)[0, :2], [0.060, -0.050], atol=1e-12)


def test_named_scenarios_draw_nothing() -> None:
    rng = np.random.default_rng(3)
    before = rng.bit_generator.state
    draw("approach-30-anti", rng)
    assert rng.bit_generator.state == before


@pytest.fixture(scope="module")
def family() -> Floats:
    """Two hundred random trajectories (200, 1001, 2, 3)."""
    return np.stack([sampled(draw("random", np.random.default_rng(seed))) for seed in range(200)])


def test_random_family_is_seeded(family: Floats) -> None:
    for seed in (0, 1, 199):
        np.testing.assert_array_equal(sampled(draw("random", np.random.default_rng(seed))), family[seed])
    flat = family.reshape(len(family), -1)
    apart = np.abs(flat[:, None, ::50] - flat[None, :, ::50]).max(axis=-1)
    assert apart[np.triu_indices(len(family), 1)].min() > 1e-3


def test_random_family_keeps_its_separations_and_clears_the_wall(family: Floats) -> None:
    distance = np.linalg.norm(family[:, :, 1, :2] - family[:, :, 0, :2], axis=-1)
    low, high = RANDOM_SEPARATION_M
    assert distance.min() >= low - 1e-4
    assert distance.max() <= high + 1e-4
    assert distance.min() < low + 5e-3  # the narrow end is seen in training
    assert distance.min(axis=1).max() > 0.06
    wall = Plant().workspace_radius_m - 0.5 * Plant().body.diameter_m
    assert np.linalg.norm(family[..., :2], axis=-1).max() < wall - 5e-3


def test_random_family_heads_along_its_paths_smoothly(family: Floats) -> None:
    step = np.diff(family[..., :2], axis=1)
    along = np.arctan2(step[..., 1], step[..., 0])
    middle = 0.5 * (family[:, 1:, :, 2] + family[:, :-1, :, 2])
    assert np.abs(np.angle(np.exp(1j * (along - middle)))).max() < math.radians(3.0)
    assert np.abs(np.diff(family[..., 2], axis=1)).max() / (TIMES[1] - TIMES[0]) < 0.12  # rad/s
    speed = np.linalg.norm(step, axis=-1) / (TIMES[1] - TIMES[0])
    assert speed.min() > 1e-4
    assert speed.max() < 5e-3


def test_random_family_covers_directions_and_sides(family: Floats) -> None:
    ways = family[:, -1, :, :2].mean(axis=1) - family[:, 0, :, :2].mean(axis=1)
    quadrants = np.floor(np.arctan2(ways[:, 1], ways[:, 0]) / (math.pi / 2))
    assert np.unique(quadrants, return_counts=True)[1].min() > 25
    line = family[:, 500, 1, :2] - family[:, 500, 0, :2]
    left = ways[:, 0] * line[:, 1] - ways[:, 1] * line[:, 0] > 0
    assert 0.3 < left.mean() < 0.7


def nearest_approach(paths: Floats) -> float:
    """Greatest distance in m of ``paths`` (1001, 2, 2) from the nearest approach, turned, robots named either way."""
    points = (paths[::50, :, 0] + 1j * paths[::50, :, 1]).T.ravel()
    best = math.inf
    for separation in np.linspace(0.012, 0.100, 23):
        shape = parabolas(separation)[::50]
        for first in (0, 1):
            other = (shape[:, [first, 1 - first], 0] + 1j * shape[:, [first, 1 - first], 1]).T.ravel()
            turn = np.vdot(other, points)
            best = min(best, float(np.abs(points - turn / abs(turn) * other).max()))
    return best


def test_approach_is_found_by_the_measure_of_the_next_test() -> None:
    path = sampled(shaped("approach", 0.032))
    turn = np.array([[math.cos(1.0), -math.sin(1.0)], [math.sin(1.0), math.cos(1.0)]])
    assert nearest_approach(path[..., :2] @ turn.T) < 1e-9


def test_random_family_holds_the_approach_shapes_out(family: Floats) -> None:
    """No draw is an approach, turned or with the robots swapped: all differ by millimetres somewhere."""
    assert min(nearest_approach(path[..., :2]) for path in family) > 3e-3
