"""The page of results, from made-up records: its numbers are those of the records, whoever computes them."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from climbs import Climbed, Told
from messages import refusal
from PIL import Image
from studied import EPISODES, a_store, an_entry
from tiny_runs import files_of

from agents.catalogue import controller
from agents.configs import command_of
from agents.ladder import Ladder
from agents.ladder_run import run_ladder
from agents.report import three_digits
from agents.statistics import interval, probability_of_improvement
from agents.study import entries, report
from agents.study.entries import Entry, Outcomes
from agents.study.evidence import collect
from agents.study.figures import curves, profiles
from agents.study.trainings import MAIN, SCENARIOS, training

SEEDS = {"ppo-home": 3, "sac-home": 2, "ppo-pose": 2, "short-errors": 1}
CONTROLLERS = ("baseline", "tuned", "ppo")
LABELS = {"ppo": "ppo (as it ships)"}
Rows = dict[str, list[str]]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study")
    a_store(folder, SEEDS, CONTROLLERS)
    return folder


@pytest.fixture(scope="module")
def page(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report.write_results(store, tmp_path_factory.mktemp("page"))


def of(store: Path, name: str) -> list[Entry]:
    return [entry for entry in entries.load_all(store) if entry.name == name]


def tables(page: Path, title: str) -> list[Rows]:
    """Return the tables below a title, each row's cells by its first one."""
    text = page.read_text()
    section = re.split(r"^## ", text.partition(f"\n## {title}\n")[2], flags=re.MULTILINE)[0]
    blocks = re.findall(r"(?:^\|.*\n)+", section, flags=re.MULTILINE)
    found = []
    for block in blocks:
        rows = [[cell.strip() for cell in line.strip("|\n").split("|")] for line in block.splitlines()]
        found.append({row[0]: row[1:] for row in [*rows[:1], *rows[2:]]})
    return found


def told(values: list[float], number: str = "") -> str:
    texts = [number.format(v) if number else three_digits(v) for v in (np.median(values), min(values), max(values))]
    return texts[0] if len(values) == 1 else f"{texts[0]} ({texts[1]} to {texts[2]})"


def test_every_agent_and_controller_is_told_of(page: Path) -> None:
    names = [*(LABELS.get(name, name) for name in CONTROLLERS)]
    for table in tables(page, "Agents and controllers"):
        assert list(table) == ["", *names, "ppo-home", "sac-home"]
        assert table[""] == ["seeds", *SCENARIOS]
    (over_all,) = tables(page, "Over all scenarios")
    assert list(over_all) == ["", *names, *SEEDS]
    (against,) = tables(page, "Agents against controllers")
    main = [agent for agent in SEEDS if training(agent).group == MAIN]
    assert list(against) == ["", *(f"{agent} over {name}" for agent in main for name in names)]


@pytest.mark.parametrize("name", ["baseline", "ppo-home", "sac-home"])
def test_numbers_are_those_of_the_records(name: str, store: Path, page: Path) -> None:
    chosen = of(store, name)
    success, position, heading, separation = tables(page, "Agents and controllers")
    for column, scenario in enumerate(SCENARIOS, 1):
        outcomes = [entry.outcomes[scenario] for entry in chosen]
        assert success[name][column] == told([100 * np.mean(o.success) for o in outcomes], "{:.0f}")
        for table, errors in ((position, "position_error_mm"), (heading, "heading_error_deg")):
            means = [np.mean([e for e, held in zip(getattr(o, errors), o.success) if held]) for o in outcomes]  # noqa: B905
            assert table[name][column] == told([float(mean) for mean in means])
        assert separation[name][column] == told([float(np.median(o.min_separation_mm)) for o in outcomes])


def test_aggregates_are_interquartile_means_over_seeds_and_scenarios(store: Path, page: Path) -> None:
    scores = np.array(
        [[np.mean(entry.outcomes[s].position_error_mm) for s in SCENARIOS] for entry in of(store, "ppo-home")]
    )
    middle = np.sort(scores.ravel())[5:-5]  # 21 scores
    (table,) = tables(page, "Over all scenarios")
    assert table["ppo-home"][1] == three_digits(float(middle.mean()))
    assert table["baseline"][2:4] == ["-", "-"]


