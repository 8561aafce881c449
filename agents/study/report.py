"""The page of results: ``results.md`` and its figures, from the records of the study alone; the same give the same."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from agents import ladder_figures
from agents.figures import png
from agents.ladder import load as load_ladder
from agents.report import drop_others
from agents.study import figures, tables
from agents.study.entries import USUAL
from agents.study.evidence import Measured, beside, collect, groups, scenarios_of
from agents.study.trainings import MAIN, SCENARIOS
from magenv.files import check_output_dir, write_file

_HEAD = """\
# Results of learned agents

Made by `python -m agents.study report` from the records that `run`, `evaluate` and `controllers` keep; no number here \
is typed. `python -m agents.study list` tells the trainings."""
_MEANING = """\
All meet the same episodes: {episodes}. A value is the median over the seeds of the training, in brackets the least \
and the greatest; controllers have no seeds. Errors are means over both robots and all substeps."""
_AGGREGATES = """\
Interquartile mean (IQM) over seeds and scenarios of the mean error of all episodes, each until its end or its loss of \
control: a controller that is lost early errs little until then, so read it beside the success. Intervals: 95 % \
bootstrap, percentile method. *Per scenario*: seeds are resampled within each scenario, as in Agarwal et al. 2021. \
*Whole seeds*: a seed's scenarios are resampled together; the same network acts in all of them, and so this is the \
interval to go by where it is wider."""
_PROFILES = """\
The share of episodes that are held with an error below a threshold. Lost episodes are below none: the height at the \
right is the success."""
_IMPROVEMENT = """\
The chance that an agent errs less in position than a controller on the same episode, mean over episodes and seeds; \
lost episodes are the worst, and if both are lost it counts half. In brackets the 95 % bootstrap interval over whole \
seeds. 0.5 means that neither is better. Ablations are left out."""
_TIMES = "Steps and minutes are those of the training without its measurement, on cores that others may have shared."
_CURVES = """\
Success and errors in training, means over its last 200 episodes, which are drawn from the scenario trained on, \
explored with noise and counted until their end or loss: they are not the errors of the tables. Only lost ones are so \
short that they end in the first 200 steps of all environments side by side, and so it is where a training was broken \
off and gone on with. Lines are medians over \
the seeds, bands reach from the least to the greatest. Times are those of the machines below."""


def write_results(store: Path, out: Path, ladders: Sequence[Path] = ()) -> Path:
    """Write ``results.md`` and its figures ``results-*.png``; return the page's path.

    Parameters
    ----------
    store : Path
        Folder of the records.
    out : Path
        Folder of the page; made if missing. Figures of an earlier page that this one has not are removed.
    ladders : sequence of Path
        Files ``ladder.json`` of ``evaluate.py --ladder``.

    Raises
    ------
    ValueError
        If records or ladders are unsound, or ``out`` cannot be written; nothing is written then.
    """
    measured = collect(store)
    climbs = [load_ladder(path) for path in ladders]
    rungs = [rung for _, climbed in climbs for rung in climbed]
    check_output_dir(out)
    scenarios = [scenario for scenario in scenarios_of(measured) if scenario in SCENARIOS] or scenarios_of(measured)
    controllers = [one for one in measured if one.training is None and one.where == USUAL]
    main = [*controllers, *beside(measured, MAIN)]
    pictures: dict[str, Figure] = {}

    def picture(name: str, title: str, figure: Figure) -> list[str]:
        pictures[f"results-{name}.png"] = figure
        return ["", f"![{title}](results-{name}.png)"]

    page = [_HEAD, "", _MEANING.format(episodes=_episodes(measured, scenarios))]
    if main:
        page += ["", "## Agents and controllers"]
        page += picture("overview", "Success and errors on each scenario", figures.overview(main, scenarios))
        page += ["", *tables.by_scenario(main, scenarios)]
    page += ["", "## Over all scenarios", "", _AGGREGATES, "", *tables.aggregates(measured, scenarios)]
    if main:
        page += ["", "## How exact", "", _PROFILES]
        page += picture("profiles", "Share of episodes below an error", figures.profiles(main, scenarios))
        by_scenario = figures.profiles_by_scenario(main, scenarios)
        page += picture("profiles-scenarios", "Share of episodes below an error, by scenario", by_scenario)
    if controllers and len(controllers) < len(measured):
        page += ["", "## Agents against controllers", "", _IMPROVEMENT, "", *tables.improvements(measured, scenarios)]
    if any(one.training is not None for one in measured):
        page += ["", "## Trainings", "", *tables.meanings(measured)]
    trained = beside(measured, MAIN)
    if trained:
        page += ["", _CURVES, *picture("curves", "Success and errors in training", figures.curves(trained, MAIN))]
    for group in groups(measured):
        compared = beside(measured, group)
        agents = [one for one in compared if one.training is not None]
        page += ["", f"## {group[0].upper()}{group[1:]}", "", *tables.by_scenario(compared, scenarios_of(compared))]
        name = f"curves-{re.sub(r'[^a-z0-9]+', '-', group.lower())}"
        page += picture(name, f"Success and errors in training, {group}", figures.curves(agents, group))
    if rungs:
        page += ["", "## How close", "", *picture("ladder", "Success over separation", ladder_figures.draw(rungs))]
        page += ["", ladder_figures.tables(rungs), "", *(f"- `{told['command']}`" for told, _ in climbs)]
    page += ["", "## Where the records come from", "", *_provenance(measured)]
    for name, figure in pictures.items():
        write_file(out / name, png(figure))
    drop_others(out, ["results-*.png"], list(pictures))
    write_file(out / "results.md", ("\n".join(page) + "\n").encode())
    return out / "results.md"


def _episodes(measured: Sequence[Measured], scenarios: Sequence[str]) -> str:
    """Return in words which episodes were run."""
    told = {}
    for one in measured:
        for scenario, outcomes in one.entries[0].outcomes.items():
            told[scenario] = f"{len(outcomes.success)} from seed {outcomes.seed}"
    alike = set(told.values())
    if len(alike) == 1:
        return f"{alike.pop()} of each scenario"
    return ", ".join(f"{told[scenario]} of {scenario}" for scenario in scenarios)


def _provenance(measured: Sequence[Measured]) -> list[str]:
    """Return where all records come from, and how each was made."""
    lines = []
    for found, what, alike in (
        (tables.places(measured), "Commits and machines", "All was trained and measured by one commit on one machine"),
        (tables.packages(measured), "Packages", "All was made with the same packages"),
    ):
        lines += [f"{alike}:" if len(found) == 1 else f"{what} differ among the records:", ""]
        lines += [*(f"{number}. {one}" for number, one in enumerate(found, 1)), ""]
    return [*lines, _TIMES, "", *tables.provenance(measured)]
