"""The same episodes for every controller, and records that say what happened in them and survive a file."""

from __future__ import annotations

import inspect
import math
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from recorded import a_record

from agents.baseline import paper_baseline
from agents.controller import Controller, Idle, Random
from agents.records import Record, load, save
from agents.rollout import controller_seed, run
from magenv.params import PLANTS, System
from magenv.task import Layout, unpack
from magenv.trajectories import shaped

SUBSTEP_S = 0.005


class Proportional:
    """Force and torque against the errors, straight into the ``wrench`` mode: holds 60 mm, and remembers its calls."""

    name = "proportional"
    action = "wrench"
    observation = "full"
    frame = "global"

    def __init__(self) -> None:
        self._layout = Layout(System(), PLANTS["paper"].workspace_radius_m, 0.5, "full", "global")
        self.calls: list[tuple[tuple[int, ...], Any, Any, bool]] = []
        self.seeds: list[int] = []

    def seed(self, seed: int) -> None:
        self.seeds.append(seed)
        self.calls = []

    def predict(
        self,
        observation: NDArray[np.float32],
        state: int | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], int]:
        self.calls.append((observation.shape, state, episode_start, deterministic))
        error = unpack(observation, self._layout).error
        wrench = np.array([0.1 / 0.02, 0.1 / 0.02, 1e-4 / 1e-3]) * error
        return np.clip(wrench.reshape(len(observation), 6), -1, 1).astype(np.float32), len(self.calls)


def same(one: Record, other: Record, *but: str) -> bool:
    """Return whether two records are equal bit for bit, wall times and the named fields left out."""
    names = [field.name for field in fields(Record) if field.name not in ("step_ms", *but)]
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


@pytest.mark.parametrize("scenario", ["approach-60", "random"])
def test_all_controllers_meet_the_same_episodes(scenario: str) -> None:
    controllers: list[Controller] = [Proportional(), Idle(), Random(), Random(seed=1), paper_baseline()]
    runs = [run(controller, scenario, control_hz=0.5, episodes=3, seed=11) for controller in controllers]
    assert len({controller.action for controller in controllers}) == 3
    assert len({controller.frame for controller in controllers}) == 2
    for records in runs:
        assert [record.seed for record in records] == [11, 12, 13]
        for record, first in zip(records, runs[0], strict=True):
            np.testing.assert_array_equal(record.robots[0], first.robots[0])
            np.testing.assert_array_equal(record.epm_pose[0], first.epm_pose[0])
            np.testing.assert_array_equal(record.reference, first.reference)
            assert not np.array_equal(record.robots[1], first.robots[1]) or records is runs[0]
    starts = [record.robots[0] for record in runs[0]]
    assert not np.array_equal(starts[0], starts[1])
    assert (scenario == "random") != np.array_equal(runs[0][0].reference, runs[0][1].reference)


def test_an_episode_does_not_depend_on_those_before_it() -> None:
    for controller in (Random(), Proportional()):
        later = run(controller, "approach-60", control_hz=0.5, episodes=3, seed=5)[2]
        (alone,) = run(controller, "approach-60", control_hz=0.5, episodes=1, seed=7)
        assert same(later, alone)


def test_a_controllers_own_seed_changes_its_actions() -> None:
    (one,) = run(Random(seed=0), "approach-60", episodes=1)
    (two,) = run(Random(seed=1), "approach-60", episodes=1)
    assert not np.array_equal(one.epm_pose[1], two.epm_pose[1])


def test_a_controllers_random_numbers_are_not_the_environments() -> None:
    seeds = [controller_seed(seed) for seed in range(100)]
    assert len(set(seeds)) == 100
    assert controller_seed(3) == seeds[3]
    for seed, own in enumerate(seeds):
        assert own != np.random.SeedSequence(seed).generate_state(1)[0], "the environment's own stream"
        assert np.random.default_rng(own).normal() != np.random.default_rng(seed).normal()


def test_the_references_are_those_of_the_environment(make_env: Any) -> None:
    for scenario in ("approach-30-anti", "random"):
        (record,) = run(Proportional(), scenario, episodes=1, seed=4)
        env = make_env(scenario=scenario)
        told = [env.reset(seed=4)[1]]
        for _ in range(3):
            told.append(env.step(np.zeros(10, np.float32))[4])
            if told[-1]["loss"]:  # told at the moment of the loss, not at the control instant
                told.pop()
                break
        for k, info in enumerate(told):
            np.testing.assert_array_equal(record.reference[k], info["reference"])
        assert record.reference.shape == (201, 2, 3)


def test_a_held_episode_is_recorded_to_the_end_of_the_reference() -> None:
    (record,) = run(Proportional(), "approach-60", episodes=1)
    assert record.success
    assert (record.loss, record.loss_time_s) == ("none", None)
    np.testing.assert_allclose(record.time_s, 0.5 * np.arange(201))
    assert record.robots.shape == record.reference.shape == (201, 2, 3)
    assert record.epm_pose.shape == (201, 10)
    assert set(record.substeps) == {100}
    np.testing.assert_allclose(errors_m(record, record.reference), record.position_error_end_m, rtol=1e-9)
    apart = np.hypot(*(record.robots[1:, 1, :2] - record.robots[1:, 0, :2]).T)
    assert (record.separation_min_m <= apart + 1e-12).all()
    assert (record.position_error_m > 0.0).all()


