"""The batched environment: many episodes in one call, equal to the scalar environment bit for bit."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from magenv.actions import ActionMode
from magenv.episodes import Bools, Episodes, Observations, Settings, check_action
from magenv.params import is_whole, require
from magenv.render import RENDER_FPS, Renderer
from magenv.scene import scene_of
from magenv.task import Frame, ObservationMode

Rewards = NDArray[np.float64]


class TwoRobotsVector(VectorEnv[Observations, NDArray[np.float32], NDArray[Any]]):
    """``num_envs`` environments of ``magenv.env.TwoRobots`` in one; see there for the task and its arguments.

    Episode ``i`` behaves as a scalar environment reset with the ``i``-th seed and then without seeds.

    Parameters
    ----------
    num_envs : int
        Number of episodes side by side.
    autoreset_mode : AutoresetMode or str
        ``NextStep``: an ended episode begins anew at the next step, whose action is ignored. ``SameStep``: it begins
        anew at once; ``info["final_obs"]`` and ``info["final_info"]`` hold its end. ``Disabled``: the caller resets
        with ``options={"reset_mask": ...}``.
    threads : int
        Threads that share the episodes; results do not depend on it. One by default, since batches are often run side
        by side in processes.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": RENDER_FPS}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        scenario: str = "random",
        plant: str = "paper",
        n_epm: int = 2,
        action: ActionMode = "home",
        observation: ObservationMode = "full",
        frame: Frame = "robots",
        control_hz: float = 2.0,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 1,
    ) -> None:
        whole = isinstance(num_envs, int) and not isinstance(num_envs, bool) and num_envs >= 1
        require(whole, "num_envs", "a whole number of at least 1", num_envs)
        require(render_mode in (None, "rgb_array"), "render_mode", "None or rgb_array", render_mode)
        known = [mode.value for mode in AutoresetMode]
        value = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        require(value in known, "autoreset_mode", "one of " + ", ".join(known), autoreset_mode)
        self.autoreset_mode = AutoresetMode(value)
        self.metadata = type(self).metadata | {"autoreset_mode": self.autoreset_mode}
        self.num_envs = num_envs
        self.render_mode = render_mode
        settings = Settings(scenario, plant, n_epm, action, observation, frame, control_hz)
        self._episodes = Episodes(num_envs, settings, threads)
        self.layout = self._episodes.layout
        self.single_observation_space = self._episodes.observation_space
        self.single_action_space = self._episodes.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._begun: Bools = np.zeros(num_envs, np.bool_)
        self._ended: Bools = np.ones(num_envs, np.bool_)
        self._renderers: list[Renderer] = []
        _keep_memory(_STEP_BYTES * num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin episodes, in all rows or where ``options["reset_mask"]`` says; row i takes seed + i, or the i-th."""
        seeds: list[int | None] = [None] * self.num_envs
        if is_whole(seed):
            seeds = [int(seed) + i for i in range(self.num_envs)]  # type: ignore[arg-type]
        elif seed is not None:
            seeds = list(seed) if isinstance(seed, (list, tuple, np.ndarray)) else []
        fits = len(seeds) == self.num_envs and all(s is None or (is_whole(s) and s >= 0) for s in seeds)
        require(fits, "seed", f"a whole number of at least 0, or {self.num_envs} of them", seed)
        mask = np.ones(self.num_envs, np.bool_)
        if options is not None and "reset_mask" in options:
            mask = np.array(options["reset_mask"])
            fits = mask.shape == (self.num_envs,) and mask.dtype == np.bool_ and bool(mask.any())
            require(fits, "reset_mask", f"{self.num_envs} booleans, one of them true", options["reset_mask"])
        for row in np.flatnonzero(mask).tolist():
            own = seeds[row]
            if own is not None:
                self._episodes.seed(row, seeding.np_random(int(own))[0])
        observations = self._episodes.observe()
        self._start(mask, observations)
        return observations, _masked(self._episodes.state_info(), mask)

    def step(self, actions: NDArray[np.float32]) -> tuple[Observations, Rewards, Bools, Bools, dict[str, Any]]:
        """Command the EPMs of all episodes for one control period.

        Raises
        ------
        ValueError
            If the actions have the wrong shape or are not finite; nothing has moved then.
        gymnasium.error.ResetNeeded
            If an episode has ended and was not reset (``Disabled``), or none has begun.
        """
        if not self._begun.all():
            raise ResetNeeded("No episodes are running; call reset() before step().")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._ended.any():
            raise ResetNeeded(
                f"Episodes {np.flatnonzero(self._ended).tolist()} have ended; reset them with a reset_mask."
            )
        checked = check_action(actions, (self.num_envs, self._episodes.actions.size))
        resetting = self._ended.copy()
        active = ~resetting
        observations = self._episodes.step(checked, active)
        reward, terminated, truncated = self._episodes.outcome()
        ended = terminated | truncated
        if resetting.any():
            self._start(resetting, observations)
        info = _masked(self._episodes.step_info(), active)
        info |= _masked({"is_success": truncated.copy()}, ended)
        self._ended = ended.copy()
        if self.autoreset_mode == AutoresetMode.SAME_STEP and ended.any():
            info = self._same_step(info, ended, observations)
        info |= _masked(self._episodes.state_info(), np.ones(self.num_envs, np.bool_))
        return observations, reward, terminated, truncated, info

    def _same_step(self, info: dict[str, Any], ended: Bools, observations: Observations) -> dict[str, Any]:
        """Begin the ended episodes anew; return the info of the others, with the end of these beside it."""
        last = observations[ended]
        final_obs = np.full(self.num_envs, None, dtype=object)
        final_obs[ended] = np.fromiter(last, object, len(last))  # a row each
        values = {name: value for name, value in info.items() if not name.startswith("_")}
        success = {"is_success": values.pop("is_success")}
        final = _masked(self._episodes.step_info() | success | self._episodes.state_info(), ended)
        self._start(ended, observations)
        return (
            _masked(values, ~ended)
            | _masked({"final_obs": final_obs}, ended)
            | {"final_info": final, "_final_info": ended.copy()}
        )

    def _start(self, mask: Bools, observations: Observations) -> None:
        self._episodes.start(mask, observations)
        if self._renderers:
            for row in np.flatnonzero(mask):
                self._renderers[row].restart()
        self._ended[mask] = False
        self._begun |= mask

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return one RGB array (h, w, 3) per episode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs render_mode='rgb_array' given to gymnasium.make_vec.")
            return None
        if not self._begun.all():
            raise ResetNeeded("No episodes have begun; call reset() before render().")
        if not self._renderers:
            for _ in range(self.num_envs):
                self._renderers.append(Renderer(self._episodes.system, self._episodes.plant, window=False))
        frames = [r.draw(scene_of(self._episodes.world, row)) for row, r in enumerate(self._renderers)]
        return tuple(frame for frame in frames if frame is not None)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy takes over: all but the pictures, which it draws anew."""
        return vars(self) | {"_renderers": []}

    def close_extras(self, **kwargs: Any) -> None:
        """Free the renderers."""
        for renderer in self._renderers:
            renderer.close()
        self._renderers = []


_STEP_BYTES = 4096
"""About what a step allocates for an episode: observations and infos, those of its end beside those of its start."""


def _keep_memory(size: int) -> None:
    """Let the C library keep this much (bytes) for the arrays to come when those of earlier steps are freed.

    glibc returns what is free beyond twice the largest block that was ever freed to the system, up to 32 MB; to get it
    back page by page at every step would take longer than to write it.
    """
    np.empty(min(size, 30_000_000), np.uint8)


def _masked(values: dict[str, NDArray[Any]], mask: Bools) -> dict[str, Any]:
    """Return the values with Gymnasium's ``_name`` masks beside them."""
    return values | {f"_{name}": mask.copy() for name in values}
