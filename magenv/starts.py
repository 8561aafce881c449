"""Where episodes begin: trajectories and start offsets, drawn from each row's own generator before anything moves."""

from __future__ import annotations

import math

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from magenv.allocation import allocate
from magenv.kernels import kernel
from magenv.params import InputError, System, require
from magenv.poses import POSE_SIZE, home_pose, robots_frame, to_cartesian
from magenv.reach import COMMAND_MARGIN_M, Shell, beyond_reach, narrowed
from magenv.trajectories import draw_keys, draw_rows, random_limits, reference_of, trajectory_of
from magenv.workers import Workers
from magenv.wrench import IN_PLANE, WRENCH_SIZE, planar_moments

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_AHEAD = 32
"""Episodes for which a row draws at a time, whatever the size of the batch: it is part of what a seed means."""
_TURNS = 100
"""Searches for poses within reach that hold the robots."""
_FEW_TURNS = 10
"""The same where the best will do."""
_FARTHEST = np.array([1.0, 1.0, 0.1, 1.0, 1.0])
"""Standard deviation of the last one's start from home, per coordinate of a pose."""


HELD = 2e-5
"""Residual of a hold, over 0.5 N and 0.05 N m: 0.01 mN moves a robot by 0.07 mm in a second."""


@kernel
def place_rows(
    first: int,
    last: int,
    mask: Bools,
    offsets: Floats,
    used: NDArray[np.int64],
    position_sd: float,
    heading_sd: float,
    coefficients: Floats,
    duration: Floats,
    robots: Floats,
    measured: Floats,
    before: Floats,
) -> None:
    """Put the robots at rest near the start of their references where ``mask`` says, by their next offsets."""
    for i in range(first, last):
        if mask[i]:
            which = trajectory_of(i, len(duration))
            reference_of(coefficients, which, duration[which], 0.0, measured, i)
            at = used[i]
            used[i] += 1
            for robot in range(2):
                measured[i, robot, 0] += position_sd * offsets[i, at, 2 * robot]
                measured[i, robot, 1] += position_sd * offsets[i, at, 2 * robot + 1]
                measured[i, robot, 2] += heading_sd * offsets[i, at, 4 + robot]
                for j in range(3):
                    robots[i, robot, j], robots[i, robot, 3 + j] = measured[i, robot, j], 0.0
                    before[i, robot, j] = measured[i, robot, j]


def holding_epms(
    reference: Floats, system: System, shell: Shell, home_turn: float = 0.0, at_best: bool = False
) -> Floats:
    """Return EPMs (N, 6) that hold nominal robots at rest at a reference (2, 3), as near home as the solver finds them.

    Where commands act late the robots would be gone before the first one, if the EPMs stood at home. Poses out of reach
    are sought anew from farther and farther away from home. With ``at_best`` those will do that come nearest to it:
    robots in line and 24 mm apart or less, as the random family has them too, attract each other more than two EPMs
    can push them apart.

    Raises
    ------
    ValueError
        If none within reach are found.
    """
    least, best = math.inf, np.empty(0)
    positions = np.zeros((2, 3))
    positions[:, :2] = reference[:, :2]
    home = home_pose(system.n_epm, home_turn).reshape(-1, POSE_SIZE)
    home[:, [0, 3]] += robots_frame(reference[0, 2], reference[1, 2])
    rng, within = np.random.default_rng(0), narrowed(shell, COMMAND_MARGIN_M)
    for turn in range(_TURNS):
        held = allocate(
            np.zeros(WRENCH_SIZE),
            positions,
            planar_moments(reference[:, 2], system.ipm_moment_am2),
            system,
            seed=0,
            initial=(home + turn / _TURNS * _FARTHEST * rng.normal(size=home.shape)).reshape(-1),
            stop_early=True,
            components=IN_PLANE,
        )
        epms = np.concatenate(to_cartesian(held.pose), axis=-1)
        if held.residual < least and (shell.outer == math.inf or beyond_reach(epms, within, False) == 0.0):
            least, best = held.residual, epms
        if least < HELD or (at_best and turn >= _FEW_TURNS and least < math.inf):
            return best
    must = "one at whose start EPMs can hold the robots"
    require(shell.outer < math.inf, "reference", must, reference.round(6).tolist())
    raise InputError(
        "Input arm_reach_m must be so large that EPMs within reach hold the robots at the start; instead received "
        f"{shell.outer!r}."
    )


class Starts:
    """The beginnings of ``n`` rows' episodes, one after another along each row's generator.

    They are drawn many at a time, since a call of a generator costs as much as its numbers.

    Attributes
    ----------
    nearest : float, optional
        Least separation of the random family (m) that trajectories are drawn from; None where all follow a shape. It
        may be changed: episodes that begin later are drawn accordingly.
    """

    def __init__(self, n: int, nearest: float | None, uncertain: bool, workers: Workers) -> None:
        self.nearest = nearest
        self._uncertain = uncertain
        self._workers = workers
        self._rngs: list[np.random.Generator | None] = [None] * n
        self.used: NDArray[np.int64] = np.full(n, _AHEAD)
        self.offsets: Floats = np.zeros((n, _AHEAD, 6))
        self._sure = 0  # so many starts are drawn in every row
        self._keys: NDArray[np.uint64] = np.zeros((n, _AHEAD if nearest is not None else 0), np.uint64)
        self.plant_keys: NDArray[np.uint64] = np.zeros((n, _AHEAD if uncertain else 0), np.uint64)

    def seed(self, row: int, rng: np.random.Generator) -> None:
        """Draw the episodes of ``row`` from ``rng`` from now on."""
        self._rngs[row] = rng
        self.used[row] = _AHEAD
        self._sure = 0

    def _draw_ahead(self, row: int) -> None:
        rng = self._rngs[row]
        if rng is None:
            rng = self._rngs[row] = seeding.np_random(None)[0]
        if self.nearest is not None:
            self._keys[row] = draw_keys(rng, _AHEAD)
        rng.standard_normal(out=self.offsets[row])
        if self._uncertain:  # after all else, so that a plant's kind changes neither trajectory nor start
            self.plant_keys[row] = draw_keys(rng, _AHEAD)
        self.used[row] = 0

    def draw(self, mask: Bools, coefficients: Floats, duration: Floats) -> None:
        """Draw the next episodes of the rows where ``mask`` says; random trajectories are written to the arrays.

        What is left is ``place_rows``, with ``offsets`` and ``used``.
        """
        if self._sure == 0:
            for row in np.flatnonzero(mask & (self.used == _AHEAD)).tolist():
                self._draw_ahead(row)
            self._sure = _AHEAD - int(self.used.max())
        self._sure = max(self._sure - 1, 0)
        if self.nearest is not None:
            limits = (*random_limits(), self.nearest)
            self._workers.run(draw_rows, len(mask), mask, self._keys, self.used, *limits, coefficients, duration)