def test_chances_are_counts_of_episodes(store: Path, page: Path) -> None:
    (table,) = tables(page, "Agents against controllers")
    (tuned,) = of(store, "tuned")
    for column, scenario in enumerate(SCENARIOS):
        theirs, chances = tuned.outcomes[scenario], []
        for entry in of(store, "sac-home"):
            mine, wins = entry.outcomes[scenario], 0.0
            for k in range(EPISODES):
                a, b = ((o.position_error_mm[k] if o.success[k] else np.inf) for o in (mine, theirs))
                wins += 0.5 if a == b else float(a < b)
            chances.append(wins / EPISODES)
        low, high = interval(lambda p: p.mean(axis=(-2, -1)), np.array(chances)[:, None], whole_runs=True)
        assert table["sac-home over tuned"][column] == f"{np.mean(chances):.2f} ({low:.2f} to {high:.2f})"
        stacked = [
            [-e if held else -np.inf for e, held in zip(o.position_error_mm, o.success, strict=True)]
            for o in (*(entry.outcomes[scenario] for entry in of(store, "sac-home")), theirs)
        ]
        over_all = probability_of_improvement(np.array(stacked[:-1]), np.array(stacked[-1:]))
        assert float(over_all) == pytest.approx(np.mean(chances))


def test_ablations_stand_beside_the_main_agents_of_their_algorithm(page: Path) -> None:
    for table in tables(page, "Ablation: action"):
        assert list(table) == ["", "ppo-home", "ppo-pose"]
    for table in tables(page, "Ablation: observation"):
        assert list(table) == ["", "ppo-home", "short-errors"]


def test_ablations_stand_beside_what_they_are_compared_with(tmp_path: Path) -> None:
    a_store(tmp_path / "store", {"ppo-home": 1, "ppo-velocity": 1, "short": 1, "short-one": 1}, ("tuned",))
    page = report.write_results(tmp_path / "store", tmp_path / "page")
    for table in tables(page, "Ablation: observation"):
        assert list(table) == ["", "ppo-velocity", "short"]
    for table in tables(page, "Ablation: trajectories"):
        assert list(table) == ["", "short", "short-one"]


def test_a_store_of_lost_episodes_alone_is_told(tmp_path: Path) -> None:
    entries.save(an_entry("idle", hold=0.0), tmp_path / "store")
    page = report.write_results(tmp_path / "store", tmp_path / "page")
    assert tables(page, "Agents and controllers")[0]["idle"] == ["-", *["0"] * len(SCENARIOS)]


def test_other_environments_are_told_apart(tmp_path: Path) -> None:
    """Controllers stand beside the agents of their environment, and agents are compared with those alone."""
    a_store(tmp_path / "store", {"ppo-home": 1, "arm-home": 2}, ("tuned",))
    on_arm = an_entry("baseline", plant="arm")
    few = {scenario: on_arm.outcomes[scenario] for scenario in training("arm-home").scenarios}
    entries.save(dataclasses.replace(on_arm, outcomes=few), tmp_path / "store")
    for seed in range(2):
        one = an_entry("arm-home", seed, plant="arm")
        entries.save(dataclasses.replace(one, outcomes={name: one.outcomes[name] for name in few}), tmp_path / "store")
    page = report.write_results(tmp_path / "store", tmp_path / "page")
    for table in tables(page, "Agents and controllers"):
        assert list(table) == ["", "tuned", "ppo-home"]
        assert table[""] == ["seeds", *SCENARIOS]
    for table in tables(page, "Arms"):
        assert list(table) == ["", "baseline (arm, 2 EPMs, 2 Hz)", "arm-home (arm, 2 EPMs, 2 Hz)"]
        assert table[""] == ["seeds", *few]
    (compared,) = tables(page, "Agents against controllers")
    assert [row for row in compared if row] == [
        "ppo-home over tuned",
        "arm-home (arm, 2 EPMs, 2 Hz) over baseline (arm, 2 EPMs, 2 Hz)",
    ]
    options = "--plant arm --n-epm 2 --control-hz 2 --scenarios approach-60 approach-30"
    assert f"| `python -m agents.study controllers baseline {options}` |" in page.read_text()


