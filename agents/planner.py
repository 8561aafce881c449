"""Plans for the predictive controller: from the last plan, and where that does not converge, from elsewhere.

Elsewhere are poses that hold the robots on their way by statics and, in turn, poses a little beside the best plan;
from them, plans are made first for a part of the command's time, in which errors grow less than in the whole of it, and
with the doubt of the state that trims have, so that they begin where errors grow least. EPMs that travel come only to
what is near: there, all of the best plan is moved a little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.searches import DOUBT, Statics, beside
from magenv.forecast import STATE, Course, Goal
from magenv.horizon import Scratch, land, plan
from magenv.manoeuvre import Arms, allow, move
from magenv.params import Plant, System
from magenv.poses import EPM_SIZE, POSE_SIZE
from magenv.sensitivity import COORDINATES, Model

Floats = NDArray[np.float64]

ENOUGH = 1.0
"""Cost per command below which a plan is taken without seeking others."""
TROUBLE = 20.0
"""Cost per command above which more are sought."""
SEARCHES, MORE_SEARCHES, TRAVEL_SEARCHES = 2, 16, 6
"""How many of them at most: below that cost, above it, and above it where EPMs travel."""
BESIDE = np.repeat([0.01, 0.05], 3)
"""How far beside the best plan every second search begins: standard deviations of an EPM's position (m) and moment."""
TRAVEL_BESIDE = np.repeat([0.03, 0.3], 3)
"""The same where EPMs travel, of every search."""
LATER_SEARCHES = 3
"""Starts of the later commands of a plan."""
ITERATIONS, SHORT_ITERATIONS = 15, 8
CONVERGED = 1e-3
"""Cost at which a plan is as good as can be."""
PARTS = (0.5,)
"""Shares of a command's time for which a plan from elsewhere is made first."""


@dataclass(frozen=True)
class Problem:
    """What a plan is for."""

    state: Floats
    """(12,) from which the first command acts."""
    pushing: Floats
    """(6,) wrench that acts besides, N and N m."""
    doubt: Floats
    """(12, 12) root of the state's covariance."""
    goal: Goal
    before: Floats
    """(N, 6) EPMs until then."""

    def ahead(self) -> Floats:
        """Return the way (6,) to the first pose of the goal, m and rad."""
        way: Floats = self.goal.references[0, -1, :COORDINATES] - self.state[:COORDINATES]
        way[2::3] = np.remainder(way[2::3] + math.pi, 2 * math.pi) - math.pi
        return way


