"""Climb down the ladder with several controllers, keep what is done, and go on after a break."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from agents.comparison import check, episode_bar
from agents.controller import Controller
from agents.figures import png
from agents.ladder import LADDER_MM, TABLE, Ladder, Rung, climb
from agents.ladder_figures import draw, tables
from agents.results import Results, run_and_tell
from magenv.files import check_output_dir, write_file
from magenv.params import is_whole, require


def run_ladder(controllers: Sequence[Controller], ladder: Ladder, jobs: int, out: Path, command: str) -> None:
    """Climb down with every controller; write ``ladder.json``, ``episodes.csv`` and ``ladder.png``, print a table.

    Both tables are written anew with every rung. What ``out`` holds of the same ladder is not run again (see
    ``results.Results``). Ctrl-C ends the climb; what has been measured until then is told, and the interruption raised
    again.

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
    results = Results(TABLE, controllers, ladder, out, command, lambda rung: -rung.separation_mm)

    def tell() -> None:
        rungs = results.entries()
        if rungs:
            write_file(out / "ladder.png", png(draw(rungs)))
            print(tables(rungs))
            print(f"\nFigure: {out / 'ladder.png'}")

    run_and_tell(lambda: _climb_all(controllers, ladder, jobs, results), tell)


def _climb_all(controllers: Sequence[Controller], ladder: Ladder, jobs: int, results: Results[Rung]) -> None:
    """Climb down with one controller after another, with a progress bar over the episodes that may still come."""
    with episode_bar() as bar:
        total = len(controllers) * len(LADDER_MM) * ladder.episodes
        task = bar.add_task("", total=total, completed=len(results.entries()) * ladder.episodes)
        for controller in controllers:
            bar.update(task, description=controller.name)
            known = {rung.separation_mm: rung for rung in results.of(controller.name)}
            rungs = climb(controller, ladder, jobs, known, results.keep, lambda _: bar.advance(task))
            total -= (len(LADDER_MM) - len(rungs)) * ladder.episodes
            bar.update(task, total=total)
