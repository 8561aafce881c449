"""Problems of planning: robots on an approach, a goal near, and what SciPy makes of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from foreseen import (
    NATURAL,
    WEIGHTS,
    Floats,
    at_home,
    end_of,
    foreseen,
    goal_of,
    held,
    on_the_way,
    shifted,
    uneven_model,
)
from scipy.optimize import least_squares

from magenv.forecast import STATE, Course, Goal
from magenv.horizon import Scratch, plan
from magenv.manoeuvre import Arms
from magenv.params import Plant, System
from magenv.sensitivity import Model

SUBSTEPS = 20
PER = np.array([10.0, 10.0, 10.0, 1.0, 1.0, 1.0])
"""Weights of an EPM's way from home, per m of the centre and per unit of the moment."""
PUSH = np.array([1e-4, -2e-4, 3e-7, 2e-4, 1e-4, -4e-7])


@dataclass
class Task:
    """A problem of planning for robots on an approach, of 0.1 s a command."""

    model: Model
    state: Floats
    before: Floats
    goal: Goal
    arms: Arms
    doubt: Floats

    @classmethod
    def draw(cls, seed: int, n_epm: int = 2, stages: int = 1, pull: float = 0.1, doubt: float = 0.0) -> Task:
        """A goal that other commands near home reach, all but a fifth of a millimetre and what goes with it."""
        rng, system = np.random.default_rng(seed), System(n_epm=n_epm)
        model, weights = uneven_model(n_epm), WEIGHTS * np.repeat([1.0, 0.2], 6)
        state = on_the_way(0.06, rng.uniform(10.0, 90.0)) + 0.3 * rng.normal(size=STATE) * NATURAL
        before, references, end = at_home(state, n_epm), [], state
        for _ in range(stages):
            command = shifted(before, rng.normal(0.0, 0.12, 5 * n_epm) * np.tile([1, 1, 0.1, 1, 1], n_epm), 0.15, 0.5)
            end = end_of(model, end, PUSH, held(command, SUBSTEPS))
            references.append(end + 0.2 * NATURAL * rng.normal(size=STATE))
        goal = goal_of(np.array(references), (SUBSTEPS,), weights, before, pull, room=1.0)
        return cls(
            model,
            state,
            before,
            goal,
            Arms.of(system, Plant(), model.substep, 100),
            doubt * NATURAL[:, None] * rng.normal(size=(STATE, STATE)),
        )

    @property
    def stages(self) -> int:
        return len(self.goal.references)

    def start(self) -> Floats:
        """Commands (H, N, 6) that leave the EPMs where they are."""
        return np.repeat(self.before[None], self.stages, axis=0)

    def scratch(self) -> Scratch:
        return Scratch.of(self.stages, len(self.before), len(self.goal.marks))

    def plan(
        self, commands: Floats, iterations: int = 40, enough: float = 1e-12, scratch: Scratch | None = None
    ) -> float:
        """Improve commands in place; return their cost."""
        motion, kept = Course.of(len(self.before), SUBSTEPS, False), (self.state.copy(), self.before.copy())
        cost, taken = plan(
            self.model, self.state, PUSH, self.doubt, self.goal, self.arms, motion, self.before, enough, iterations,
            scratch or self.scratch(), commands,
        )  # fmt: skip
        assert 0 <= taken <= iterations
        np.testing.assert_array_equal(self.state, kept[0])
        np.testing.assert_array_equal(self.before, kept[1])
        return cost

    def residuals(self, commands: Floats) -> Floats:
        """Errors, ways from home and crowding of all commands, the doubt apart."""
        state, parts = self.state, []
        for stage, command in enumerate(commands):
            goal = self.goal._replace(references=self.goal.references[stage:])
            state, errors, _ = foreseen(self.model, state, PUSH, held(command, SUBSTEPS), goal)
            parts += [errors, *self.besides(stage, command)]
        return np.concatenate(parts)

    def besides(self, stage: int, command: Floats) -> list[Floats]:
        """What a command's way from home costs, and that EPMs come near each other."""
        away = self.goal.pull * PER * (command - self.goal.home[stage])
        pairs = [(k, i) for k in range(len(command)) for i in range(k)]
        distances = np.array([np.linalg.norm(command[k, :3] - command[i, :3]) for k, i in pairs])
        short = np.maximum(self.arms.limits.gap + 0.03 - distances, 0.0)
        return [away.ravel(), self.goal.room / 0.01 * short]

    def cost(self, commands: Floats) -> float:
        return float(np.sum(self.residuals(commands) ** 2))

    def best(self, base: Floats) -> float:
        """Least cost that SciPy finds for a single command from ``base`` (N, 6), the least gap left aside."""
        radii = np.linalg.norm(base[:, :3], axis=1)
        low, high = np.full((len(base), 5), -2.0), np.full((len(base), 5), 2.0)
        low[:, 2], high[:, 2] = self.arms.limits.r_min - radii - 1e-9, self.arms.limits.r_max - radii + 1e-9
        found = least_squares(
            lambda x: self.residuals(shifted(base, x, self.arms.limits.r_min, self.arms.limits.r_max)[None]),
            np.zeros(5 * len(base)),
            bounds=(low.ravel(), high.ravel()),
            x_scale=np.tile([0.03, 0.03, 0.01, 0.03, 0.03], len(base)),
            ftol=1e-8,
            xtol=1e-8,
        )
        return float(2.0 * found.cost)


def joint(s: Scratch) -> tuple[Floats, Floats]:
    """Residuals of all commands and their derivatives by all steps of the commands, as one least-squares problem."""
    stages, u = s.gains.shape[:2]
    steps, state = np.zeros((stages + 1, u, stages * u)), np.zeros((STATE, stages * u))
    rows = []
    for k in range(stages):
        steps[k + 1, :, u * k : u * k + u] = np.eye(u)
        z = np.concatenate([steps[k], state, steps[k + 1]])
        rows.append(s.jacobians[k] @ z)
        state = s.by[k] @ z
    return s.residuals.ravel(), np.concatenate(rows)
