"""What the study keeps: a small file per trained agent, ``<name>/seed-<k>.json``, or controller, ``controller.json``.

It holds the scalars of every episode, and of a training how it went; nothing of it needs the simulation again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from agents.metrics import measure
from agents.records import Record
from agents.results import KINDS
from magenv.files import write_file
from magenv.params import InputError, require

FORMAT = "magenv study 1"
CURVE_POINTS = 60
_DIGITS = 5


@dataclass(frozen=True)
class Where:
    """An environment, apart from its scenario."""

    plant: str = "paper"
    n_epm: int = 2
    control_hz: float = 2.0

    @property
    def told(self) -> tuple[str, str, str]:
        """Its parts as texts."""
        return self.plant, f"{self.n_epm}-epms", f"{self.control_hz:g}hz"


USUAL = Where()
"""In which agents and controllers are measured if nothing else is said."""


@dataclass(frozen=True)
class Outcomes:
    """Episodes of one scenario, of seeds ``seed``, ``seed + 1``, ...; each tuple holds one value per episode."""

    seed: int
    success: tuple[bool, ...]
    position_error_mm: tuple[float, ...]
    """Until the end or the loss of control, as in ``metrics.Episode``; so are the others."""
    heading_error_deg: tuple[float, ...]
    min_separation_mm: tuple[float, ...]
    loss_of_control_s: tuple[float | None, ...]
    """None where control was kept."""


@dataclass(frozen=True)
class Curve:
    """How a training went: at some of its steps, means over its last episodes."""

    steps: tuple[int, ...]
    seconds: tuple[float, ...]
    """Wall-clock time in training until then."""
    success_rate: tuple[float, ...]
    position_error_mm: tuple[float, ...]
    heading_error_deg: tuple[float, ...]


@dataclass(frozen=True)
class Made:
    """A training that was done."""

    seed: int
    config: dict[str, Any]
    """As ``trainings.as_told``."""
    command: str
    steps: int
    seconds: float
    """Wall-clock time of all its steps but the last update."""
    versions: dict[str, str]
    """Of the packages that trained it."""
    origins: tuple[str, ...]
    """Commits and machines on which it was begun and gone on with; none where that is not known."""
    curve: Curve


@dataclass(frozen=True)
class Entry:
    """One agent or controller, measured."""

    name: str
    plant: str
    n_epm: int
    control_hz: float
    action: str
    outcomes: dict[str, Outcomes]
    """By scenario."""
    versions: dict[str, str]
    """Of the packages that measured it."""
    commit: str
    """Of the program that measured it."""
    machine: str
    training: Made | None
    """None of a controller."""

    @property
    def file(self) -> Path:
        """Where it is kept, below the store."""
        return (
            controller_file(self.name, self.where) if self.training is None else file_of(self.name, self.training.seed)
        )

    @property
    def where(self) -> Where:
        """In which environment it was measured."""
        return Where(self.plant, self.n_epm, self.control_hz)


def file_of(name: str, seed: int) -> Path:
    """Return where an agent of a seed is kept below the store."""
    return Path(name) / f"seed-{seed}.json"


def controller_file(name: str, where: Where) -> Path:
    """Return where a controller is kept below the store."""
    return Path(name) / ("controller.json" if where == USUAL else f"controller-{'-'.join(where.told)}.json")


def outcomes_of(records: Sequence[Record]) -> Outcomes:
    """Return what is kept of the episodes of one scenario."""
    episodes = [measure(record) for record in records]
    return Outcomes(
        seed=episodes[0].seed,
        success=tuple(episode.success for episode in episodes),
        position_error_mm=tuple(short(episode.position_error_mm) for episode in episodes),
        heading_error_deg=tuple(short(episode.heading_error_deg) for episode in episodes),
        min_separation_mm=tuple(short(episode.min_separation_mm) for episode in episodes),
        loss_of_control_s=tuple(
            None if episode.loss_of_control_s is None else short(episode.loss_of_control_s) for episode in episodes
        ),
    )


def short(value: float) -> float:
    """Return a number to five significant digits."""
    return float(f"{value:.{_DIGITS}g}")


def save(entry: Entry, store: Path) -> Path:
    """Write an entry to its place below the store and return the file."""
    path = store / entry.file
    content = {"format": FORMAT} | asdict(entry)
    parts: list[tuple[str, Any]] = []
    for key, value in content.items():
        if key == "outcomes":
            lines = ",\n".join(f"  {_compact(name)}: {_compact(told)}" for name, told in value.items())
            parts.append((key, f"{{\n{lines}\n }}"))
        else:
            parts.append((key, _compact(value)))
    text = "{\n" + ",\n".join(f' "{key}": {value}' for key, value in parts) + "\n}\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, text.encode())
    return path


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def load(path: Path) -> Entry:
    """Read an entry.

    Raises
    ------
    ValueError
        If there is no such file, it is damaged, of another format, or in the place of another entry.
    """
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
        told = raw.pop("format", None)
        require(told == FORMAT, "format", repr(FORMAT), told)
        entry = _entry(raw)
        require(path.parts[-2:] == entry.file.parts, "place", str(entry.file), str(Path(*path.parts[-2:])))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"Input record must be a whole file of the study ({FORMAT!r}); instead received {str(path)!r} ({reason})."
        ) from error
    return entry


def load_all(store: Path) -> list[Entry]:
    """Read all entries below a store, in the order of their paths; the errors are those of ``load``."""
    found = sorted(path for path in store.glob("*/*.json") if path.is_file())
    require(len(found) > 0, "store", "a folder with records of the study", str(store))
    return [load(path) for path in found]


T = TypeVar("T")


def _entry(raw: dict[str, Any]) -> Entry:
    """Return an entry from what JSON makes of it; raises where it is none."""
    require(isinstance(raw.get("outcomes"), dict) and len(raw["outcomes"]) > 0, "outcomes", "of scenarios", "none")
    outcomes = {name: _whole(Outcomes, value) for name, value in raw["outcomes"].items()}
    for of_scenario in outcomes.values():
        errors = (*of_scenario.position_error_mm, *of_scenario.heading_error_deg)
        require(min(errors) >= 0.0, "outcomes", "of errors of at least 0", min(errors))
        lost = tuple(time is not None for time in of_scenario.loss_of_control_s)
        fits = all(kept != gone for kept, gone in zip(of_scenario.success, lost, strict=True))
        require(fits, "outcomes", "of episodes that are lost at a time, or succeed", "others")
    made = raw["training"]
    if made is not None:
        made = _read(Made, made | {"curve": _whole(Curve, made["curve"])})
    return _read(Entry, raw | {"outcomes": outcomes, "training": made})


def _whole(kind: type[T], raw: dict[str, Any]) -> T:
    """Return a table, whose columns must be equally long."""
    table = _read(kind, raw)
    lengths = {len(column) for column in vars(table).values() if isinstance(column, tuple)}
    require(
        len(lengths) == 1 and lengths != {0}, kind.__name__.lower(), "of equally many values, one at least", lengths
    )
    return table


def _read(kind: type[T], raw: dict[str, Any]) -> T:
    """Return a dataclass from its fields, each of its type."""
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    require(set(raw) == set(known), kind.__name__.lower(), f"of the fields {', '.join(known)}", ", ".join(raw))
    values = {field.name: _value(field.name, str(field.type), raw[field.name]) for field in fields(kind)}  # type: ignore[arg-type]
    return kind(**values)


def _value(name: str, kind: str, value: Any) -> Any:
    """Return a value as the type of its field has it, or raise ``InputError``."""
    if kind.startswith("tuple["):
        require(isinstance(value, list), name, "a list", type(value).__name__)
        of_one = kind.removeprefix("tuple[").removesuffix(", ...]")
        return tuple(_value(name, of_one, one) for one in value)
    if kind == "dict[str, str]":
        fits = isinstance(value, Mapping) and all(isinstance(one, str) for one in value.values())
        require(fits, name, "a table of texts", value)
    elif kind in KINDS:
        fits = isinstance(value, KINDS[kind]) and isinstance(value, bool) == (kind == "bool")
        require(fits and (not isinstance(value, float) or math.isfinite(value)), name, f"of type {kind}", value)
    return value
