"""The paper's controller: PID, then the EPM poses whose wrench on the robots comes nearest to what it asks for.

``paper_baseline`` is the paper's: ten random starts at every step, no memory of the last poses. ``tuned_baseline`` is
its twin at its best: gains optimised on training trajectories (``python -m agents.tune``), warm start allowed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.controller import RowGenerators
from agents.pid import Gains, PIDState, pid_wrench
from magenv.actions import ActionMode, planar_target, pose_to_action
from magenv.allocation import allocate
from magenv.outcome import FELL_BACK, outcome_of
from magenv.params import InputError, Plant, System, TaskParams
from magenv.poses import from_cartesian
from magenv.task import Frame, Layout, ObservationMode, unpack
from magenv.wrench import WRENCH_SIZE, planar_moments

Floats = NDArray[np.float64]

PAPER_GAINS = Gains(force_p=0.0084, force_i=2.45e-4, force_d=0.005, torque_p=2.0e-6)
"""Calibrated with the plant so that the paper's outcome shows (the paper gives no gains)."""
TUNED_GAINS = Gains(0.194, 7.47e-3, 6.91e-3, 8.03e-5, 6.04e-7, 1.77e-6)
"""Best of ``python -m agents.tune``."""
STARTS = 10
"""Random starts of the allocation (paper)."""


@dataclass
class BaselineState:
    """What is remembered of ``n`` episodes; and how the last allocations ended."""

    pid: PIDState
    solver: NDArray[np.int64]
    """(n,) codes into ``magenv.outcome.OUTCOMES``."""


class Baseline:
    """PID and allocation behind ``predict``, on nominal parameters of its own.

    Parameters
    ----------
    name : str
        Under which results are reported.
    gains : Gains
        Of the PID.
    warm_start : bool
        Whether the allocation first tries from the present poses, and takes random starts only where that fails.
    n_epm : int
        Number of EPMs.
    control_hz : float
        Control rate.
    """

    action: ActionMode = "pose"
    observation: ObservationMode = "full"
    frame: Frame = "robots"

    def __init__(self, name: str, gains: Gains, warm_start: bool, n_epm: int = 2, control_hz: float = 2.0) -> None:
        self.name = name
        self._gains = gains
        self._warm_start = warm_start
        self._system = System(n_epm=n_epm)
        self._period_s = TaskParams(control_hz=control_hz).period_s
        self._layout = Layout(self._system, Plant().workspace_radius_m, self._period_s, self.observation, self.frame)
        self.seed(0)

    def seed(self, seed: int) -> None:
        """Fix the random starts to come."""
        self._rngs = RowGenerators(seed)

    def predict(
        self,
        observation: NDArray[np.float32],
        state: BaselineState | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], BaselineState]:
        """Return the ``pose`` actions (n, 5 N) for observations (n, d), or (5 N,) for (d,), and the new state."""
        batch = np.atleast_2d(observation)
        parts = unpack(batch, self._layout)
        present = from_cartesian(parts.epm_positions, parts.epm_directions)
        if state is None:
            state = BaselineState(PIDState.start(len(batch)), np.zeros(len(batch), np.int64))
        elif episode_start is not None:
            state.pid.restart(episode_start)
        desired = pid_wrench(parts.error, state.pid, self._gains, self._period_s)
        rows = zip(desired, parts.robots, present, self._rngs.of(len(batch)), strict=True)
        found = [self._allocate(*row) for row in rows]
        state.solver[:] = [outcome for _, outcome in found]
        actions = np.stack([pose_to_action(pose, self._system) for pose, _ in found])
        return actions.reshape(*np.shape(observation)[:-1], -1), state

    def _allocate(
        self, desired: Floats, robots: Floats, present: Floats, rng: np.random.Generator
    ) -> tuple[Floats, int]:
        """Return EPM poses for planar wrenches (2, 3) on robots (2, 3), out-of-plane components zero; how that ended.

        The present poses are held where there is nothing to be found.
        """
        target = np.empty(WRENCH_SIZE)
        planar_target(desired.reshape(-1), robots[0, 2], robots[1, 2], target)
        positions = np.zeros((2, 3))
        positions[:, :2] = robots[:, :2]
        moments = planar_moments(robots[:, 2], self._system.ipm_moment_am2)
        try:
            found = allocate(
                target,
                positions,
                moments,
                self._system,
                starts=STARTS,
                seed=rng,
                initial=present if self._warm_start else None,
                stop_early=self._warm_start,
            )
        except InputError:  # robots measured on the same spot, or a state that is not finite
            return present, FELL_BACK
        outcome = outcome_of(found.relative_residual)
        return (present if outcome == FELL_BACK else found.pose), outcome


def paper_baseline(n_epm: int = 2, control_hz: float = 2.0) -> Baseline:
    """Return the paper's controller."""
    return Baseline("baseline", PAPER_GAINS, False, n_epm, control_hz)


def tuned_baseline(n_epm: int = 2, control_hz: float = 2.0) -> Baseline:
    """Return the paper's controller with optimised gains and warm start."""
    return Baseline("tuned", TUNED_GAINS, True, n_epm, control_hz)
