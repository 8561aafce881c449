"""The benchmarks' own code in a tiny setting, without peers; no figure is asserted."""

from __future__ import annotations

import math
import os
import platform
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest

import benchmarks.__main__ as command
from benchmarks import allocation, dipole, env, floor, memory, peak, rollouts, start
from benchmarks.machine import head
from benchmarks.measure import Contestant, Effort, Times, on_cores, side_by_side
from benchmarks.policies import script
from benchmarks.table import HEAD, LeftOut, Limit, Line, Row, console, markdown, page, text
from magenv import ENV_ID
from magenv.allocation import allocate
from magenv.episodes import Settings
from magenv.poses import POSE_SIZE

TINY = Effort(
    repeats=2,
    envs=4,
    steps=3,
    recorded=2,
    scalar_steps=5,
    pairs=10,
    rollout_envs=2,
    rollout_steps=4,
    targets=2,
    batch=3,
    processes=2,
)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """No peer is installed, whatever is."""
    for module in (env, dipole, allocation):
        monkeypatch.setattr(module, "installed", lambda package: False)


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("part", [env, dipole, rollouts, allocation])
def test_parts_measure_without_peers(part: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peak, "LOOPS", 100)
    monkeypatch.setattr(env, "TURN_S", 0.0)
    lines = list(part.measure(TINY))
    rows = [line for line in lines if isinstance(line, Row)]
    assert rows
    assert len({(row.what, row.peer) for row in rows}) == len(rows)
    assert all(math.isfinite(row.ours) and row.ours >= 0 for row in rows)
    assert all("|" not in line for line in map(str, lines) if not line.startswith("Row"))
    assert all("not installed" in line.why or "version" in line.why for line in lines if isinstance(line, LeftOut))


def test_script_of_control_keeps_control() -> None:
    batch = env.Batch(script("control", env.CASES[env.BASE], 4, 20, 2), 4)
    resets, substeps = batch.observed()
    assert resets == 0
    assert substeps == 50


def test_script_of_zero_actions_loses_control_and_counts_it() -> None:
    resets, substeps = env.Batch(script("zero", env.CASES[env.BASE], 4, 20, 2), 4).observed()
    assert 0 < resets <= 1
    assert 0 < substeps < 50


def test_an_env_that_does_nothing_answers_in_the_kinds_of_ours() -> None:
    ours, none = (gymnasium.make(ENV_ID, disable_env_checker=True), floor.nothing())
    kinds = []
    for made in (ours, none):
        action, answers = np.zeros(made.action_space.shape or 0, np.float32), []
        for _ in range(2):
            made.reset(seed=0)
            answers.append(made.step(action))
        (one, *numbers, info), (other, *_, again) = answers
        info.pop("is_success", None)
        arrays = {"": (one, other)} | {key: (info[key], again[key]) for key in info if np.ndim(info[key])}
        assert not any(np.shares_memory(*pair) for pair in arrays.values())
        told = {key: (pair[0].dtype, pair[0].shape) for key, pair in arrays.items()}
        kinds.append((told, [type(n) for n in numbers], {key: type(value) for key, value in info.items()}))
    assert kinds[0] == kinds[1]


def test_kernels_without_python_play_what_the_env_plays() -> None:
    given = script("control", env.CASES[env.BASE], 1, 20, 1)
    ours: Any = gymnasium.make(ENV_ID, disable_env_checker=True, **vars(given.settings))
    ours.reset(seed=0)
    for action in given.actions[:, 0]:
        _, _, terminated, truncated, info = ours.step(action)
        assert not terminated
        assert not truncated
    played = floor.Kernels(given.settings, given.actions[:, 0])
    for _ in range(2):
        played.reset()
        played.run()
        np.testing.assert_array_equal(played.episodes.state.robots[0], info["robots"])


