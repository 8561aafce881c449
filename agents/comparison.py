"""Run controllers on the same episodes, then tell what came out: what both scripts end in."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from agents.controller import Controller
from agents.records import Record
from agents.report import file_name, print_table, write_report
from agents.rollout import run
from magenv.episodes import Episodes, Settings
from magenv.files import check_output_dir
from magenv.params import require

SEED_MAX = 2**32 - 1


def compare(
    controllers: Sequence[Controller],
    scenarios: Sequence[str],
    plant: str,
    n_epm: int,
    control_hz: float,
    episodes: int,
    seed: int,
    out: Path,
    command: str,
) -> None:
    """Run every controller on every scenario, print the table and write the report to ``out``.

    Ctrl-C stops the runs; what has been measured until then is reported, and the interruption raised again.

    Raises
    ------
    ValueError
        If an argument is unsound or ``out`` cannot be written; nothing has run then.
    """
    check(controllers, scenarios, plant, n_epm, control_hz, episodes, seed)
    check_output_dir(out)
    records: list[Record] = []
    interrupted: KeyboardInterrupt | None = None
    try:
        _run_all(controllers, scenarios, plant, n_epm, control_hz, episodes, seed, records)
    except KeyboardInterrupt as interruption:
        interrupted = interruption
    if records:
        rows = write_report(records, out, command)
        print_table(rows)
        print(f"Report: {out / 'report.md'}")
    if interrupted is not None:
        raise interrupted


def check(
    controllers: Sequence[Controller],
    scenarios: Sequence[str],
    plant: str,
    n_epm: int,
    control_hz: float,
    episodes: int,
    seed: int,
) -> None:
    """Raise ``ValueError`` unless these controllers can be compared so."""
    names = [controller.name for controller in controllers]
    distinct = len({file_name(name) for name in names}) == len(names)
    require(len(controllers) > 0 and distinct, "controllers", "one or more, each once, of distinct file names", names)
    require(
        len(scenarios) > 0 and len(set(scenarios)) == len(scenarios), "scenarios", "one or more, each once", scenarios
    )
    for scenario in scenarios:
        for c in controllers:
            Episodes(1, Settings(scenario, plant, n_epm, c.action, c.observation, c.frame, control_hz))
    require(episodes >= 1, "episodes", "at least 1", episodes)
    require(0 <= seed <= SEED_MAX, "seed", f"a whole number from 0 to {SEED_MAX}", seed)


def episode_bar() -> Progress:
    """Return a progress bar over episodes, with the time left."""
    return Progress(
        TextColumn("[bold]{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(file=sys.stderr),
        transient=True,
        speed_estimate_period=600.0,  # an episode may take a minute
    )


def _run_all(
    controllers: Sequence[Controller],
    scenarios: Sequence[str],
    plant: str,
    n_epm: int,
    control_hz: float,
    episodes: int,
    seed: int,
    records: list[Record],
) -> None:
    """Append the records of all episodes to ``records`` as they end, with a progress bar."""
    with episode_bar() as bar:
        task = bar.add_task("", total=len(controllers) * len(scenarios) * episodes)

        def keep(record: Record) -> None:
            records.append(record)
            bar.advance(task)

        for scenario in scenarios:
            for controller in controllers:
                bar.update(task, description=f"{controller.name} on {scenario}")
                run(controller, scenario, plant, n_epm, control_hz, episodes, seed, keep)
