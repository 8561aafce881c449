"""The simplest controller that the action mode ``velocity`` allows: go to the reference in one hold."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from magenv.actions import ActionMode
from magenv.params import TaskParams
from magenv.task import ERROR_SCALE_M, Frame, ObservationMode
from magenv.velocity import VELOCITY_MPS, VELOCITY_RADPS


class Steered:
    """Asks for the velocities that would bring both robots to their references by the end of the coming hold.

    A proportional law without gains: all it is good for comes from ``magenv.steering``, so it tells what of an agent's
    success in ``velocity`` was learned.

    Parameters
    ----------
    control_hz : float
        Control rate.
    """

    name = "steered"
    action: ActionMode = "velocity"
    observation: ObservationMode = "errors"
    frame: Frame = "robots"

    def __init__(self, control_hz: float = 2.0) -> None:
        self._per_period = 1.0 / TaskParams(control_hz=control_hz).period_s

    def seed(self, seed: int) -> None:
        """Do nothing: there is no randomness."""

    def predict(
        self,
        observation: NDArray[np.float32],
        state: Any | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the ``velocity`` actions (n, 6) for observations (n, 8), or (6,) for (8,); there is no state."""
        error = np.reshape(observation, (*np.shape(observation)[:-1], 2, 4))  # in the frame that the robots carry
        way = error[..., :2] * (ERROR_SCALE_M / VELOCITY_MPS)
        turn = np.arctan2(error[..., 2:3], error[..., 3:4]) / VELOCITY_RADPS
        action = np.concatenate([way, turn], axis=-1) * self._per_period
        return np.clip(action, -1.0, 1.0).reshape(*np.shape(observation)[:-1], -1).astype(np.float32), None
