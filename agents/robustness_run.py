"""Run the robustness sweep with several controllers, keep what is done, and go on after a break."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from agents.comparison import check, episode_bar
from agents.controller import Controller
from agents.figures import png
from agents.results import Results, run_and_tell
from agents.robustness import TABLE, Row, Sweep, scores, sweep_over
from agents.robustness_figures import draw, print_scores
from magenv.files import check_output_dir, write_file
from magenv.params import is_whole, require


def run_robustness(controllers: Sequence[Controller], sweep: Sweep, jobs: int, out: Path, command: str) -> None:
    """Run every controller on every plant; write ``robustness.json``, ``episodes.csv``, figures, and print a table.

    Both tables are written anew with every row. What ``out`` holds of the same sweep is not run again (see
    ``results.Results``). Ctrl-C ends the sweep; what has been measured until then is told, and the interruption raised
    again.

    Parameters
    ----------
    controllers : sequence of Controller
        Made for the sweep's plant; as the catalogue knows them by name, where ``jobs`` is over 1.
    sweep : Sweep
        What all rows have in common.
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
    check(controllers, sweep.scenarios, sweep.plant, sweep.n_epm, sweep.control_hz, sweep.episodes, sweep.seed)
    require(is_whole(jobs) and jobs >= 1, "jobs", "a whole number of at least 1", jobs)
    check_output_dir(out)
    points = [(scenario, *point[:2]) for scenario in sweep.scenarios for point in sweep.points()]
    results = Results(
        TABLE,
        controllers,
        sweep,
        out,
        command,
        lambda row: points.index(row.point),
        lambda rows: {"scores": [asdict(score) for score in scores(rows, sweep)]},
    )

    def tell() -> None:
        rows = results.entries()
        for scenario in dict.fromkeys(row.scenario for row in rows):
            write_file(out / f"robustness-{scenario}.png", png(draw(rows, sweep, scenario)))
        if rows:
            print_scores(scores(rows, sweep), sweep)
            print(f"Figures: {out / 'robustness-*.png'}")

    run_and_tell(lambda: _run_all(controllers, sweep, jobs, results), tell)


def _run_all(controllers: Sequence[Controller], sweep: Sweep, jobs: int, results: Results[Row]) -> None:
    """Run one controller after another, with a progress bar over the episodes to come."""
    with episode_bar() as bar:
        rows = len(sweep.points()) * len(sweep.scenarios)
        total = len(controllers) * rows * sweep.episodes
        task = bar.add_task("", total=total, completed=len(results.entries()) * sweep.episodes)
        for controller in controllers:
            bar.update(task, description=controller.name)
            known = results.of(controller.name)
            sweep_over(controller, sweep, jobs, known, results.keep, lambda _: bar.advance(task))
