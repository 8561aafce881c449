"""Hand-made records, whose statistics are known without a simulation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from agents.records import Record
from magenv.poses import home_pose
from magenv.trajectories import shaped

STEPS = 40


def a_record(held_steps: int = STEPS, error_m: float = 1e-3, **changes: Any) -> Record:
    """Return an episode of 40 holds on approach-30 at 2 Hz, in which control is lost after ``held_steps`` of them.

    Robot 1 is ``error_m`` beside its reference in x, robot 2 on it; both are turned by 2 ``error_m`` (rad per m).
    """
    trajectory = shaped("approach", 0.03)
    reference = np.stack([trajectory.at(time) for time in np.linspace(30.0, 70.0, STEPS + 1)])
    robots = reference[: held_steps + 1].copy()
    robots[:, 0, 0] += error_m
    robots[:, :, 2] += 2 * error_m
    apart = np.hypot(*(robots[:, 1, :2] - robots[:, 0, :2]).T)
    lost = held_steps < STEPS
    record = Record(
        controller="baseline",
        scenario="approach-30",
        plant="paper",
        n_epm=2,
        control_hz=2.0,
        action="pose",
        seed=0,
        success=not lost,
        loss="deviation" if lost else "none",
        loss_time_s=0.5 * held_steps if lost else None,
        separation_tracked_m=float(apart[-1]),
        time_s=0.5 * np.arange(held_steps + 1),
        robots=robots,
        epm_pose=np.tile(home_pose(2), (held_steps + 1, 1)),
        reference=reference,
        position_error_m=np.full(held_steps, 0.5 * error_m),
        heading_error_rad=np.full(held_steps, 2 * error_m),
        position_error_end_m=np.full(held_steps, 0.5 * error_m),
        heading_error_end_rad=np.full(held_steps, 2 * error_m),
        separation_min_m=apart[1:],
        substeps=np.full(held_steps, 100),
        projected=np.zeros(held_steps, np.bool_),
        solver=np.ones(held_steps, np.int64),
        step_ms=np.full(held_steps, 2.0),
    )
    return replace(record, **changes)
