"""Climb down the ladder with several controllers, keep what is done, and go on after a break."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from agents.comparison import check, episode_bar
from agents.controller import Controller
from agents.figures import png
from agents.ladder import FILE, LADDER_MM, Ladder, Rung, climb, load
from agents.ladder_figures import draw, tables
from agents.metrics import Episode, measure
from agents.records import Record
from agents.report import as_csv, versions
from agents.store import CARD
from magenv.files import check_output_dir, digest_of, write_file
from magenv.params import InputError, is_whole, require

_PACKAGES = ("agents", "magenv")
_ROOT = Path(__file__).parents[1]


def run_ladder(controllers: Sequence[Controller], ladder: Ladder, jobs: int, out: Path, command: str) -> None:
    """Climb down with every controller; write ``ladder.json``, ``episodes.csv`` and ``ladder.png``, print a table.

    Both tables are written anew with every rung. What ``out`` holds of the same ladder, made with the same sources and
    packages by one of the same controllers, is not run again; everything else there is replaced. Ctrl-C ends the climb;
    what has been measured until then is told, and the interruption raised again.

    Parameters
    ----------
    controllers : sequence of Controller
        As the catalogue knows them by name, where ``jobs`` is over 1.
    ladder : Ladder
        What all rungs have in common.
    jobs : int
        Processes.
    out : Path
        Folder of the results; made if missing.
    command : str
        The command line, for the file.

    Raises
    ------
    ValueError
        If an argument is unsound or ``out`` cannot be written; nothing has run then.
    """
    scenarios = [ladder.scenario(separation_mm) for separation_mm in LADDER_MM]
    check(controllers, scenarios, ladder.plant, ladder.n_epm, ladder.control_hz, ladder.episodes, ladder.seed)
    require(is_whole(jobs) and jobs >= 1, "jobs", "a whole number of at least 1", jobs)
    check_output_dir(out)
    results = _Results(controllers, ladder, out, command)
    interrupted: KeyboardInterrupt | None = None
    try:
        _climb_all(controllers, ladder, jobs, results)
    except KeyboardInterrupt as interruption:
        interrupted = interruption
    rungs = results.rungs()
    if rungs:
        write_file(out / "ladder.png", png(draw(rungs)))
        print(tables(rungs))
        print(f"\nFigure: {out / 'ladder.png'}")
    if interrupted is not None:
        raise interrupted


class _Results:
    """The rungs and episodes that a folder holds."""

    def __init__(self, controllers: Sequence[Controller], ladder: Ladder, folder: Path, command: str) -> None:
        self._ladder, self._folder = ladder, folder
        models = {c.name: digest_of(Path(c.name)) if (Path(c.name) / CARD).is_file() else "" for c in controllers}
        sources = {f"sources of {name}": digest_of(_ROOT / name) for name in _PACKAGES}
        self._head: dict[str, Any] = {
            "command": command,
            "settings": asdict(ladder),
            "models": models,
            "versions": versions() | sources,
        }
        self._rungs: dict[tuple[str, float], Rung] = {}
        self._episodes: dict[tuple[str, float], list[dict[str, Any]]] = {}
        if (folder / FILE).exists():
            self._go_on()
            told = (
                f"{len(self._rungs)} rungs of this ladder" if self._rungs else "nothing of this ladder; it is replaced"
            )
            print(f"{folder / FILE} holds {told}", file=sys.stderr)

    def _go_on(self) -> None:
        """Take over what the folder holds of the same ladder, with all its episodes."""
        try:
            head, rungs = load(self._folder / FILE)
            with (self._folder / "episodes.csv").open(newline="", encoding="utf-8") as file:
                rows = [row for row in csv.DictReader(file, strict=True) if _is_episode(row)]
        except (InputError, OSError, UnicodeDecodeError, csv.Error):
            return
        models = head.get("models")
        alike = all(head.get(name) == self._head[name] for name in ("settings", "versions"))
        if not alike or not isinstance(models, dict):
            return
        for rung in rungs:
            of_rung = (rung.controller, self._ladder.scenario(rung.separation_mm))
            episodes = [row for row in rows if (row["controller"], row["scenario"]) == of_rung]
            wanted = self._head["models"].get(rung.controller)
            if wanted is not None and wanted == models.get(rung.controller) and len(episodes) == rung.episodes:
                self._rungs[rung.controller, rung.separation_mm] = rung
                self._episodes[rung.controller, rung.separation_mm] = episodes

    def of(self, controller: str) -> dict[float, Rung]:
        """Return a controller's rungs by separation (mm)."""
        return {separation_mm: rung for (name, separation_mm), rung in self._rungs.items() if name == controller}

    def rungs(self) -> list[Rung]:
        """Return all rungs: controllers in their order, each from the top."""
        return [self._rungs[key] for key in self._order()]

    def _order(self) -> list[tuple[str, float]]:
        names = list(self._head["models"])
        return sorted(self._rungs, key=lambda key: (names.index(key[0]), -key[1]))

    def keep(self, rung: Rung, records: list[Record]) -> None:
        """Add a rung and write the files anew; ``ladder.json`` last, which says what is done."""
        key = (rung.controller, rung.separation_mm)
        self._rungs[key], self._episodes[key] = rung, [asdict(measure(record)) for record in records]
        write_file(self._folder / "episodes.csv", as_csv(row for key in self._order() for row in self._episodes[key]))
        content = self._head | {"rungs": [asdict(rung) for rung in self.rungs()]}
        write_file(self._folder / FILE, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def _is_episode(row: dict[str, Any]) -> bool:
    """Return whether a row of a table has the columns of an episode, each with a value."""
    return list(row) == [field.name for field in fields(Episode)] and None not in row.values()


def _climb_all(controllers: Sequence[Controller], ladder: Ladder, jobs: int, results: _Results) -> None:
    """Climb down with one controller after another, with a progress bar over the episodes that may still come."""
    with episode_bar() as bar:
        total = len(controllers) * len(LADDER_MM) * ladder.episodes
        task = bar.add_task("", total=total, completed=len(results.rungs()) * ladder.episodes)
        for controller in controllers:
            bar.update(task, description=controller.name)
            known = results.of(controller.name)
            rungs = climb(controller, ladder, jobs, known, results.keep, lambda _: bar.advance(task))
            total -= (len(LADDER_MM) - len(rungs)) * ladder.episodes
            bar.update(task, total=total)
