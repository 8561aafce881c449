"""The ladder of separations: what is drawn of it and told of it in tables."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from climbs import Climbed, Told
from PIL import Image

from agents import ladder_figures
from agents.catalogue import controller
from agents.figures import colour_of
from agents.ladder import Ladder
from agents.ladder_run import run_ladder
from agents.metrics import rate_interval

EPISODES = 20


def test_the_figure_is_drawn_from_the_files_alone(
    climbed: Climbed, rollout: Told, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    folders = [tmp_path / "slow", tmp_path / "fast"]
    for folder, hz in zip(folders, (2.0, 10.0), strict=True):
        rollout.outcomes = {20.0: (10, 1.0)} if hz == 2.0 else {16.0: (0, 1.0)}
        run_ladder([controller("tuned", 2, hz)], Ladder(control_hz=hz), 1, folder, "")
        for path in folder.iterdir():
            if path.name != "ladder.json":
                path.unlink()
    calls = len(rollout.calls)
    capfd.readouterr()
    out = tmp_path / "pictures" / "both.png"
    monkeypatch.setattr(sys, "argv", ["ladder_figures", *map(str, folders), "--out", str(out)])
    ladder_figures.main()
    with Image.open(out) as picture:
        picture.load()
        assert picture.width > 800
    printed = capfd.readouterr().out
    assert "| separation (mm) | tuned, 2 Hz | tuned, 10 Hz |" in printed
    assert "| 20 | 50 % / 0.50 mm | 100 % / 0.50 mm |" in printed
    assert "| 16 | 100 % / 0.50 mm | 0 % / - |" in printed
    assert "| survived | down to 21 mm | down to 18 mm |" in printed
    assert len(rollout.calls) == calls


def legend_of(axes: Any) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_lines_tell_how_far_down_control_lasts(climbed: Climbed) -> None:
    kept = climbed({20.0: (10, 1.0)}, "tuned")
    apart = climbed({30.0: (20, 1.2)}, "baseline")
    lost = climbed({60.0: (0, 1.0), 50.0: (0, 1.0)}, "idle")
    (axes,) = ladder_figures.draw([*kept, *apart, *lost]).axes
    assert legend_of(axes) == [
        *("tuned, 2 Hz: down to 21 mm", "baseline, 2 Hz: down to 35 mm", "idle, 2 Hz: not even 60 mm")
    ]
    assert axes.get_xlim()[0] > 60.0 > 14.0 > axes.get_xlim()[1], "from wide to narrow"
    for name, rungs in (("tuned", kept), ("baseline", apart), ("idle", lost)):
        marks = [line for line in axes.lines if line.get_color() == colour_of(name, []) and line.get_marker() == "o"]
        filled = [line for line in marks if line.get_markerfacecolor() == line.get_color()]
        hollow = [line for line in marks if line.get_markerfacecolor() == "white"]
        for lines, survived in ((filled, True), (hollow, False)):
            drawn = {tuple(point) for line in lines for point in line.get_xydata()}
            assert drawn == {(r.separation_mm, 100 * r.success_rate) for r in rungs if r.survived == survived}


def test_bands_are_the_intervals_of_the_rate(climbed: Climbed) -> None:
    (axes,) = ladder_figures.draw(climbed({60.0: (12, 1.0)})).axes
    (band,) = axes.collections
    at_60 = [y for x, y in band.get_paths()[0].vertices if x == 60.0]
    assert (min(at_60), max(at_60)) == pytest.approx(tuple(100 * rate for rate in rate_interval(12, EPISODES)))


@pytest.mark.parametrize(("anti", "limit_mm"), [(False, 19.0), (True, 12.8)])
def test_the_limit_of_holding_and_the_bodies_are_marked(anti: bool, limit_mm: float, climbed: Climbed) -> None:
    (axes,) = ladder_figures.draw(climbed(anti=anti)).axes
    assert [line.get_xdata()[0] for line in axes.lines if set(line.get_ydata()) == {0, 1}] == [limit_mm]
    assert f"holdable at rest: {limit_mm:g} mm" in [text.get_text() for text in axes.texts]
    (touching,) = axes.patches
    reach = touching.get_extents().transformed(axes.transData.inverted()).intervalx
    assert sorted(reach) == pytest.approx([axes.get_xlim()[1], 11.0])


def test_each_plant_has_a_panel_and_each_rate_a_style(climbed: Climbed) -> None:
    rungs = [
        rung for plant in ("moving", "paper") for hz in (2.0, 10.0) for rung in climbed(plant=plant, control_hz=hz)
    ]
    panels = ladder_figures.draw(rungs).axes
    titles = [axes.get_legend().get_title().get_text().split()[0] for axes in panels]
    assert titles == ["moving", "paper"]
    for axes in panels:
        assert legend_of(axes) == ["tuned, 2 Hz: down to 14 mm", "tuned, 10 Hz: down to 14 mm"]
        styles = {(line.get_linestyle(), line.get_marker()) for line in axes.get_legend().get_lines()}
        assert len(styles) == 2
        assert len({marker for _, marker in styles}) == 2


def test_a_rung_that_is_there_twice_is_refused(climbed: Climbed) -> None:
    with pytest.raises(ValueError, match=r"Input ladders must be of different.*'tuned, 2 Hz on paper plant.* twice'"):
        ladder_figures.draw(2 * climbed())


def test_a_climb_broken_off_is_told_so(climbed: Climbed) -> None:
    rungs = climbed({45.0: (0, 1.0)})
    assert ladder_figures.reached(rungs[:2]) == "50 mm so far"
    assert ladder_figures.reached(rungs[:4]) == "50 mm so far"
    assert ladder_figures.reached(rungs) == "down to 50 mm"
