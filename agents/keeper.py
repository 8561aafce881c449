"""What a training keeps: at every checkpoint its policy is judged, and the best so far stored; one that diverged stops.

Nothing that is not finite is ever written: the last checkpoint and the best model stay what they were.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from agents.checkpoints import BEST, MODEL, best_so_far, checkpoints, save_model
from agents.configs import TrainConfig
from agents.evaluation import EPISODES, EPISODES_CORRECTED, SEED, HeldOut, Score
from agents.learned import whole
from agents.rollout import controller_seed
from agents.store import NotFiniteError
from magenv.command import RunError

KEPT_CHECKPOINTS = 2

Watch = Callable[[Score], None]
"""Is told each score on the held-out episodes while a training runs; what it raises ends the training."""


class DivergedError(RunError):
    """A training whose numbers are no longer finite."""


class Keeper(BaseCallback):
    """Judges the policy, and writes checkpoints, the best model and the last.

    Attributes
    ----------
    score : Score, optional
        The latest; None before the first checkpoint.
    """

    def __init__(
        self, model: BaseAlgorithm, config: TrainConfig, env: VecNormalize, command: str, watch: Watch | None = None
    ) -> None:
        super().__init__()
        self.model = model
        self._config, self._env, self._command, self._watch = config, env, command, watch
        self._held_out = HeldOut(config.settings, EPISODES if config.correction is None else EPISODES_CORRECTED)
        self._best = best_so_far(config)
        self.score: Score | None = None
        self._next_checkpoint = 0

    def _on_training_start(self) -> None:
        every = self._config.checkpoint_steps
        self._next_checkpoint = (self.num_timesteps // every + 1) * every

    def _on_rollout_start(self) -> None:
        self.check()  # what the last update has made

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next_checkpoint:
            self._next_checkpoint += self._config.checkpoint_steps
            self._judge()
            self._checkpoint(self.score)
            if self._watch is not None and self.score is not None:
                self._watch(self.score)
        return True

    def finish(self) -> None:
        """Judge and store the last policy, as ``model`` and as a checkpoint to go on from."""
        self.check()
        self._judge()
        self._save(self._config.folder / MODEL, False, self.score)
        self._checkpoint(self.score)

    def keep(self) -> None:
        """Write a checkpoint out of turn, of a policy that nobody has judged."""
        self.check()
        self._checkpoint(None)

    def check(self) -> None:
        """Raise ``DivergedError`` unless parameters, losses and the actions for the last observations are finite."""
        parameters = torch.nn.utils.parameters_to_vector(self.model.policy.parameters())
        if not bool(torch.isfinite(parameters).all()):
            raise self.diverged("parameters are not finite")
        losses = [value for name, value in self.logger.name_to_value.items() if name.endswith("loss")]
        if not all(math.isfinite(value) for value in losses):
            raise self.diverged("the loss is not finite")
        last = self.model._last_obs
        if isinstance(last, np.ndarray):
            self._mode(last)

    def _mode(self, normalised: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the policy's mode (n, a) for normalised observations (n, d), or raise ``DivergedError``."""
        try:
            actions, _ = self.model.predict(normalised, deterministic=True)
        except ValueError as error:  # torch refuses to make a distribution of NaN
            raise self.diverged("actions are not finite") from error
        if not np.isfinite(actions).all():
            raise self.diverged("actions are not finite")
        return actions

    def diverged(self, what: str) -> DivergedError:
        """Return the error that tells what is not finite, and what was kept."""
        found = checkpoints(self._config.folder)
        kept = f"the last good checkpoint is {found[-1]}" if found else "there was no checkpoint yet"
        return DivergedError(
            f"The training diverged within {self.model.num_timesteps} steps ({what}; a lower learning rate may help); "
            f"{kept}."
        )

    def _judge(self) -> None:
        """Run the held-out episodes; log what is reached, and store the policy where it is the best so far.

        Neither the training's episodes, nor its random numbers, nor the statistics of observations are touched.
        """
        self.score = self._held_out.score(self._acting())
        for name, value in vars(self.score).items():
            self.logger.record(f"eval/{name}", value)
        if self._best is None or self.score.merit > self._best.merit:
            # Before the checkpoint: a run gone on with from there has been judged up to there.
            self._save(self._config.folder / BEST, False, self.score)
            self._best = self.score

    def _policy(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the policy's mode (n, a) for observations (n, d) as they are told."""
        normalised = self._env.normalize_obs(observations)
        assert isinstance(normalised, np.ndarray)
        return self._mode(normalised)

    def _acting(self) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
        """Return what acts in episodes that all begin at its first call: the policy with all that it goes with."""
        config = self._config
        acting = whole(self._policy, config.settings, config.correction, config.history)
        if acting is None:
            return self._policy
        acting.seed(controller_seed(SEED))
        state, begin = None, True

        def predict(observations: NDArray[np.float32]) -> NDArray[np.float32]:
            nonlocal state, begin
            actions, state = acting.predict(observations, state, np.full(len(observations), begin))
            begin = False
            return actions

        return predict

    def _checkpoint(self, score: Score | None) -> None:
        """Write a checkpoint; drop all but the run's last two, and what was left half written."""
        folder = self._config.folder / "checkpoints" / f"step-{self.model.num_timesteps:012d}"
        self._save(folder, True, score)
        kept = checkpoints(self._config.folder)[-KEPT_CHECKPOINTS:]
        for other in folder.parent.iterdir():
            if other.is_dir() and other.name.startswith("step-") and other not in kept:
                shutil.rmtree(other)

    def _save(self, folder: Path, with_training: bool, score: Score | None) -> None:
        try:
            save_model(folder, self.model, self._env, self._config, with_training, self._command, score)
        except NotFiniteError as error:  # an optimiser's averages, which squares overflow first
            raise self.diverged("optimisers are not finite") from error