def test_holds_alone_are_whole() -> None:
    holds = floor.Holds(env.CASES[env.BASE], 8, 3)
    for _ in range(2):
        holds.run()
        counts = holds.world.measurements.counts
        assert (counts[0] == env.SUBSTEPS).all()
        assert (counts[1] == 0).all(), "control is kept"


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="looks for x86 instructions")
def test_products_of_a_substep_are_counted() -> None:
    """Five dipoles of about thirty, two pairs of sine and cosine, six cubics; not those of single lanes."""
    two, three = (floor.products(Settings("approach-60", n_epm=n, control_hz=4.0)) for n in (2, 3))
    assert 200 < two < 350
    assert 40 < three - two < 80, "two dipoles more"


def test_contestants_take_turns_and_the_first_is_for_warming_up() -> None:
    calls: list[str] = []

    def turn(name: str) -> Callable[[], None]:
        return lambda: calls.append(name)

    both = {name: Contestant(turn(name), 10, turn(f"prepare {name}")) for name in "AB"}
    times = side_by_side(both, 2)
    assert calls == ["prepare A", "A", "prepare B", "B"] * 3
    assert all(len(times.of[name]) == 2 for name in "AB")


def test_times() -> None:
    times = Times({"ours": np.array([1.0, 2.0, 4.0]), "peer 1": np.array([2.0, 8.0, 12.0]), "peer 2": np.full(3, 5.0)})
    assert times.seconds("ours") == 2.0
    assert times.rate("ours") == 0.5
    assert times.speedup("ours", "peer 1") == 3.0  # the median of 2, 4, 3; not 8 over 2
    assert times.fastest("peer") == "peer 2"


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system cannot keep threads on cores")
def test_on_cores_gives_the_cores_back() -> None:
    before = os.sched_getaffinity(0)
    with on_cores(1):
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


def test_a_moved_target_is_as_far_as_told() -> None:
    given = allocation.problem("A", 0)
    scales = allocation.component_scales()
    moved = allocation.moved(given, np.random.default_rng(0))
    shift = np.linalg.norm((moved - given.target) / scales) / np.linalg.norm(given.target / scales)
    assert shift == pytest.approx(allocation.MOVED)


def test_feasibility_sees_radius_and_gap() -> None:
    given = allocation.problem("A", 0)
    solution = allocate(*given)
    assert allocation.is_feasible(solution, given)
    solution.pose[2] = given.system.r_min_m - 1e-6
    assert not allocation.is_feasible(solution, given)
    solution.pose[POSE_SIZE:] = solution.pose[:POSE_SIZE]
    solution.pose[2::POSE_SIZE] = given.system.r_max_m
    assert not allocation.is_feasible(solution, given)


def test_start_times_a_process_of_its_own(tmp_path: Path) -> None:
    assert start.seconds(start.IMPORT, tmp_path) > 0
    with pytest.raises(RuntimeError, match="failed"):
        start.seconds("import sys; sys.exit(1)", tmp_path)


def test_start_counts_the_processes_that_work(tmp_path: Path) -> None:
    good, bad = (next(start.at_once(code, 2, tmp_path)) for code in (start.IMPORT, "import sys; sys.exit(1)"))
    assert (good.ours, good.met) == (2, True)
    assert (bad.ours, bad.met) == (0, False)


@pytest.mark.skipif(not memory.STATM.is_file(), reason="the system does not tell")
@pytest.mark.parametrize("work", ["steps of make", "resets of make", "steps of make_vec"])
def test_memory_is_read(work: memory.Work, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "SAMPLES", 4)
    grown, last = memory.growth(work, 80, 2)
    assert math.isfinite(grown)
    assert last > 1e6


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        (1_034_000.0, "steps/s", "1.03 M steps/s"),
        (999.4, "steps/s", "999 steps/s"),
        (999.9, "steps/s", "1 k steps/s"),
        (0.00123, "s", "1.23 ms"),
        (4.5e-5, "s", "45 µs"),
        (0.0, "s", "0 s"),
        (-2_500_000.0, "B", "-2.5 MB"),
        (20, "of 20", "20 of 20"),
        (1.5, "x", "1.5 x"),
    ],
)
def test_numbers_as_text(value: float, unit: str, expected: str) -> None:
    assert text(value, unit) == expected