def test_every_record_is_told_how_it_was_made(store: Path, page: Path) -> None:
    text = page.read_text()
    for name, count in SEEDS.items():
        for seed in range(count):
            assert f"| `{command_of(training(name).of_seed(seed))}` |" in text
            assert f"\n| {name} | {seed} | {of(store, name)[seed].training.steps:,} |" in text  # type: ignore[union-attr]
    assert "by one commit on one machine:\n\n1. abcdef123456 on M, 2 cores, Linux\n" in text


@pytest.mark.usefixtures("undrawn")
def test_other_machines_commits_and_versions_are_told(store: Path, tmp_path: Path) -> None:
    a_store(tmp_path, {"ppo-home": 2}, ("tuned",))
    other = dataclasses.replace(an_entry("ppo-home", 1), machine="Q, 4 cores", versions={"magenv": "0.2.0"})
    entries.save(other, tmp_path)
    text = report.write_results(tmp_path, tmp_path / "page").read_text()
    assert "Commits and machines differ among the records:\n" in text
    assert "2. abcdef123456 on Q, 4 cores\n" in text
    assert "Packages differ among the records:\n" in text
    assert "2. magenv 0.2.0; trained with magenv 0.1.0\n" in text
    assert re.search(r"^\| ppo-home \| 1 \| [\d,]+ \| [\d.]+ \| 1 \| 2 \| 2 \|", text, flags=re.MULTILINE)


def test_the_same_records_give_the_same_page(store: Path, page: Path, tmp_path: Path) -> None:
    report.write_results(store, tmp_path)
    assert files_of(tmp_path) == files_of(page.parent)


def test_all_pictures_are_there_and_those_of_an_earlier_page_are_not(page: Path, store: Path, tmp_path: Path) -> None:
    shown = re.findall(r"!\[.+\]\((.+)\)", page.read_text())
    assert sorted(shown) == sorted(path.name for path in page.parent.glob("*.png"))
    assert {"results-profiles.png", "results-curves.png", "results-curves-ablation-action.png"} <= set(shown)
    for name in shown:
        with Image.open(page.parent / name) as picture:
            picture.load()
            assert picture.width > 800
    (tmp_path / "results-old.png").touch()
    (tmp_path / "ladder.png").touch()
    a_store(tmp_path / "study", {"ppo-home": 1}, ())
    report.write_results(tmp_path / "study", tmp_path)
    assert not (tmp_path / "results-old.png").exists()
    assert (tmp_path / "ladder.png").exists()


@pytest.mark.parametrize(
    ("seeds", "controllers"),
    [({"ppo-pose": 1}, ()), ({}, ("idle",)), ({"ppo-pose": 2}, ("tuned",)), ({"sac-home": 1}, ())],
)
@pytest.mark.usefixtures("undrawn")
def test_a_study_that_has_only_begun_has_a_page(
    seeds: dict[str, int], controllers: tuple[str, ...], tmp_path: Path
) -> None:
    a_store(tmp_path / "study", seeds, controllers)
    text = report.write_results(tmp_path / "study", tmp_path).read_text()
    assert all(f"\n| {name} |" in text for name in (*seeds, *controllers))


@pytest.mark.usefixtures("undrawn")
def test_agents_that_lose_all_have_no_error(tmp_path: Path) -> None:
    for seed in range(3):
        entries.save(an_entry("ppo-home", seed, hold=1.0 if seed == 0 else 0.0), tmp_path)
    entries.save(an_entry("baseline", hold=0.0), tmp_path)
    success, position, *_ = tables(report.write_results(tmp_path, tmp_path / "page"), "Agents and controllers")
    assert success["baseline"][1:] == ["0"] * len(SCENARIOS)
    assert position["baseline"][1:] == ["-"] * len(SCENARIOS)
    assert all(cell.endswith(", 1 of 3 seeds") for cell in position["ppo-home"][1:])


def test_profiles_end_at_the_success(store: Path) -> None:
    measured = [one for one in collect(store) if one.name in ("tuned", "ppo-home")]
    for axes in profiles(measured, SCENARIOS).axes:
        for one, line in zip(measured, axes.lines, strict=True):
            rates = [np.mean(entry.outcomes[s].success) for entry in one.entries for s in SCENARIOS]
            assert line.get_ydata()[-1] == pytest.approx(100 * np.mean(rates))
            assert np.all(np.diff(line.get_ydata()) >= 0)


