"""Pictures of scenes: to scale, the same for the same scene; the window they are shown in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from magenv.params import PLANTS, System
from magenv.render import RENDER_FPS, ROBOT_COLOURS, Renderer
from magenv.scene import Scene
from magenv.trajectories import shaped
from magenv.world import LOSSES

pytestmark = pytest.mark.usefixtures("no_display")

Picture = NDArray[np.uint8]

PLANT = PLANTS["paper"]
HEIGHT = 800
MOVE_M = 0.02


def a_scene(n_epm: int = 2, time_s: float = 50.0) -> Scene:
    trajectory = shaped("approach", 0.06)
    angle = 2 * np.pi * np.arange(n_epm) / n_epm
    return Scene(
        time_s=time_s,
        duration_s=trajectory.duration_s,
        robots=np.array([[0.0, -0.03, 0.0], [0.0, 0.03, 0.0]]),
        reference=trajectory.at(time_s),
        path=np.stack([trajectory.at(t)[:, :2] for t in np.linspace(0.0, trajectory.duration_s, 51)]),
        epm_positions=0.3 * np.stack([np.cos(angle), np.sin(angle), np.ones(n_epm)], axis=-1),
        epm_directions=np.tile([1.0, 0.0, 0.0], (n_epm, 1)),
    )


def bare_scene() -> Scene:
    """Return a scene in which nothing but its body and arrow has a robot's colour or hides them."""
    reference = np.array([[0.08, 0.0, 0.0], [-0.08, 0.0, 0.0]])
    return replace(a_scene(), path=np.zeros((2, 2, 2)), reference=reference)


def drawn(scene: Scene) -> Picture:
    picture = Renderer(System(n_epm=len(scene.epm_positions)), PLANT, window=False).draw(scene)
    assert picture is not None
    return picture


def moved(scene: Scene, robot: int, dx: float, dy: float) -> Scene:
    robots = scene.robots.copy()
    robots[robot, :2] += dx, dy
    return replace(scene, robots=robots)


def panels(picture: Picture) -> tuple[Picture, Picture, Picture]:
    """Return the strip at the right: the view from above, the view from the side, the table."""
    strip = picture[:, HEIGHT:]
    return (
        strip[: round(0.46 * HEIGHT)],
        strip[round(0.46 * HEIGHT) : round(0.9 * HEIGHT)],
        strip[round(0.9 * HEIGHT) :],
    )


def changed(before: Scene, after: Scene) -> list[str]:
    """Return in which panels the pictures of two scenes differ."""
    pairs = zip(("above", "side", "table"), panels(drawn(before)), panels(drawn(after)), strict=True)
    return [name for name, old, new in pairs if (old != new).any()]


def red(picture: Picture) -> NDArray[np.bool_]:
    return (picture[..., 0] > 150) & (picture[..., 1] < 90)


def new_pixels(before: Picture, after: Picture, robot: int) -> NDArray[np.int64]:
    """Return row and column of the pixels that took a robot's colour in the workspace, the square at the left."""
    was, is_now = ((picture[:, :HEIGHT] == ROBOT_COLOURS[robot]).all(axis=-1) for picture in (before, after))
    return np.argwhere(is_now & ~was)


def shift_px(robot: int, dx: float, dy: float) -> NDArray[np.float64]:
    """Return by how much (right, down) a robot's colour moves in the picture when the robot moves."""
    scene = bare_scene()
    before, after = drawn(scene), drawn(moved(scene, robot, dx, dy))
    there, here = new_pixels(before, after, robot), new_pixels(after, before, robot)
    assert len(there) > 300
    assert len(here) > 300
    down, right = there.mean(axis=0) - here.mean(axis=0)
    return np.array([right, down])


@pytest.mark.parametrize("n_epm", [2, 3])
def test_picture_is_an_rgb_array_with_a_square_at_its_left(n_epm: int) -> None:
    picture = drawn(a_scene(n_epm))
    assert picture.dtype == np.uint8
    assert picture.shape[::2] == (HEIGHT, 3)
    assert picture.shape[1] > HEIGHT
    for colour in ROBOT_COLOURS:
        assert (picture == colour).all(axis=-1).any()


@pytest.mark.parametrize("robot", [0, 1])
def test_a_robot_that_moves_moves_its_colour_alone(robot: int) -> None:
    right = shift_px(robot, MOVE_M, 0.0)
    outward = MOVE_M if robot else -MOVE_M
    up = shift_px(robot, 0.0, outward)
    assert right[0] > 30
    assert abs(right[1]) < 1
    assert abs(up[0]) < 1
    assert up[1] == pytest.approx(-np.sign(outward) * right[0], abs=1)  # y is up, rows count down, one scale for both
    before, after = drawn(bare_scene()), drawn(moved(bare_scene(), robot, MOVE_M, 0.0))
    assert len(new_pixels(before, after, 1 - robot)) == 0


def test_bodies_and_wall_are_to_scale() -> None:
    scene = bare_scene()
    scale = shift_px(0, MOVE_M, 0.0)[0] / MOVE_M
    # Robot 1 pointing along x, far from where it was: the rows of its colour are its disc's, an arrow being narrower.
    rows = new_pixels(drawn(scene), drawn(moved(scene, 0, -0.05, -0.02)), 0)[:, 0]
    assert np.ptp(rows) + 1 == pytest.approx(scale * PLANT.body.diameter_m, abs=2)
    picture = drawn(scene)
    middle = len(picture) // 2
    wall = picture[middle + 1, middle + round(scale * PLANT.workspace_radius_m) + 3].astype(int)
    outside = picture[middle + 1, middle + round(scale * PLANT.workspace_radius_m) + 12].astype(int)
    assert wall.max() < 150
    assert outside.min() > 200


