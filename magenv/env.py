"""The Gymnasium environment: one episode at a time."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from magenv.actions import ActionMode
from magenv.episode import Episode
from magenv.episodes import Episodes, Settings
from magenv.params import require
from magenv.render import RENDER_FPS, Renderer
from magenv.scene import scene_of
from magenv.task import Frame, ObservationMode


class TwoRobots(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Two magnetic capsule robots in a plane, moved by two or three external permanent magnets (EPMs).

    ## Description
    Each robot carries a small magnet (IPM). The EPMs' poses are the only control; they pull and turn both robots at
    once, and the robots attract or repel each other. The task is to make both follow a reference in position and
    heading, side by side, ever closer. The system is that of Davy et al., "Independent Control of Two Magnetic Robots
    using External Permanent Magnets: A Feasibility Study" (2023).

    ## Action space
    ``Box(-1, 1, (5 N,), float32)``, N = number of EPMs; per EPM azimuth, elevation, radius of its centre, azimuth and
    elevation of its moment.

    | ``action`` | meaning of -1 .. 1 |
    |---|---|
    | ``home`` (default) | offset from home in the robots' frame: angles +-1.2 rad; radius 0.15 .. 0.35 m |
    | ``pose`` | absolute pose, global frame: azimuths +-pi, elevations +-pi/2, radius 0.15 .. 0.5 m |
    | ``step`` | change of the present pose: angles +-0.3 rad, radius +-50 mm |
    | ``wrench`` | ``Box(-1, 1, (6,))``: F_x, F_y (20 mN), tau_z (1 mN m) per robot, global frame |
    | ``velocity`` | ``Box(-1, 1, (6,))``: v_x, v_y (10 mm/s), rate (0.5 rad/s) per robot, robots' frame |

    Wrenches are turned into poses by ``magenv.allocation``, velocities over the coming hold by ``magenv.steering``,
    both by nominal magnets, drags and masses; ``info["solver"]``, in these modes alone, is a code into
    ``magenv.outcome.OUTCOMES``: whether a wrench is exerted to a tenth, or a motion met to 0.2 mm and 0.3 degrees;
    whether the nearest in reach misses it; or whether nothing was found and the EPMs stay where they were commanded to
    last.

    EPMs that would come closer to each other than their mutual attraction allows (98.1 N) are moved apart, those that
    would be out of their arms' reach are moved within it; ``info["projected"]`` says so.

    ## Observation space
    ``Box(float32)``, finite bounds: pose errors first, then what makes the task Markov; the table is in
    ``magenv.task``, and ``magenv.task.unpack(observation, env.unwrapped.layout)`` names the parts in SI units.
    ``observation="errors"`` gives the pose errors (8) alone.

    ## Rewards
    Mean of two terms in [0, 1], ``info["reward_position"]`` and ``info["reward_heading"]``, of the mean errors over the
    hold; see ``magenv.task``. Success is measured apart from it.

    ## Starting state
    On the reference, at rest, with an offset of 1 mm and 3 degrees standard deviation; EPMs at home, or where commands
    act late or EPMs accelerate, at poses that hold nominal robots.

    ## Episode end
    *Terminated* where control is lost: a robot over 30 mm from its reference, bodies touching, or the wall reached
    (``info["loss"]`` is a code into ``magenv.world.LOSSES``). *Truncated* at the end of the reference (100 s).
    ``info["is_success"]`` at the end says whether control was kept.

    ## Arguments
    | name | default | |
    |---|---|---|
    | ``scenario`` | ``random`` | ``random`` (training family), ``random-<s>``, a shape as ``approach-<s>``; s in mm |
    | ``plant`` | ``paper`` | EPMs jump to their commanded poses, no noise; ``moving``: they go there at 1 m/s and |
    | | | 180 degrees/s at most, give way to each other, and act on the robots on the way; ``arm``: these moves begin |
    | | | and end at rest (5 m/s^2, 10 rad/s^2), commands act 0.1 s late, noise is 1.3 mm and 1.1 degrees, |
    | | | masses, drags and moments differ by up to 20 % from the nominal ones, anew in each episode; |
    | | | ``arm-reach``: ``arm``, each EPM within 0.41 to 0.82 m of a shoulder of its own beside the workspace, all |
    | | | the way; ``low-drag``, ``high-drag``: ``paper`` at the ends of what drag may be; ``cylinders``: ``paper`` |
    | | | with EPMs that act as the cylinders that they are, not as dipoles. Parameters of ``magenv.params.Plant`` may |
    | | | be changed behind a colon: ``arm:latency_s=0.05,disturbance_n=1e-3``, ``arm:epm_cylinders=true`` |
    | ``n_epm`` | 2 | 2 or 3 |
    | ``action`` | ``home`` | see above |
    | ``observation`` | ``full`` | ``full`` or ``errors`` |
    | ``frame`` | ``robots`` | frame of the observation: ``robots`` or ``global`` |
    | ``control_hz`` | 2.0 | control rate |
    | ``render_mode`` | None | ``human`` or ``rgb_array`` |

    ## Version history
    * v0: first version.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": RENDER_FPS}  # noqa: RUF012

    def __init__(
        self,
        scenario: str = "random",
        plant: str = "paper",
        n_epm: int = 2,
        action: ActionMode = "home",
        observation: ObservationMode = "full",
        frame: Frame = "robots",
        control_hz: float = 2.0,
        render_mode: str | None = None,
    ) -> None:
        modes = self.metadata["render_modes"]
        require(render_mode in (None, *modes), "render_mode", "one of None, " + ", ".join(modes), render_mode)
        self.render_mode = render_mode
        self._episodes = Episodes(1, Settings(scenario, plant, n_epm, action, observation, frame, control_hz))
        self._episode = Episode(self._episodes)
        self.layout = self._episodes.layout
        self.observation_space = self._episodes.observation_space
        self.action_space = self._episodes.action_space
        self._drawn_from: np.random.Generator | None = None
        self._running = False
        self._renderer: Renderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; the same seed gives the same episode, bit for bit."""
        super().reset(seed=seed)
        if self.np_random is not self._drawn_from:
            self._drawn_from = self.np_random
            self._episodes.seed(0, self.np_random)
        observation, info = self._episode.start()
        self._running = True
        if self._renderer is not None:
            self._renderer.restart()
        if self.render_mode == "human":
            self.render()
        return observation, info

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Command the EPMs for one control period.

        Raises
        ------
        ValueError
            If the action has the wrong shape or is not finite; nothing has moved then.
        gymnasium.error.ResetNeeded
            If no episode is running.
        """
        if not self._running:
            raise ResetNeeded("No episode is running; call reset() before step().")
        observation, reward, terminated, truncated, info = self._episode.step(action)
        if terminated or truncated:
            self._running = False
            info["is_success"] = truncated
        if self.render_mode == "human":
            self.render()
        return observation, reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the scene: return an RGB array (h, w, 3), or show a window and return None."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs render_mode='human' or 'rgb_array' given to gymnasium.make.")
            return None
        if self._drawn_from is None:
            raise ResetNeeded("No episode has begun; call reset() before render().")
        if self._renderer is None:
            self._renderer = Renderer(self._episodes.system, self._episodes.plant, self.render_mode == "human")
        return self._renderer.draw(scene_of(self._episodes.world, 0))

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy takes over: all but the pictures, which it draws anew."""
        return vars(self) | {"_renderer": None}

    def close(self) -> None:
        """Close the window; may be called again."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
