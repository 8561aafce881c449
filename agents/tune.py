"""Find the best gains of the PID on training trajectories: ``python -m agents.tune``.

Differential evolution over the logarithms of the gains, on the first episodes of the ``random`` family, which the
evaluated scenarios are held out of. The result stands in ``agents.baseline.TUNED_GAINS``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, differential_evolution

from agents.baseline import Baseline
from agents.metrics import measure
from agents.pid import Gains
from agents.rollout import run

# Lower and upper bound of each gain, SI units; the bottom of an integral or derivative gain is as good as none.
BOUNDS = {
    "force_p": (0.01, 2.0),
    "force_i": (1e-4, 1.0),
    "force_d": (1e-4, 0.5),
    "torque_p": (1e-6, 3e-3),
    "torque_i": (1e-8, 1e-3),
    "torque_d": (1e-8, 1e-4),
}
LOSS_PENALTY = 100.0
POSITION_UNIT_MM, HEADING_UNIT_DEG = 1.0, 2.0


@dataclass(frozen=True)
class TuneConfig:
    """Optimise the PID's gains on training trajectories."""

    episodes: int = 12
    """Training episodes per candidate, of seeds 1000, 1001, ..."""
    generations: int = 15
    """Generations of the differential evolution."""
    population: int = 4
    """Candidates per gain."""
    seed: int = 0
    """Of the search."""
    workers: int = 2
    """Processes."""
    control_hz: float = 2.0
    """Control rate."""


def gains_of(logarithms: NDArray[np.float64]) -> Gains:
    """Return the gains with these natural logarithms, in the order of ``BOUNDS``."""
    return Gains(**{name: float(np.exp(value)) for name, value in zip(BOUNDS, logarithms, strict=True)})


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
    config = tyro.cli(TuneConfig, description=TuneConfig.__doc__)

    def tell(intermediate_result: OptimizeResult) -> None:
        print(f"cost {intermediate_result.fun:.3f}  {gains_of(intermediate_result.x)}", flush=True)

    search: Any = differential_evolution
    search(
        cost,
        [tuple(np.log(bounds)) for bounds in BOUNDS.values()],
        args=(config.episodes, config.control_hz),
        maxiter=config.generations,
        popsize=config.population,
        rng=config.seed,
        workers=config.workers,
        updating="deferred",
        polish=False,
        init="sobol",
        callback=tell,
    )


if __name__ == "__main__":
    main()