def test_limits_are_of_the_ratio_or_of_our_own_figure() -> None:
    def met(limit: Limit | None) -> bool | None:
        return Row("what", 0.002, "s", "peer", 0.004, 2.0, limit).met

    assert met(None) is None
    assert met(Limit(2.0)) is True
    assert met(Limit(2.1)) is False
    assert met(Limit(0.002, "s", at_least=False)) is True
    assert met(Limit(0.001, "s", at_least=False)) is False
    assert met(Limit(0.001, "s")) is True
    assert Row("what", 1.0, "s", wanted=Limit(1.0)).met is False  # no ratio, nothing met


ROWS = [
    Row("first | of all", 2e6, "steps/s", "peer", 1e6, 2.0, Limit(1.5)),
    Row("second", 3e-3, "s", wanted=Limit(1e-3, "s", at_least=False)),
    Row("third", 1.0, "s"),
]


def test_table_leaves_out_empty_columns() -> None:
    assert markdown(ROWS).splitlines() == [
        "| what | ours | peer | peer's | ratio | wanted | met |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        "| first \\| of all | 2 M steps/s | peer | 1 M steps/s | 2 x | ≥ 1.5 x | yes |",
        "| second | 3 ms |  |  |  | ≤ 1 ms | **no** |",
        "| third | 1 s |  |  |  |  |  |",
    ]
    assert len(HEAD) == len(ROWS[0].cells())


def test_rows_on_the_console() -> None:
    assert [console(row) for row in ROWS] == [
        "first | of all: 2 M steps/s, peer 1 M steps/s, 2 x, wanted ≥ 1.5 x: yes",
        "second: 3 ms, wanted ≤ 1 ms: no",
        "third: 1 s",
    ]


def test_page_counts_what_is_met_and_names_what_is_left_out() -> None:
    parts: dict[str, list[Line]] = {"One": [*ROWS, LeftOut("fourth", "no peer")], "Two": [LeftOut("fifth", "no peer")]}
    written = page("# Head", parts)
    assert "Wanted and met: 1 of 2." in written
    assert "## One\n\n| what" in written
    assert "\n\n* left out: fourth (no peer)\n" in written
    assert written.endswith("## Two\n\n* left out: fifth (no peer)\n")


def test_head_tells_machine_versions_and_command() -> None:
    told = head("python -m benchmarks", 7)
    for word in ("`python -m benchmarks`", "numba 0.", "Python 3.", "cores", "medians of 7"):
        assert word in told


def _fake(effort: Effort) -> Iterator[Line]:
    yield Row("rounds", effort.repeats, "of 9")


@pytest.mark.parametrize(
    ("arguments", "written"), [([], True), (["--only", "dipole"], False), (["--repeats", "9"], True)]
)
def test_page_is_written_when_all_is_measured(
    arguments: list[str], written: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "PARTS", {name: (name, _fake) for name in command.PARTS})
    monkeypatch.setattr(command, "PAGE", tmp_path / "docs" / "benchmarks.md")
    monkeypatch.setattr(sys, "argv", ["/somewhere/benchmarks/__main__.py", *arguments])
    command.main()
    assert command.PAGE.exists() == written
    if written:
        told = command.PAGE.read_text(encoding="utf-8")
        assert " ".join(["`python -m benchmarks", *arguments]) + "`" in told
        assert f"{9 if arguments else 7} of 9" in told
        assert [path.name for path in command.PAGE.parent.iterdir()] == [command.PAGE.name]


def test_page_of_some_parts_goes_where_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "PARTS", {name: (name, _fake) for name in command.PARTS})
    monkeypatch.setattr(sys, "argv", ["benchmarks", "--only", "dipole", "memory", "--out", str(tmp_path / "some.md")])
    command.main()
    told = (tmp_path / "some.md").read_text(encoding="utf-8")
    assert [line for line in told.splitlines() if line.startswith("## ")] == ["## dipole", "## memory"]
