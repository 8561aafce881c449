"""Find the best gains of the PID on training trajectories: ``python -m agents.tune``.

Nelder-Mead over the logarithms of the gains, on the first episodes of the ``random`` family, which the evaluated
scenarios are held out of. The result stands in ``agents.baseline.TUNED_GAINS``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from agents.baseline import Baseline
from agents.metrics import measure
from agents.pid import Gains
from agents.rollout import run
from magenv.command import friendly, parse
from magenv.params import require

START = Gains(force_p=0.1, force_i=0.005, force_d=0.01, torque_p=6e-5, torque_i=1e-6, torque_d=1e-6)
"""Where the search begins: each loop takes a good part of its error away in one hold."""
LOSS_PENALTY = 100.0
POSITION_UNIT_MM, HEADING_UNIT_DEG = 1.0, 2.0


@dataclass(frozen=True)
class TuneConfig:
    """Optimise the PID's gains on training trajectories."""

    episodes: int = 12
    """Training episodes per candidate, of seeds 1000, 1001, ..."""
    candidates: int = 150
    """Candidates tried."""
    control_hz: float = 2.0
    """Control rate."""

    def __post_init__(self) -> None:
        for name, value in (("episodes", self.episodes), ("candidates", self.candidates)):
            require(value >= 1, name, "at least 1", value)


def gains_of(logarithms: NDArray[np.float64]) -> Gains:
    """Return the gains with these natural logarithms, in the order of ``Gains``."""
    return Gains(*(float(np.exp(value)) for value in logarithms))


def cost(logarithms: NDArray[np.float64], episodes: int, control_hz: float) -> float:
    """Return the mean over the training episodes of error in units, and of a penalty for the time after a loss."""
    controller = Baseline("candidate", gains_of(logarithms), warm_start=True, control_hz=control_hz)
    total = 0.0
    for record in run(controller, "random", control_hz=control_hz, episodes=episodes, seed=1000):
        episode = measure(record)
        total += episode.position_error_mm / POSITION_UNIT_MM + episode.heading_error_deg / HEADING_UNIT_DEG
        if record.loss_time_s is not None:
            total += LOSS_PENALTY * (2 - record.loss_time_s / 100)
    return total / episodes


def main() -> None:
    """Search and print."""
    config = parse(TuneConfig)

    best = np.inf

    def told(logarithms: NDArray[np.float64]) -> float:
        nonlocal best
        value = cost(logarithms, config.episodes, config.control_hz)
        if value < best:
            best = value
            print(f"cost {value:.3f}  {gains_of(logarithms)}", flush=True)
        return value

    start = np.log(list(vars(START).values()))
    corners = np.vstack([start, start + np.log(3.0) * np.eye(len(start))])
    minimize(told, start, method="Nelder-Mead", options={"maxfev": config.candidates, "initial_simplex": corners})


if __name__ == "__main__":
    friendly(main)
