"""The controllers that ``evaluate.py`` knows by name: classical ones and the agents that ship with the package."""

from __future__ import annotations

from pathlib import Path

from agents.baseline import paper_baseline, tuned_baseline
from agents.classical import CLASSICAL, classical
from agents.controller import Controller
from agents.learned import Learned
from agents.store import CARD
from magenv.params import InputError, require

_SHIPPED = Path(__file__).parent / "data"


def names() -> list[str]:
    """Return the known names, shipped agents last."""
    return [*CLASSICAL, *shipped()]


def shipped() -> list[str]:
    """Return the names of the agents that ship with the package."""
    return [folder.name for folder in sorted(_SHIPPED.glob("*")) if (folder / CARD).is_file()]


def defaults(n_epm: int, control_hz: float) -> tuple[list[Controller], list[str]]:
    """Return what is compared where no controllers are named, and which shipped agents do not fit the environment."""
    chosen: list[Controller] = [paper_baseline(n_epm, control_hz), tuned_baseline(n_epm, control_hz)]
    unfit = []
    for name in shipped():
        try:
            chosen.append(controller(name, n_epm, control_hz))
        except InputError as error:
            unfit.append(f"{name} ({error})")
    return chosen, unfit


def controller(name: str, n_epm: int = 2, control_hz: float = 2.0, plant: str = "paper") -> Controller:
    """Return the controller of this name, or the agent in this folder, for a number of EPMs and a control rate.

    ``plant`` names the kind of plant acted on, for controllers that know of it (see ``agents.classical``).

    Raises
    ------
    ValueError
        If neither is known, or an agent was made for something else.
    """
    if name in CLASSICAL:
        return classical(name, n_epm, control_hz, plant)
    known = name in names()
    require(
        known or (Path(name) / CARD).is_file(), "controller", f"one of {', '.join(names())} or a model's folder", name
    )
    agent = Learned(_SHIPPED / name, name) if known else Learned(Path(name), name)
    agent.check(n_epm, control_hz)
    return agent
