"""What a long run keeps in its folder as it goes: the entries of a table, and their episodes; and how it goes on."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import NoneType
from typing import Any, Generic, Protocol, TypeVar

from agents.controller import Controller
from agents.metrics import Episode, measure
from agents.records import Record
from agents.report import as_csv, versions
from agents.store import CARD
from magenv.files import digest_of, write_file
from magenv.params import InputError, require

_PACKAGES = ("agents", "magenv")
_ROOT = Path(__file__).parents[1]

KINDS: dict[str, tuple[type, ...]] = {
    "str": (str,),
    "int": (int,),
    "bool": (bool,),
    "float": (int, float),
    "float | None": (int, float, NoneType),
    "Interval": (list,),
}
"""The type of a field, as it stands in its class, and what JSON makes of it."""


class Entry(Protocol):
    """What an entry tells of its episodes."""

    @property
    def controller(self) -> str:
        """Name."""
        ...

    @property
    def scenario(self) -> str:
        """Name."""
        ...

    @property
    def plant(self) -> str:
        """Plant acted on."""
        ...

    @property
    def episodes(self) -> int:
        """How many."""
        ...


E = TypeVar("E", bound=Entry)


@dataclass(frozen=True)
class Table(Generic[E]):
    """A kind of table: the file ``<name>.json`` of ``evaluate.py --<name>``, with a list of entries."""

    name: str
    entries: str
    """Name of the list."""
    entry: type[E]
    """A dataclass."""

    @property
    def file(self) -> str:
        """Name of the file."""
        return f"{self.name}.json"

    def load(self, path: Path) -> tuple[dict[str, Any], list[E]]:
        """Read a file: all but its entries, and the entries in their order.

        Raises
        ------
        ValueError
            If there is no such file, or it is none of this kind.
        """
        try:
            file = json.loads(path.read_text(encoding="utf-8"))
            return file, [self._read(entry) for entry in file.pop(self.entries)]
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(
                f"Input {self.name} must be a folder with a {self.file} of evaluate.py --{self.name}; "
                f"instead received {str(path)!r}."
            ) from error

    def _read(self, entry: dict[str, Any]) -> E:
        """Return an entry from what JSON makes of it; raises where it is none."""
        values = {}
        for field in fields(self.entry):  # type: ignore[arg-type]
            value, kind = entry[field.name], str(field.type)
            fits = isinstance(value, KINDS[kind]) and isinstance(value, bool) == (kind == "bool")
            require(fits, field.name, f"of type {kind}", value)
            if kind == "Interval":
                low, high = map(float, value)
                value = low, high
            values[field.name] = value
        require(len(values) == len(entry), "entry", f"of {len(values)} values", len(entry))
        return self.entry(**values)


class Results(Generic[E]):
    """The entries and episodes that a folder holds of a run; what it holds already is taken over.

    That is what was made of the same settings, with the same sources and packages, by one of the same controllers, and
    has all its episodes; everything else there is replaced.

    Parameters
    ----------
    table : Table
        Of which kind.
    controllers : sequence of Controller
        Whose entries.
    settings
        A dataclass: what all entries have in common.
    folder : Path
        Of the results.
    command : str
        The command line, for the file.
    order : callable
        Returns what tells an entry from the others of its controller, in whose order they stand.
    summed_up : callable, optional
        Returns what else the file tells of all entries.
    """

    def __init__(
        self,
        table: Table[E],
        controllers: Sequence[Controller],
        settings: Any,
        folder: Path,
        command: str,
        order: Callable[[E], Any],
        summed_up: Callable[[list[E]], dict[str, Any]] | None = None,
    ) -> None:
        self._table, self._folder, self._order, self._summed_up = table, folder, order, summed_up
        models = {c.name: digest_of(Path(c.name)) if (Path(c.name) / CARD).is_file() else "" for c in controllers}
        sources = {f"sources of {name}": digest_of(_ROOT / name) for name in _PACKAGES}
        self._head: dict[str, Any] = {
            "command": command,
            "settings": json.loads(json.dumps(asdict(settings))),
            "models": models,
            "versions": versions() | sources,
        }
        self._entries: dict[tuple[str, Any], E] = {}
        self._episodes: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
        if (folder / table.file).exists():
            self._go_on()
            held = f"{len(self._entries)} {table.entries} of this {table.name}"
            told = held if self._entries else f"nothing of this {table.name}; it is replaced"
            print(f"{folder / table.file} holds {told}", file=sys.stderr)

    def _go_on(self) -> None:
        """Take over what the folder holds of the same run, with all its episodes."""
        try:
            head, entries = self._table.load(self._folder / self._table.file)
            with (self._folder / "episodes.csv").open(newline="", encoding="utf-8") as file:
                rows = [row for row in csv.DictReader(file, strict=True) if _is_episode(row)]
        except (InputError, OSError, UnicodeDecodeError, csv.Error):
            return
        models = head.get("models")
        alike = all(head.get(name) == self._head[name] for name in ("settings", "versions"))
        if not alike or not isinstance(models, dict):
            return
        for entry in entries:
            setting = _setting(entry)
            episodes = [row for row in rows if (row["controller"], row["scenario"], row["plant"]) == setting]
            wanted = self._head["models"].get(entry.controller)
            if wanted is not None and wanted == models.get(entry.controller) and len(episodes) == entry.episodes:
                self._entries[self._key(entry)], self._episodes[setting] = entry, episodes

    def _key(self, entry: E) -> tuple[str, Any]:
        return entry.controller, self._order(entry)

    def entries(self) -> list[E]:
        """Return all entries: controllers in their order, each one's in theirs."""
        names = list(self._head["models"])
        return [self._entries[key] for key in sorted(self._entries, key=lambda key: (names.index(key[0]), key[1]))]

    def of(self, controller: str) -> list[E]:
        """Return a controller's entries."""
        return [entry for entry in self.entries() if entry.controller == controller]

    def keep(self, entry: E, records: list[Record]) -> None:
        """Add an entry and its episodes, and write the files anew; the table last, which says what is done."""
        self._entries[self._key(entry)] = entry
        self._episodes[_setting(entry)] = [asdict(measure(record)) for record in records]
        entries = self.entries()
        settings = dict.fromkeys(map(_setting, entries))  # entries may share episodes
        write_file(
            self._folder / "episodes.csv", as_csv(row for setting in settings for row in self._episodes[setting])
        )
        content = self._head | (self._summed_up(entries) if self._summed_up else {})
        content[self._table.entries] = [asdict(entry) for entry in entries]  # type: ignore[call-overload]
        write_file(self._folder / self._table.file, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def _setting(entry: Entry) -> tuple[str, str, str]:
    return entry.controller, entry.scenario, entry.plant


def _is_episode(row: dict[str, Any]) -> bool:
    """Return whether a row of a table has the columns of an episode, each with a value."""
    return list(row) == [field.name for field in fields(Episode)] and None not in row.values()


def run_and_tell(work: Callable[[], None], tell: Callable[[], None]) -> None:
    """Do the work, then tell what came of it: also where Ctrl-C ends it, which is raised again afterwards."""
    interrupted: KeyboardInterrupt | None = None
    try:
        work()
    except KeyboardInterrupt as interruption:
        interrupted = interruption
    tell()
    if interrupted is not None:
        raise interrupted
