"""Trims: EPM poses under which the robots keep to their way by themselves for a while.

A trim is as near to a stable equilibrium in the plane as there is. By Earnshaw's theorem no hold is stable in all
directions. But the robots stay in their plane, which bears what is unstable across it, and in the plane errors may even
die away while the EPMs stand still. Such poses lie far from most others that hold the robots; EPMs that travel are to
be near them in time, for commands that come late do no harm there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agents.searches import DOUBT, Statics, beside
from magenv.forecast import Course, Goal
from magenv.horizon import Scratch, plan
from magenv.manoeuvre import Arms, allow
from magenv.sensitivity import COORDINATES, Model

Floats = NDArray[np.float64]

STAND_S = 0.5
"""Time over which the EPMs are to stand still."""
AHEAD_S = 1.0
"""A trim is for where the robots should be so much later: the EPMs need time to come to it."""
NEAR = 0.3
"""Weight of the way from the last trim."""
ROOM = 3.0
"""Weight of EPMs that are too near to each other."""
ITERATIONS = 8
"""Of a descent."""
WELL = 0.5
"""Cost from which on a trim is sought elsewhere too: by statics or beside the one that was found, as the dice fall."""
BESIDE = np.repeat([0.1, 1.0], 3)
"""How far beside: standard deviations of an EPM's position (m) and moment."""
BETTER = 0.8
"""Share of the cost at most with which one from elsewhere is taken: to change over costs a way."""


class Trim:
    """Trims on a nominal plant.

    Parameters
    ----------
    model : Model
        What is believed of the plant.
    arms : Arms
        Limits of radii, gap and reach.
    statics : Statics
        Where trims are sought.
    weights : ndarray, shape (12,)
        Of the errors, per m, rad, m/s, rad/s.
    """

    def __init__(self, model: Model, arms: Arms, statics: Statics, weights: Floats) -> None:
        n = len(model.epm_moment)
        self._model, self._arms, self._weights = model, arms._replace(travels=False), weights
        self._statics = statics
        self._motion = Course.of(n, max(1, round(STAND_S / model.substep)), False)
        self._scratch = Scratch.of(1, n, 1)

    def follow(self, state: Floats, pushing: Floats, last: Floats, rng: np.random.Generator) -> Floats:
        """Return the trim (N, 6) for robots on their way, from the ``last`` (N, 6) on, or a better one elsewhere.

        ``state`` (12,) is where the robots should be, with their rates; ``pushing`` (6,) acts besides, N and N m.
        """
        start = state.copy()
        start[:COORDINATES] += AHEAD_S * state[COORDINATES:]
        cost, trim = self.improve(start, pushing, last, last)
        if not cost > WELL:
            return trim
        elsewhere: Floats | None
        if rng.random() < 0.5:
            elsewhere = self._statics.hold(start[:COORDINATES], start[COORDINATES:], pushing, rng)
        else:
            elsewhere = beside(trim, BESIDE, rng)
        if elsewhere is None:
            return trim
        other, found = self.improve(start, pushing, last, elsewhere)
        return found if other < BETTER * cost else trim

    def improve(self, start: Floats, pushing: Floats, last: Floats, epms: Floats) -> tuple[float, Floats]:
        """Return the cost of a trim for a state (12,), and the trim (N, 6), found by descent from EPMs (N, 6).

        The cost is that of the errors after ``STAND_S``, of what ``DOUBT`` has grown to by then, and of the way from
        the ``last`` trim (N, 6). It is infinite where nothing can be foreseen; the trim is then the EPMs given, within
        their bounds.
        """
        end = start.copy()
        end[:COORDINATES] += STAND_S * start[COORDINATES:]
        marks = np.array([len(self._motion.which)])
        goal = Goal(marks, end[None, None], self._weights, last[None].copy(), NEAR, ROOM)
        trim = epms[None].copy()
        allow(self._arms, last, trim[0])
        cost, _ = plan(
            self._model,
            start,
            pushing,
            DOUBT,
            goal,
            self._arms,
            self._motion,
            epms,
            0.0,
            ITERATIONS,
            self._scratch,
            trim,
        )
        return cost, trim[0]