def test_a_lost_episode_ends_at_the_very_substep() -> None:
    for record in run(Idle(), "approach-60", episodes=4):
        holds = len(record.substeps)
        assert not record.success
        assert record.loss == "deviation"
        assert record.loss_time_s == record.time_s[-1]
        assert record.loss_time_s == pytest.approx(0.5 * (holds - 1) + SUBSTEP_S * record.substeps[-1])
        assert len(record.time_s) == len(record.robots) == len(record.epm_pose) == holds + 1
        target = shaped("approach", 0.06).at(record.loss_time_s)
        away = np.hypot(*(record.robots[-1] - target)[:, :2].T)
        assert 0.030 < away.max() < 0.032
        assert record.position_error_end_m[-1] == pytest.approx(away.mean(), rel=1e-9)
        assert record.separation_tracked_m is not None


def errors_m(record: Record, reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the position errors at the ends of the holds, mean of the robots."""
    difference = (record.robots - reference)[1:, :, :2]
    errors: NDArray[np.float64] = np.hypot(difference[..., 0], difference[..., 1]).mean(axis=1)
    return errors


def test_a_controller_is_seeded_and_told_where_episodes_begin() -> None:
    controller = Proportional()
    records = run(controller, "approach-60", control_hz=0.5, episodes=2, seed=3)
    assert controller.seeds[-2:] == [controller_seed(3), controller_seed(4)]
    shapes, states, starts, deterministic = zip(*controller.calls, strict=True)
    assert set(shapes) == {(1, 63)}
    assert list(states) == [None, *range(1, len(controller.calls))]
    assert [start.tolist() for start in starts] == [[True]] + [[False]] * (len(starts) - 1)
    assert all(deterministic)
    assert len(controller.calls) == len(records[-1].step_ms)
    assert (records[-1].step_ms > 0.0).all()


def test_each_record_is_handed_over_as_soon_as_it_is_there() -> None:
    handed: list[Record] = []
    records = run(Idle(), "approach-60", episodes=3, progress=handed.append)
    assert all(one is other for one, other in zip(records, handed, strict=True))


@pytest.mark.parametrize("controller", [Idle(3), Random(3)])
def test_the_floor_controllers_take_one_or_many_observations(controller: Idle | Random) -> None:
    for shape in ((4, 70), (70,)):
        action, state = controller.predict(np.zeros(shape, np.float32))
        assert action.shape == (*shape[:-1], 15)
        assert action.dtype == np.float32
        assert np.abs(action).max() <= 1.0
        assert state is None
    assert (controller.name == "idle") == (not action.any())


def test_controllers_open_the_same_door() -> None:
    wanted = list(inspect.signature(Controller.predict).parameters)
    for controller in (Idle, Random, type(paper_baseline())):
        assert list(inspect.signature(controller.predict).parameters) == wanted


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": 0}, "Input episodes must be a whole number of at least 1; instead received 0."),
        ({"seed": -1}, "Input seed must be a whole number of at least 0; instead received -1."),
        ({"scenario": "approach"}, "Input scenario must be"),
        ({"plant": "arms"}, "Input plant must be"),
        ({"n_epm": 1}, "Input n_epm must be"),
    ],
)
def test_bad_input_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run(Idle(), **{"scenario": "approach-60", **changes})


def test_records_come_back_from_a_file_as_they_were(tmp_path: Path) -> None:
    records = [*run(Proportional(), "random", control_hz=0.5, episodes=2), a_record(separation_tracked_m=None)]
    path = tmp_path / "records.npz"
    save(records, path)
    back = load(path)
    assert len(back) == 3
    for one, other in zip(back, records, strict=True):
        assert same(one, other)
        np.testing.assert_array_equal(one.step_ms, other.step_ms)
        kinds = {name: type(value) for name, value in asdict(one).items()}
        assert kinds == {name: type(value) for name, value in asdict(other).items()}
    assert [entry.name for entry in tmp_path.iterdir()] == ["records.npz"]


def test_records_of_unequal_systems_do_not_share_a_file(tmp_path: Path) -> None:
    path = tmp_path / "records.npz"
    with pytest.raises(ValueError, match="Input records must be"):
        save([a_record(), replace(a_record(), n_epm=3)], path)
    with pytest.raises(ValueError, match="Input records must be"):
        save([], path)
    assert not path.exists()


class Bomb:
    """Makes a file when unpickled."""

    def __init__(self, mark: Path) -> None:
        self._mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self._mark,)


def test_foreign_and_doctored_files_are_refused_and_run_nothing(tmp_path: Path) -> None:
    path, mark = tmp_path / "records.npz", tmp_path / "mark"
    save([a_record()], path)
    with np.load(path) as file:
        whole = dict(file)
    broken: dict[str, dict[str, Any]] = {
        "bomb": {**whole, "seed": np.array([Bomb(mark)], dtype=object)},
        "lacking": {name: value for name, value in whole.items() if name != "substeps"},
        "short": {**whole, "robots": whole["robots"][:-1]},
        "flat": {**whole, "robots": whole["robots"].reshape(-1, 6)},
        "nobody": {**whole, "controller": whole["controller"][:0]},
        "other": {**whole, "format": np.array("magenv records 99")},
        "numbers": {"a": np.zeros(3)},
    }
    for name, arrays in broken.items():
        np.savez(tmp_path / f"{name}.npz", **arrays)
    (tmp_path / "text.npz").write_text("not an archive")
    (tmp_path / "cut.npz").write_bytes(path.read_bytes()[:-200])
    np.save(tmp_path / "array.npy", np.zeros(3))
    foreign = [f"{name}.npz" for name in (*broken, "text", "cut", "missing")] + ["array.npy", "."]
    for name in foreign:
        with pytest.raises(
            ValueError, match=r"Input records file must be a readable file of magenv's records"
        ) as raised:
            load(tmp_path / name)
        assert "\n" not in str(raised.value)
    assert not mark.exists()
    assert not math.isnan(load(path)[0].time_s.sum())