def test_curves_are_medians_between_the_extremes(store: Path) -> None:
    measured = [one for one in collect(store) if one.name == "ppo-home"]
    axes = curves(measured, "main").axes[2]
    (line,), (band,) = axes.lines, axes.collections
    last = [made.curve.position_error_mm[-1] for made in measured[0].made]
    assert line.get_ydata()[-1] == pytest.approx(np.median(last))
    at_end = [y for x, y in band.get_paths()[0].vertices if x == line.get_xdata()[-1]]
    assert (min(at_end), max(at_end)) == pytest.approx((min(last), max(last)))
    assert line.get_xdata()[-1] == pytest.approx(3000.0)


def test_a_training_whose_first_steps_took_no_second_is_drawn_over_time(store: Path) -> None:
    (one,) = (one for one in collect(store) if one.name == "ppo-home")
    entries = []
    for entry in one.entries:
        assert entry.training is not None
        curve = entry.training.curve
        quick = dataclasses.replace(curve, seconds=(0.0, 0.0, *curve.seconds[2:]))
        entries.append(dataclasses.replace(entry, training=dataclasses.replace(entry.training, curve=quick)))
    for axes, first in zip(
        curves([dataclasses.replace(one, entries=tuple(entries))], "main").axes[:2], (1, 2), strict=True
    ):
        (line,) = axes.lines
        begun = [made.curve for made in one.made]
        told = [curve.seconds[2] / 60 if first == 2 else curve.steps[0] / 1e3 for curve in begun]
        assert line.get_xdata()[0] == pytest.approx(max(told))


@pytest.mark.usefixtures("undrawn")
def test_a_ladder_is_drawn_on_demand(store: Path, climbed: Climbed, rollout: Told, tmp_path: Path) -> None:
    run_ladder([controller("tuned")], Ladder(), 1, tmp_path / "ladder", "")
    text = report.write_results(store, tmp_path, [tmp_path / "ladder" / "ladder.json"]).read_text()
    assert "![Success over separation](results-ladder.png)" in text
    assert "| separation (mm) | tuned, 2 Hz |" in text


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the pictures, which take time, empty."""
    monkeypatch.setattr(report, "png", lambda _: b"")


def unlike(**changes: Any) -> Entry:
    return dataclasses.replace(an_entry("ppo-home", 1), **changes)


def _with(**value: float | None) -> dict[str, Outcomes]:
    """Return outcomes of lost episodes, one number of which is another."""
    outcomes = an_entry("ppo-home", 1, hold=0.0).outcomes
    ((column, wrong),) = value.items()
    one = outcomes["eight-30"]
    changed = dataclasses.replace(one, **{column: (wrong, *getattr(one, column)[1:])})
    return outcomes | {"eight-30": changed}


def test_records_that_do_not_belong_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    made = unlike().training
    assert made is not None
    cases = {
        "of a training of the study": unlike(name="ppo-old"),
        "action 'home'": unlike(training=dataclasses.replace(made, config=made.config | {"action": "step"})),
        "12 episodes of approach-60": an_entry("ppo-home", 1, episodes=3),
        "same scenarios": unlike(outcomes={"approach-60": unlike().outcomes["approach-60"]}),
        "of a training": unlike(training=None),
        "measured in": unlike(plant="arm"),
        "errors of at least 0": unlike(outcomes=_with(heading_error_deg=-1.0)),
        "of episodes that are lost at a time, or succeed": unlike(outcomes=_with(loss_of_control_s=None)),
    }
    for index, (told, entry) in enumerate(cases.items()):
        store = tmp_path / str(index)
        a_store(store, {"ppo-home": 1}, ("baseline",))
        path = entries.save(entry, store)
        message = refusal(lambda store=store: report.write_results(store, store / "page"))
        assert told in message
        assert str(path.parent) in message
        assert not (store / "page").exists()


def test_a_damaged_record_is_refused_by_its_name(store: Path, tmp_path: Path) -> None:
    a_store(tmp_path, {"ppo-home": 1}, ("baseline",))
    path = tmp_path / "ppo-home" / "seed-0.json"
    path.write_text(path.read_text()[:-100])
    assert str(path) in refusal(lambda: report.write_results(tmp_path, tmp_path / "page"))
