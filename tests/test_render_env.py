"""Environments that are drawn: the scene is the world's; whoever does not draw needs no display and no pygame."""

from __future__ import annotations

import os
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import magenv
from magenv.episodes import Episodes, Settings
from magenv.scene import scene_of
from magenv.vector_env import TwoRobotsVector

pytestmark = pytest.mark.usefixtures("no_display")

FAR = np.array([0.0, 0.0, 1.0, 0.0, 0.0] * 2, np.float32)
"""Action that sends the EPMs far away, so that the robots take a while to get lost."""


def test_errors_are_those_of_the_world_also_at_a_loss() -> None:
    episodes = Episodes(1, Settings("approach-30"))
    episodes.seed(0, np.random.default_rng(0))
    episodes.start(np.ones(1, np.bool_))
    world, active = episodes.world, np.ones(1, np.bool_)
    kept = 0
    scene = scene_of(world, 0)
    while not scene.loss:
        episodes.step(FAR[None], active)
        terminated = episodes.outcome()[1]
        scene = scene_of(world, 0)
        assert scene.position_error_m == pytest.approx(world.measurements.position_error_end_m[0], rel=1e-9)
        assert scene.heading_error_rad == pytest.approx(world.measurements.heading_error_end_rad[0], rel=1e-9)
        kept += not terminated[0]
        assert bool(terminated[0]) == (scene.loss > 0)
    assert kept > 0
    apart = world.robots[0, 1, :2] - world.robots[0, 0, :2]
    assert scene.separation_m == pytest.approx(float(np.hypot(*apart)))
    episodes.seed(0, np.random.default_rng(0))
    episodes.start(np.ones(1, np.bool_))
    assert scene_of(world, 0).loss == 0


def test_a_scene_does_not_follow_the_world() -> None:
    episodes = Episodes(2, Settings("approach-60"))
    for row in range(2):
        episodes.seed(row, np.random.default_rng(row))
    episodes.start(np.ones(2, np.bool_))
    scene = scene_of(episodes.world, 1)
    names = ("robots", "reference", "path", "epm_positions", "epm_directions")
    before = {name: getattr(scene, name).copy() for name in names}
    np.testing.assert_array_equal(scene.robots, episodes.world.robots[1, :, :3])
    episodes.world.robots += 1.0
    episodes.world.epms += 1.0
    episodes.world.coefficients += 1.0
    for name in names:
        np.testing.assert_array_equal(getattr(scene, name), before[name])


def test_rgb_array_of_the_environment_needs_no_display() -> None:
    import pygame

    env = gymnasium.make(magenv.ENV_ID, scenario="approach-60", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert isinstance(first, np.ndarray)
    env.step(FAR)
    assert not np.array_equal(np.asarray(env.render()), first)
    assert not pygame.display.get_init()
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), first)  # the trail is a new one
    env.close()


@pytest.mark.parametrize("by_user", [True, False])
def test_a_window_that_is_gone_stops_nobody(monkeypatch: pytest.MonkeyPatch, by_user: bool) -> None:
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gymnasium.make(magenv.ENV_ID, scenario="approach-60", render_mode="human")
    env.reset(seed=0)
    if by_user:
        pygame.event.post(pygame.event.Event(pygame.QUIT))
    else:
        pygame.display.quit()
    for _ in range(2):
        env.step(FAR)
    assert not pygame.display.get_init()
    env.reset(seed=1)
    env.close()
    env.close()


def test_importing_the_environment_imports_no_plotting_library() -> None:
    code = (
        "import sys, magenv.env, magenv.vector_env\n"
        "print(sorted({'pygame', 'matplotlib', 'torch'} & set(sys.modules)))\n"
        "from magenv.params import PLANTS, System\n"
        "magenv.render.Renderer(System(), PLANTS['paper'], window=False)\n"
        "print(sorted({'pygame', 'matplotlib', 'torch'} & set(sys.modules)))\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=dict(os.environ))
    assert run.stdout.splitlines() == ["[]", "['pygame']"]


def test_the_batch_is_not_drawn_before_it_has_begun() -> None:
    env = TwoRobotsVector(2, render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match=r"call reset\(\)"):
        env.render()