class Planner:
    """Plans of ``stages`` commands of ``substeps`` each on a nominal plant."""

    def __init__(self, system: System, plant: Plant, period_s: float, substeps: int, stages: int) -> None:
        self._period_s, self._stages = period_s, stages
        self.statics = Statics(system, plant)
        self.model = Model.of(system, plant, period_s / substeps)
        n, travels = system.n_epm, not plant.epms_jump
        self.arms = Arms.of(system, plant, self.model.substep, substeps)
        self._motion = Course.of(n, substeps, travels)
        self._parts = [Course.of(n, max(1, round(share * substeps)), travels) for share in PARTS]
        self._scratch, self._single = Scratch.of(stages, n, 1), Scratch.of(1, n, 1)

    def plan(self, problem: Problem, last: Floats, rng: np.random.Generator) -> tuple[Floats, float, bool]:
        """Return the best commands (H, N, 6) found, their cost, and whether they were sought elsewhere.

        ``last`` (H, N, 6) is where to begin. The cost is infinite where nothing was found.
        """
        best, sought = last.copy(), False
        if not np.isfinite([*problem.state, *problem.pushing]).all():
            return best, math.inf, sought
        cost = self.polish(problem, best)
        turn = 0
        while not cost < ENOUGH * self._stages and turn < self._searches(cost):
            new, commands = self._from_elsewhere(problem, best, turn, cost, rng)
            if new < cost:
                best, cost, sought = commands, new, True
            turn += 1
        return best, cost, sought

    def _searches(self, cost: float) -> int:
        """Return how often another plan is sought at most, while the best one has this cost."""
        if cost < TROUBLE * self._stages:
            return 0 if self.arms.travels else SEARCHES
        return TRAVEL_SEARCHES if self.arms.travels else MORE_SEARCHES

    def missed(self, problem: Problem, commands: Floats) -> float:
        """Return the cost of the errors alone that commands (H, N, 6) lead to."""
        cost, state, before, goal = 0.0, problem.state.copy(), problem.before, problem.goal
        for stage, command in enumerate(commands):
            cost += land(self.model, state, problem.pushing, goal, self.arms, self._motion, stage, before, command)
            before = command
        return cost

    def path(self, before: Floats, command: Floats) -> Floats:
        """Return where the EPMs are in each substep (M, N, 6) of a command's time, the ones before standing there."""
        move(self.arms, before, command, np.empty((0, len(command), EPM_SIZE, POSE_SIZE)), self._motion)
        return self._motion.path[self._motion.which]

    def polish(self, problem: Problem, commands: Floats) -> float:
        """Improve commands (H, N, 6) in place; return their cost."""
        return plan(
            self.model,
            problem.state,
            problem.pushing,
            problem.doubt,
            problem.goal,
            self.arms,
            self._motion,
            problem.before,
            CONVERGED,
            ITERATIONS,
            self._scratch,
            commands,
        )[0]

    def _from_elsewhere(
        self, problem: Problem, best: Floats, turn: int, least: float, rng: np.random.Generator
    ) -> tuple[float, Floats]:
        """Return cost and commands (H, N, 6) of search ``turn``; ``best`` (H, N, 6) is the best found so far."""
        if self.arms.travels:
            commands, before = beside(best, TRAVEL_BESIDE, rng), problem.before
            for command in commands:
                allow(self.arms, before, command)
                before = command
            return self.polish(problem, commands), commands
        first = self._held(problem, rng) if turn % 2 == 0 else beside(best[:1], BESIDE, rng)
        return self._one_after_another(problem, first, least, rng)

    def _one_after_another(
        self, problem: Problem, first: Floats | None, least: float, rng: np.random.Generator
    ) -> tuple[float, Floats]:
        """Return cost and commands (H, N, 6) of a plan that is made of one command after another, then improved.

        It begins with ``first`` (1, N, 6). One whose first command costs more than ``least`` is given up.
        """
        cost, first = self._led_up_to(problem, first)
        if self._stages == 1 or not cost < least:
            return cost if self._stages == 1 else math.inf, first
        goal, commands, state, before = problem.goal, [first[0]], problem.state.copy(), problem.before
        for stage in range(1, self._stages):
            land(self.model, state, problem.pushing, goal, self.arms, self._motion, stage - 1, before, commands[-1])
            before = commands[-1]
            later = Problem(
                state,
                problem.pushing,
                np.zeros((STATE, STATE)),
                goal._replace(references=goal.references[stage:], home=goal.home[stage:]),
                before,
            )
            found = [self._led_up_to(later, self._held(later, rng)) for _ in range(LATER_SEARCHES)]
            commands.append(min(found, key=lambda pair: pair[0])[1][0])
        whole = np.stack(commands)
        return self.polish(problem, whole), whole

    def _held(self, problem: Problem, rng: np.random.Generator) -> Floats | None:
        """Return a command (1, N, 6) that holds the robots on their way by statics, None where there is none."""
        ahead = problem.ahead()
        halfway = problem.state[:COORDINATES] + 0.5 * ahead
        held = self.statics.hold(halfway, ahead / self._period_s, problem.pushing, rng)
        return None if held is None else held[None]

    def _led_up_to(self, problem: Problem, command: Floats | None) -> tuple[float, Floats]:
        """Return cost and command (1, N, 6) of a plan from the given one, first for a part of its time."""
        if command is None:
            return math.inf, problem.before[None]
        allow(self.arms, problem.before, command[0])  # it may be out of the arms' reach
        ahead, cost = problem.ahead(), math.inf
        for motion in (*self._parts, self._motion):
            whole = motion is self._motion
            share = len(motion.which) / len(self._motion.which)
            way = np.concatenate([problem.state[:COORDINATES] + share * ahead, ahead / self._period_s])
            part = problem.goal._replace(marks=np.array([len(motion.which)]), references=way[None, None])
            cost, _ = plan(
                self.model,
                problem.state,
                problem.pushing,
                problem.doubt if whole else DOUBT,
                problem.goal if whole else part,
                self.arms,
                motion,
                problem.before,
                CONVERGED,
                ITERATIONS if whole else SHORT_ITERATIONS,
                self._single,
                command,
            )
        return cost, command