def test_external_magnets_are_to_scale() -> None:
    scene = a_scene(3)
    scene.epm_positions[1:, 2] = -0.3  # pale from above, so that the first alone is red there
    system = System(n_epm=3)
    aside = replace(scene, epm_positions=scene.epm_positions + np.array([0.0, 0.1, 0.0]))
    rows = [np.flatnonzero(red(panels(drawn(each))[0]).any(axis=1)) for each in (scene, aside)]
    scale = (rows[0].mean() - rows[1].mean()) / 0.1
    diameter = (system.epm_moment_am2 / system.reference_epm.moment_am2) ** (1 / 3) * system.reference_epm.diameter_m
    assert np.ptp(rows[0]) + 1 == pytest.approx(scale * diameter - 1, abs=1.5)  # half its edge line lies within


@pytest.mark.parametrize("name", ["robots", "reference"])
def test_headings_show_in_the_workspace(name: str) -> None:
    scene = a_scene()
    poses = getattr(scene, name).copy()
    poses[0, 2] += 1.0
    before, after = (drawn(each)[100:-150, : HEIGHT - 100] for each in (scene, replace(scene, **{name: poses})))
    assert (before != after).any()


@pytest.mark.parametrize(("axis", "told"), [(0, "above side"), (1, "above"), (2, "side table")])
def test_an_epm_that_moves_shows_where_its_coordinate_is_told(axis: int, told: str) -> None:
    scene = a_scene()
    positions = scene.epm_positions.copy()
    positions[1, axis] += 0.05
    assert changed(scene, replace(scene, epm_positions=positions)) == told.split()


@pytest.mark.parametrize("moment", [[-1.0, 0.0, 0.0], [0.8, 0.6, 0.0], [0.8, 0.0, 0.6], [0.8, 0.0, -0.6]])
def test_a_moment_shows_in_both_views_and_its_elevation_in_the_table(moment: list[float]) -> None:
    scene = a_scene()
    directions = np.array([[1.0, 0.0, 0.0], moment])
    expected = ["above", "side", "table"] if moment[2] else ["above", "side"]
    assert changed(scene, replace(scene, epm_directions=directions)) == expected


def test_each_loss_is_told_in_words_of_its_own() -> None:
    scene = a_scene()
    pictures = {drawn(replace(scene, loss=code)).tobytes() for code in range(len(LOSSES))}
    assert len(pictures) == len(LOSSES)


def test_same_scenes_give_the_same_pictures_and_no_picture_is_overwritten() -> None:
    scene = a_scene()
    renderer = Renderer(System(), PLANT, window=False)
    first = renderer.draw(scene)
    assert first is not None
    kept = first.copy()
    renderer.draw(moved(replace(scene, time_s=50.5), 0, MOVE_M, 0.0))
    np.testing.assert_array_equal(first, kept)
    for _ in range(5):
        np.testing.assert_array_equal(drawn(scene), kept)


def test_trails_grow_restart_forgets_them_and_another_path_replaces_the_first() -> None:
    scene = a_scene()
    later = moved(replace(scene, time_s=50.5, path=0.5 * scene.path), 0, -MOVE_M, 0.0)
    renderer = Renderer(System(), PLANT, window=False)
    renderer.draw(scene)
    trailing = renderer.draw(later)
    assert trailing is not None
    assert (trailing != drawn(later)).any()
    renderer.restart()
    np.testing.assert_array_equal(renderer.draw(later), drawn(later))
    assert (drawn(later) != drawn(replace(later, path=scene.path))).any()


@pytest.mark.parametrize("name", ["robots", "reference", "path", "epm_positions", "epm_directions", "loss"])
def test_a_malformed_scene_is_refused(name: str) -> None:
    wrong = len(LOSSES) if name == "loss" else np.zeros(7)
    with pytest.raises(ValueError, match=f"Input {name} must be"):
        replace(a_scene(), **{name: wrong})  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_burst_state_is_drawn_without_its_robots(value: float) -> None:
    robots = a_scene().robots
    robots[1] = value
    picture = drawn(replace(bare_scene(), robots=robots, loss=1))
    assert len(new_pixels(picture, drawn(bare_scene()), 0)) > 300


def test_window_shows_at_the_frame_rate_and_closes_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    renderer = Renderer(System(), PLANT, window=True)
    flips: list[None] = []
    monkeypatch.setattr(pygame.display, "flip", lambda: flips.append(None))
    start = pygame.time.get_ticks()
    for step in range(3):
        assert renderer.draw(a_scene(time_s=50.0 + step)) is None
    assert pygame.time.get_ticks() - start >= 2 * 1000 / RENDER_FPS - 20
    assert len(flips) == 3
    shown = pygame.display.get_surface()
    assert shown is not None
    picture = pygame.surfarray.array3d(shown).transpose(1, 0, 2)
    for colour in ROBOT_COLOURS:
        assert (picture == colour).all(axis=-1).any()
    renderer.close()
    renderer.close()
    assert not pygame.display.get_init()
    other = Renderer(System(), PLANT, window=True)
    renderer.draw(a_scene())  # a closed renderer leaves the next one's window alone
    assert len(flips) == 3
    other.close()
