"""``python -m magenv.crosstalk``: tables, figures, going on after a stop, what is refused."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from magenv.crosstalk import sweep
from magenv.crosstalk.__main__ import as_csv, means
from magenv.crosstalk.plan import MAP_STEP_DEG, PANELS, PARTS, images, map_corner, panels
from magenv.crosstalk.sweep import Task, run
from magenv.crosstalk.tasks import activation_rows, validity_rows

ROOT = Path(__file__).parent.parent
COLUMNS = [
    "panel",
    "n_epm",
    "distance_m",
    "angle_deg",
    "amplitude",
    "component",
    "activation",
    "crosstalk_normalised",
    "crosstalk_raw",
    *(f"u_{i}" for i in range(10)),
]


def crosstalk(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "error", "-m", "magenv.crosstalk", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)


def tasks(n: int) -> list[Task]:
    return list(panels([2], 0.2, 1))[:n]


def test_a_row_for_each_component_with_the_columns_that_were_promised() -> None:
    rows = activation_rows("a", 2, 0.1, 30.0, 0.0, 0.2, 2)
    table = list(csv.DictReader(io.StringIO(as_csv(rows).decode())))
    assert list(table[0]) == [*COLUMNS, "first_deg", "starts"]
    assert [int(row["component"]) for row in table] == list(range(10))
    for row in table:
        i, scale = int(row["component"]), [0.05, 0.05, 0.5, 0.5, 0.5] * 2
        u = [abs(float(row[f"u_{j}"])) for j in range(10)]
        assert float(row["activation"]) == pytest.approx(u[i] / scale[i] / 0.2)
        raw = max(u[j] for j in range(10) if j != i) / u[i]
        assert float(row["crosstalk_raw"]) == pytest.approx(raw)
        normalised = max(u[j] / scale[j] for j in range(10) if j != i) / (u[i] / scale[i])
        assert float(row["crosstalk_normalised"]) == pytest.approx(normalised)


def test_rows_of_unequal_numbers_of_epms_stand_in_one_table() -> None:
    table = list(
        csv.DictReader(io.StringIO(as_csv([{"n": 2, "x_0": 0.5}, {"n": 3, "x_0": 0.1, "x_1": 1e-17}]).decode()))
    )
    assert table == [{"n": "2", "x_0": "0.5", "x_1": ""}, {"n": "3", "x_0": "0.1", "x_1": "1e-17"}]


def test_the_papers_panels_are_planned() -> None:
    planned = [task.arguments for task in panels([2, 3], 0.2, 10)]
    for name, n_epm, distance, angle in PANELS:
        found = [a for a in planned if a["panel"] == name]
        assert len(found) == 1
        assert (found[0]["n_epm"], found[0]["distance_m"], found[0]["angle_deg"]) == (n_epm, distance, angle)
    swept = {a["distance_m"] for a in planned if a["panel"] == "distance"}
    assert (min(swept), max(swept)) == (0.02, 0.2)
    turned = {a["angle_deg"] for a in planned if a["panel"] == "angle"}
    assert (min(turned), max(turned)) == (0.0, 90.0)
    assert not [a for a in planned if a["n_epm"] == 3 and a["panel"].startswith("2")]


def test_the_map_is_covered_by_images_of_its_corner() -> None:
    around = 360 // MAP_STEP_DEG
    corner = list(map_corner())
    assert len({image for pair in corner for image in images(*pair)}) == around**2
    assert len(corner) < around**2 / 6


def test_a_stopped_run_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[Task] = []

    def compute(task: Task) -> list[sweep.Row]:
        done.append(task)
        if len(done) == 5:
            raise KeyboardInterrupt
        return [{"panel": task.arguments["panel"], "x": float(task.arguments["distance_m"])}]

    monkeypatch.setattr(sweep, "compute", compute)
    monkeypatch.setattr(sweep, "Parallel", lambda: lambda calls: [f(*a, **k) for f, a, k in calls])
    monkeypatch.setattr(sweep, "_A_ROUND", 2)
    wanted = tasks(9)
    with pytest.raises(KeyboardInterrupt):
        run(wanted, tmp_path, workers=1)
    assert len(list(tmp_path.glob("*.json"))) == 4
    tables = run(wanted, tmp_path, workers=1)
    assert len(done) == 5 + 5
    assert [row["x"] for row in tables["crosstalk"]] == [task.arguments["distance_m"] for task in wanted]
    some = sorted(tmp_path.glob("*.json"))[:4]
    for torn, content in zip(some, (some[0].read_text()[:-3], "[]", "{}", '{"sha256": "", "rows": []}'), strict=True):
        torn.write_text(content)
    assert run(wanted, tmp_path, workers=1) == tables
    assert len(done) == 14
    assert run(wanted, tmp_path, workers=1) == tables
    assert len(done) == 14


def test_other_settings_are_other_points() -> None:
    keys = {task.key() for amplitude in (0.2, 0.3) for task in panels([2, 3], amplitude, 1)}
    assert len(keys) == 2 * len(list(panels([2, 3], 0.2, 1)))


def test_a_run_writes_tables_and_figures(tmp_path: Path) -> None:
    arguments = ("--parts", "unlike", "stability", "--n-epm", "2", "--starts", "1", "--out", str(tmp_path))
    first = crosstalk(*arguments)
    assert first.returncode == 0, first.stderr
    for name, columns in (("unlike", {"mounting_deg", "crosstalk_mean"}), ("stability", {"time_constant_s"})):
        rows = list(csv.DictReader(io.StringIO((tmp_path / f"{name}.csv").read_text(encoding="utf-8"))))
        assert len(rows) == len(list(PARTS[name]([2], 0.2, 1)))
        assert columns <= set(rows[0])
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert picture.width > 800
            assert len(picture.convert("L").getcolors(1 << 16) or []) > 20
    settings = json.loads((tmp_path / "settings.json").read_text(encoding="utf-8"))
    assert settings["amplitude"] == 0.2
    assert settings["command"].startswith("python -m magenv.crosstalk --parts unlike stability")
    before = (tmp_path / "unlike.csv").read_bytes()
    again = crosstalk(*arguments)
    assert again.returncode == 0
    assert (tmp_path / "unlike.csv").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--amplitude", "-0.1"), "Input amplitude must be a positive, finite number; instead received -0.1."),
        (("--amplitude", "nan"), "Input amplitude must be a positive, finite number; instead received nan."),
        (("--n-epm", "0"), "Input n_epm must be whole numbers of at least 1, one at least; instead received (0,)."),
        (("--starts", "0"), "Input starts must be a whole number of at least 1; instead received 0."),
        (("--engine", "abacus"), "abacus"),
        (("--n-epm", "1", "--parts", "validity"), "Input parts must be such that there is something to compute"),
    ],
)
def test_bad_input_ends_the_process_with_one_line(arguments: tuple[str, ...], told: str, tmp_path: Path) -> None:
    ended = crosstalk(*arguments, "--out", str(tmp_path / "out"))
    assert ended.returncode == 2
    assert told in ended.stderr
    assert ended.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_mean_of_each_matrix_is_told() -> None:
    rows = activation_rows("2-epms-parallel-15cm", 2, 0.15, 0.0, 0.0, 0.2, 10)
    ((panel, told),) = means([*rows, rows[0] | {"panel": "distance"}])
    assert panel == "2-epms-parallel-15cm"
    assert "mean crosstalk 9." in told


def test_what_cylinders_change_is_told_component_by_component() -> None:
    rows = validity_rows(2, 0.15, 0.0, 0.0, 0.2, 2, "centre")
    for row in rows:
        i = row["component"]
        errors = [row[f"error_{j}"] for j in range(10)]
        assert max(map(abs, errors)) > 1e-3
        assert abs(row["activation_exact"] - row["activation_dipole"]) == pytest.approx(abs(errors[i]), abs=1e-9)
        assert 0.05 < row["nearest_epm_m"] < 0.5
