"""Reports from records alone: complete, strict, readable in 80 columns, with losses marked where they happened."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from recorded import STEPS, a_record
from rich.console import Console

from agents import figures
from agents.metrics import Episode, summarise
from agents.records import Record, load
from agents.replay import PANELS, animate
from agents.report import print_table, write_report
from magenv.files import check_output_dir

LOST = (30, 24, 36)


@pytest.fixture
def records() -> list[Record]:
    """Two controllers on the same three episodes: one loses control in all, one holds."""
    lost = [a_record(held_steps=steps, error_m=0.02, seed=seed) for seed, steps in enumerate(LOST)]
    held = [a_record(controller="ppo", action="home", error_m=0.002, seed=seed) for seed in range(len(LOST))]
    return [*lost, *held]


def test_a_report_is_complete(records: list[Record], tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    others = [a_record(scenario="approach-60", controller=name) for name in ("baseline", "runs/../my agent")]
    rows = write_report([*records, *others], folder, "python evaluate.py --episodes 3")
    page = (folder / "report.md").read_text()
    assert "python evaluate.py --episodes 3" in page
    pictures = re.findall(r"!\[.+?\]\((.+?)\)", page)
    assert len(pictures) == 8
    assert {path.name for path in folder.iterdir()} == {
        *pictures,
        "report.md",
        "summary.json",
        "episodes.csv",
        "records",
    }
    for name in pictures:
        with Image.open(folder / name) as picture:
            picture.load()
    for package in ("magenv", "numpy", "gymnasium", "stable-baselines3", "torch", "numba"):
        assert re.search(rf"\b{package} \S", page)
    for row in rows:
        assert f"| {row.controller} |" in page
    assert "8.7 mm" in page
    assert "51 s" in page


def test_a_report_in_an_old_ones_folder_leaves_nothing_of_it(records: list[Record], tmp_path: Path) -> None:
    for one, other in (("approach-60", "approach-30"), ("approach-60", "approach-60")):
        write_report([a_record(scenario=one, plant="arm:epm_cylinders=true")], tmp_path, "")
        write_report([a_record(scenario=other, plant="arm:epm_cylinders=true", controller="ppo")], tmp_path, "")
        pictures = {path.name for path in tmp_path.iterdir() if path.suffix in (".png", ".gif")}
        assert len(pictures) == 4
        assert all(other in name for name in pictures)
        assert [path.name for path in (tmp_path / "records").iterdir()] == [f"ppo_{other}.npz"]


def test_the_summary_is_strict_json_and_episodes_stand_beside_it(records: list[Record], tmp_path: Path) -> None:
    rows = write_report(records, tmp_path, "")

    def refuse(name: str) -> float:
        raise AssertionError(name)

    summary = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    assert [row["controller"] for row in summary["rows"]] == [row.controller for row in rows] == ["baseline", "ppo"]
    assert summary["rows"][0]["position_error_mm"] is None
    assert summary["rows"][1]["loss_of_control_s"] is None
    assert summary["rows"][1]["position_error_mm_ci"] == [pytest.approx(1.0)] * 2
    with (tmp_path / "episodes.csv").open(newline="") as file:
        episodes = list(csv.DictReader(file))
    assert list(episodes[0]) == [field.name for field in fields(Episode)]
    assert [episode["loss_of_control_s"] for episode in episodes] == ["15.0", "12.0", "18.0", "", "", ""]
    assert [bool(episode["lost_first"]) for episode in episodes] == 3 * [True] + 3 * [False]
    counts = [sum(row["lost_first"].values()) for row in summary["rows"]]
    assert counts == [3, 0]
    (stored,) = (tmp_path / "records").glob("ppo*.npz")
    assert [record.seed for record in load(stored)] == [0, 1, 2]


def test_what_is_not_a_number_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_report([a_record(step_ms=np.full(STEPS, np.nan))], tmp_path, "")
    assert list(tmp_path.iterdir()) == []


def test_a_report_is_of_one_setting(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Input records must be episodes of one plant"):
        write_report([a_record(), a_record(control_hz=10.0, seed=1)], tmp_path / "out", "")
    assert not (tmp_path / "out").exists()


def test_the_table_is_whole_in_80_columns(records: list[Record]) -> None:
    text = io.StringIO()
    spread = [a_record(controller="wide", error_m=0.0004567 * k, seed=k, step_ms=np.full(STEPS, 123.4)) for k in (1, 2)]
    rows = summarise([*records, a_record(controller="[bold]a-rather-long-name-of-a-controller"), *spread])
    print_table(rows, Console(file=text, width=80))
    lines = text.getvalue().splitlines()
    assert max(len(line) for line in lines) <= 80
    assert "\N{HORIZONTAL ELLIPSIS}" not in text.getvalue()
    assert "[bold]a" in text.getvalue()
    assert "51 s" in text.getvalue()
    (ppo,) = (line.split() for line in lines if line.strip().startswith("ppo"))
    assert ppo[1:5] == ["100", "%", "1.00", "0.229"]
    (lost,) = (line.split() for line in lines if line.strip().startswith("baseline"))
    assert lost[1:5] == ["0", "%", "-", "-"]
    assert "15.0" in lost
    assert f"Lost first: baseline {next(iter(rows[0].lost_first))} 3." in text.getvalue()
    (wide,) = (index for index, line in enumerate(lines) if line.strip().startswith("wide"))
    assert lines[wide].split()[-1] == lines[wide + 1].split()[-1] == "123.4", "the last column is cut"
    assert re.search("[.0-9]{5}\N{EN DASH}[.0-9]{5} ", lines[wide + 1]), "no interval of full width"


@pytest.mark.parametrize("below", [".", "deeper/down"])
def test_an_output_folder_that_cannot_be_written_is_refused(tmp_path: Path, below: str) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(ValueError, match="Input out must be a folder that can be written; instead received"):
        check_output_dir(file / below)
    assert file.read_text() == "mine"


def test_a_writable_output_folder_is_made_and_left_as_it_was(tmp_path: Path) -> None:
    check_output_dir(tmp_path / "a" / "b")
    (tmp_path / "a" / "b" / "kept").touch()
    check_output_dir(tmp_path / "a" / "b")
    assert [path.name for path in (tmp_path / "a" / "b").iterdir()] == ["kept"]


@pytest.mark.parametrize("draw", [figures.errors, figures.separation])
def test_losses_are_marked_when_they_happened(records: list[Record], draw: Callable[[list[Record]], Figure]) -> None:
    axes = draw(records).axes[0]
    (marks,) = (line for line in axes.lines if line.get_marker() == "x")
    np.testing.assert_allclose(marks.get_xdata(), [0.5 * steps for steps in LOST])
    assert marks.get_color() == figures.colour_of("baseline", [])


def test_a_median_is_drawn_while_half_of_the_episodes_are_under_control(records: list[Record]) -> None:
    axes = figures.errors(records).axes[0]
    ends = {line.get_color(): max(line.get_xdata()) for line in axes.lines if line.get_marker() != "x"}
    assert ends[figures.colour_of("baseline", [])] == 0.5 * np.median(LOST)
    assert ends[figures.colour_of("ppo", [])] == 0.5 * STEPS


def test_paths_are_drawn_to_scale_beside_their_references(records: list[Record]) -> None:
    panels = figures.paths(records).axes
    assert [axes.get_title().splitlines()[0] for axes in panels] == ["baseline", "ppo"]
    for axes in panels:
        assert axes.get_aspect() == 1.0
        dashed = [line.get_xydata() for line in axes.lines if line.is_dashed()]
        for robot in range(2):
            np.testing.assert_allclose(dashed[robot], 1e3 * records[0].reference[:, robot, :2])
    assert sum(line.get_marker() == "x" for line in panels[0].lines) == 2 * (len(LOST) + 1)
    assert not any(line.get_marker() == "x" for line in panels[1].lines)


def test_a_controller_keeps_its_colour_in_any_company() -> None:
    names = ["mine", "baseline", "yours", "tuned", "ppo", "sac", "predictive", "predictive-robust", "random", "idle"]
    colours = [figures.colour_of(name, names) for name in names]
    assert len(set(colours)) == len(names)
    assert figures.colour_of("ppo", names) == figures.colour_of("ppo", ["ppo", "other"])


def test_the_limit_of_holding_depends_on_the_headings() -> None:
    for scenario, limit in (("approach-30", 19.0), ("approach-30-anti", 12.8)):
        axes = figures.separation([a_record(scenario=scenario)]).axes[0]
        levels = [line.get_ydata()[0] for line in axes.lines if len(set(line.get_ydata())) == 1]
        assert levels == [limit]


def test_the_animation_is_small_lasts_ten_seconds_and_freezes_where_control_is_lost(records: list[Record]) -> None:
    content = animate(records)
    assert len(content) < 3_000_000
    panels, lasting = [], 0.0
    with Image.open(io.BytesIO(content)) as movie:
        width = movie.width // 2
        for frame in range(movie.n_frames):
            movie.seek(frame)
            lasting += movie.info["duration"] / 1000
            picture = np.asarray(movie.convert("RGB"))
            panels.append((picture[:, :width], picture[:, width:]))
    assert 9.0 < lasting < 15.0
    frozen = [index for index in range(1, len(panels)) if np.array_equal(panels[index][0], panels[index - 1][0])]
    lost_at = round(np.median(LOST) / STEPS * len(panels))
    assert frozen[0] == pytest.approx(lost_at, abs=3)
    assert frozen == list(range(frozen[0], len(panels)))
    moving = sum(not np.array_equal(one[1], other[1]) for one, other in pairwise(panels))
    assert moving >= 0.9 * (len(panels) - 1)


def test_an_animation_shows_the_same_episode_of_the_first_controllers(records: list[Record]) -> None:
    crowd = [a_record(controller=str(k), seed=seed) for k in range(PANELS + 2) for seed in range(2)]
    with Image.open(io.BytesIO(animate(crowd))) as movie, Image.open(io.BytesIO(animate(crowd[:2]))) as alone:
        assert movie.width == PANELS * alone.width
