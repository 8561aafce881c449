"""A predictive controller that can be copied: commands hang on what is wanted now alone, not on those before."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agents.planner import Problem
from agents.predictive import Memory, Predictive
from magenv.forecast import Goal
from magenv.home import start_rows
from magenv.params import require
from magenv.sensitivity import COORDINATES

Floats = NDArray[np.float64]

PULLS = (3.0, 1.0, 0.3)
"""Weights of the way from home under which a plan is made, one after another: each begins with the plan of the last."""
_ONE = np.ones(1, np.bool_)


class Homing(Predictive):
    """The predictive controller, drawn to the home configuration in the frame that the robots carry.

    Many poses have the same effect, and which of them ``Predictive`` commands hangs on those before, and on chance:
    what copies it sees many answers to one question, and learns their mean, which is none. Here every plan begins at
    home, and goes from there only as far as the motion asks for.

    Parameters
    ----------
    n_epm : int
        Number of EPMs.
    control_hz : float
        Control rate.
    plant : str
        Of whose kind the nominal plant is; one whose EPMs jump.

    Raises
    ------
    ValueError
        If EPMs travel: those cannot begin at home.
    """

    def __init__(self, n_epm: int = 2, control_hz: float = 2.0, plant: str = "paper") -> None:
        super().__init__(n_epm, control_hz, plant, "predictive-home")
        require(self._plant.epms_jump, "plant", f"one whose EPMs jump, for {self.name}", plant)

    def _goal(self, memory: Memory, references: Floats, pushing: Floats, rng: np.random.Generator) -> Goal:
        """Return the goal of states (H, 12), with EPMs at home round where the robots are believed to be."""
        goal = super()._goal(memory, references, pushing, rng)
        at_home = np.empty((1, *self._home.shape))
        start_rows(0, 1, _ONE, memory.known[:COORDINATES].reshape(1, 2, 3), self._home, at_home)
        return goal._replace(home=np.repeat(at_home, len(references), axis=0))

    def _plan(self, problem: Problem, last: Floats, rng: np.random.Generator) -> tuple[Floats, float, bool]:
        """Return the commands (H, N, 6) for a problem, and their cost apart from the way from home."""
        commands = problem.goal.home.copy()
        if not np.isfinite([*problem.state, *problem.pushing]).all():
            return commands, math.inf, False
        for pull in PULLS:
            cost = self._planner.polish(replace(problem, goal=problem.goal._replace(pull=pull)), commands)
        if math.isfinite(cost):
            cost = self._planner.missed(problem, commands)
        return commands, cost, False
