"""The controllers that are written down and not learned, by name."""

from __future__ import annotations

from agents.baseline import Baseline, paper_baseline, tuned_baseline
from agents.controller import Controller, Idle, Random
from agents.homing import Homing
from agents.predictive import Predictive
from agents.steered import Steered
from magenv.params import require

CLASSICAL: dict[str, type[Baseline | Predictive | Steered | Idle | Random]] = {
    "baseline": Baseline,
    "tuned": Baseline,
    "predictive": Predictive,
    "predictive-robust": Predictive,
    "predictive-home": Homing,
    "steered": Steered,
    "idle": Idle,
    "random": Random,
}
"""Of which kind each is."""

_DOUBT = 0.05
"""Of ``predictive-robust``: share by which its parameters may be off."""


def classical(name: str, n_epm: int = 2, control_hz: float = 2.0, plant: str = "paper") -> Controller:
    """Return the classical controller of this name, for a number of EPMs and a control rate.

    ``plant`` names the kind of plant acted on, of which ``predictive`` takes its nominal parameters;
    ``predictive-robust`` does so, and doubts them.

    Raises
    ------
    ValueError
        If there is none of this name.
    """
    match name:
        case "baseline":
            return paper_baseline(n_epm, control_hz)
        case "tuned":
            return tuned_baseline(n_epm, control_hz)
        case "predictive":
            return Predictive(n_epm, control_hz, plant)
        case "predictive-robust":
            return Predictive(n_epm, control_hz, plant, name, doubt=_DOUBT)
        case "predictive-home":
            return Homing(n_epm, control_hz, plant)
        case "steered":
            return Steered(control_hz)
        case "idle":
            return Idle(n_epm)
    require(name == "random", "controller", f"one of {', '.join(CLASSICAL)}", name)
    return Random(n_epm)
