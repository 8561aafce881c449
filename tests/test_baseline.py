"""The paper's controller: what it asks for, that it gets it, and that it knows nothing but observations."""

from __future__ import annotations

import ast
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from recorded import a_record

from agents import baseline, pid
from agents.baseline import PAPER_GAINS, Baseline, BaselineState, paper_baseline, tuned_baseline
from agents.pid import Gains
from agents.records import Record
from agents.tune import cost, gains_of
from magenv.allocation import allocate
from magenv.angles import wrap
from magenv.outcome import CONVERGED
from magenv.params import PLANTS, Body, Plant, System
from magenv.poses import to_cartesian
from magenv.task import Layout
from magenv.trajectories import draw
from magenv.wrench import planar_moments, robot_wrench

Floats = NDArray[np.float64]
Observations = NDArray[np.float32]

_FIRST_EPM = 49
"""Where the EPMs begin in an observation (see ``magenv.task``)."""


@pytest.fixture
def observations(make_env: Any) -> Observations:
    """Return the observations (5, d) of five starts."""
    env = make_env(scenario="random")
    return np.stack([env.reset(seed=seed)[0] for seed in range(5)])


def asked(true: Floats, target: Floats, period_s: float) -> Floats:
    """Return F_x, F_y, tau_z (2, 3) of the first control step, worked out from true poses and the reference (2, 3)."""
    error = target - true
    g = PAPER_GAINS
    position = (g.force_p + g.force_i * period_s) * error[:, :2]
    heading = (g.torque_p + g.torque_i * period_s) * np.array([wrap(value) for value in error[:, 2]])
    return np.concatenate([position, heading[:, None]], axis=1)


def planar(wrench: Floats, headings: Floats) -> tuple[Floats, Floats]:
    """Return F_x, F_y, tau_z (2, 3) in the global frame and tau_y, F_z (2, 2) of a wrench U (10)."""
    u, c, s = wrench.reshape(2, 5), np.cos(headings), np.sin(headings)
    return np.stack([c * u[:, 2] - s * u[:, 3], s * u[:, 2] + c * u[:, 3], u[:, 1]], axis=1), u[:, [0, 4]]


@pytest.mark.parametrize(("n_epm", "least"), [(3, 10), (2, 3)])
@pytest.mark.parametrize("control_hz", [2.0, 10.0])
def test_the_commanded_poses_push_the_true_robots_as_the_pid_asks(
    make_env: Any, n_epm: int, least: int, control_hz: float
) -> None:
    """Two EPMs cannot give every small wrench, whatever the starts; where they can, and always with three, they do."""
    system = System(n_epm=n_epm)
    env = make_env(scenario="random", action="pose", n_epm=n_epm, control_hz=control_hz)
    controller = paper_baseline(n_epm, control_hz)
    reached, mutual = 0, 0.0
    for seed in range(10, 20):
        observation, info = env.reset(seed=seed)
        robots = info["robots"][:, :3]
        target = draw("random", np.random.default_rng(seed)).at(1 / control_hz)
        wanted = asked(robots, target, 1 / control_hz)
        controller.seed(seed)
        action, _ = controller.predict(observation)
        pose = env.step(action)[4]["epm_pose"]
        positions = np.concatenate([robots[:, :2], np.zeros((2, 1))], axis=1)
        moments = planar_moments(robots[:, 2], system.ipm_moment_am2)
        got, out_of_plane = planar(robot_wrench(positions, moments, pose, system.epm_moment_am2), robots[:, 2])
        force, torque = np.abs(got - wanted)[:, :2].max(), np.abs(got - wanted)[:, 2].max()
        beside = np.abs(out_of_plane).max(axis=0)
        if max(force, beside[1]) < 3e-9 and max(torque, beside[0]) < 1e-9:
            reached += 1
            assert np.abs(wanted[:, :2]).max() > 1e-7
            mutual = max(mutual, float(np.abs(alone(positions, moments)).max()))
        else:
            assert n_epm == 2
            assert force < 2e-4, "a wrench out of reach is still approached"
    assert reached >= least
    assert mutual > 1e-4, "the robots' own attraction, in the balance as well, must not be negligible here"


def alone(positions: Floats, moments: Floats) -> Floats:
    """Return the wrench (10) of the robots on each other."""
    far_away = [0.0, 0.0, 1e6, 0.0, 0.0]
    return robot_wrench(positions, moments, far_away, 1.0)


@pytest.mark.parametrize("make", [paper_baseline, tuned_baseline])
@pytest.mark.parametrize("n_epm", [2, 3])
def test_one_observation_or_many(make_env: Any, make: Any, n_epm: int) -> None:
    env = make_env(scenario="approach-60", n_epm=n_epm)
    rows = np.stack([env.reset(seed=seed)[0] for seed in range(2)])
    kept = rows.copy()
    controller: Baseline = make(n_epm)
    controller.seed(3)
    single, state = controller.predict(rows[0])
    assert single.shape == (5 * n_epm,)
    assert single.dtype == np.float32
    assert isinstance(state, BaselineState)
    assert state.solver.tolist() == [CONVERGED]
    controller.seed(3)
    batch, _ = controller.predict(rows, None, np.ones(2, np.bool_))
    assert batch.shape == (2, 5 * n_epm)
    assert np.abs(batch).max() <= 1.0
    np.testing.assert_array_equal(batch[0], single)
    np.testing.assert_array_equal(rows, kept)
    with pytest.raises(ValueError, match="Input observation must be"):
        controller.predict(rows[:, :-1])


def test_a_row_does_not_depend_on_its_neighbours(observations: Observations) -> None:
    controller = paper_baseline()
    together, _ = controller.predict(observations)
    others = observations[[1, 1, 2, 1, 4]]
    controller.seed(0)
    np.testing.assert_array_equal(controller.predict(others)[0][[2, 4]], together[[2, 4]])
    controller.seed(0)
    same = controller.predict(observations[[0, 0]])[0]
    assert not np.array_equal(same[0], same[1]), "two rows draw the same random starts"


def test_its_seed_fixes_its_actions_and_its_state_its_memory(observations: Observations) -> None:
    one, two = paper_baseline(), paper_baseline()
    for controller in (one, two):
        controller.seed(8)
    two.predict(observations[2])  # leaves no trace beyond seed()
    two.seed(8)
    states: list[Any] = [None, None]
    for observation in observations[:3]:
        actions = []
        for k, controller in enumerate((one, two)):
            action, states[k] = controller.predict(observation, states[k], np.zeros(1, np.bool_))
            actions.append(action)
        np.testing.assert_array_equal(actions[0], actions[1])
    one.seed(8)
    two.seed(9)
    assert not np.array_equal(one.predict(observations[0])[0], two.predict(observations[0])[0])


def test_an_episode_that_starts_forgets_its_integral_alone(observations: Observations) -> None:
    controller = paper_baseline()
    _, state = controller.predict(observations[:2])
    first = state.pid.integral.copy()
    _, state = controller.predict(observations[:2], state, np.array([True, False]))
    np.testing.assert_allclose(state.pid.integral[0], first[0])
    np.testing.assert_allclose(state.pid.integral[1], 2 * first[1])


@pytest.fixture
def with_other_epms(observations: Observations, make_env: Any) -> Observations:
    """Return the first observation twice, the second time with the EPMs elsewhere; at all starts they are at home."""
    env = make_env(scenario="random")
    env.reset(seed=0)
    away = env.step(np.full(10, 0.5, np.float32))[0]
    rows = np.stack([observations[0], observations[0]])
    rows[1, _FIRST_EPM:] = away[_FIRST_EPM:]
    assert not np.array_equal(rows[0], rows[1])
    return rows


@pytest.mark.parametrize("make", [paper_baseline, tuned_baseline])
def test_only_the_tuned_controller_takes_a_warm_start(
    with_other_epms: Observations, make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The paper's: ten random starts, nothing else; the present poses do not count."""
    asked: list[dict[str, Any]] = []

    def watched(*arguments: Any, **options: Any) -> Any:
        asked.append(options)
        return allocate(*arguments, **options)

    monkeypatch.setattr("agents.baseline.allocate", watched)
    actions = []
    for observation in with_other_epms:
        controller = make()
        controller.seed(0)
        actions.append(controller.predict(observation)[0])
    assert [options["starts"] for options in asked] == [10, 10]
    if make is paper_baseline:
        assert all(options["initial"] is None and not options["stop_early"] for options in asked)
        np.testing.assert_array_equal(actions[0], actions[1])
    else:
        assert all(options["stop_early"] for options in asked)
        assert not np.array_equal(asked[0]["initial"], asked[1]["initial"])


def test_a_warm_start_finds_a_solution_near_the_present_poses(make_env: Any) -> None:
    env = make_env(scenario="random", action="pose", n_epm=3)
    moved_m = {}
    for warm in (True, False):
        controller = Baseline("", PAPER_GAINS, warm_start=warm, n_epm=3)
        controller.seed(1)
        state, centres = None, []
        observation, _ = env.reset(seed=1)
        for _ in range(4):
            action, state = controller.predict(observation, state)
            observation, *_, info = env.step(action)
            centres.append(to_cartesian(info["epm_pose"])[0])
        moved_m[warm] = np.linalg.norm(np.diff(centres, axis=0), axis=-1).max()
    assert moved_m[True] < 0.05 < 0.1 < moved_m[False]


def test_the_tuned_controller_draws_nothing_where_its_warm_start_serves(make_env: Any) -> None:
    observation, _ = make_env(scenario="random", action="pose", n_epm=3).reset(seed=1)
    actions = []
    for seed in (0, 1):
        controller = tuned_baseline(3)
        controller.seed(seed)
        actions.append(controller.predict(observation)[0])
    np.testing.assert_array_equal(actions[0], actions[1])


def test_its_nominal_parameters_stand_apart_from_the_plants(
    observations: Observations, monkeypatch: pytest.MonkeyPatch
) -> None:
    def actions() -> NDArray[np.float32]:
        controller = paper_baseline()
        controller.seed(4)
        return controller.predict(observations)[0]

    before = actions()
    other = Body(mass_kg=0.1, inertia_kgm2=1e-4, drag_linear_nspm=2.0, drag_rotational_nmsprad=1e-3, diameter_m=0.02)
    monkeypatch.setitem(PLANTS, "paper", Plant(body=other, workspace_radius_m=0.2, substep_s=0.01))
    np.testing.assert_array_equal(actions(), before)


@pytest.mark.parametrize("module", [baseline, pid])
def test_it_imports_neither_plant_nor_world(module: Any) -> None:
    tree = ast.parse(Path(module.__file__).read_text())
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert not modules & {"magenv.world", "magenv.dynamics", "magenv.episodes", "magenv.env", "magenv.vector_env"}
    assert "PLANTS" not in names


def test_it_says_which_environment_it_speaks_to(make_env: Any) -> None:
    controller = paper_baseline()
    env = make_env(action=controller.action, observation=controller.observation, frame=controller.frame)
    assert env.action_space.contains(controller.predict(env.reset(seed=0)[0])[0])
    task = Layout(System(), 0.1, 0.5, controller.observation, controller.frame)
    assert env.observation_space.shape == (task.size,)


@pytest.mark.parametrize(("n_epm", "control_hz"), [(0, 2.0), (2, 0.0), (2, -1.0), (2, float("nan"))])
def test_bad_input_is_refused(n_epm: int, control_hz: float) -> None:
    with pytest.raises(ValueError, match=r"Input (n_epm|control_hz) must be"):
        paper_baseline(n_epm, control_hz)


def test_tuning_weighs_errors_and_lost_time(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}

    def recorded(controller: Baseline, scenario: str, **settings: Any) -> list[Record]:
        asked.update(settings, controller=controller.name, scenario=scenario)
        return [a_record(), a_record(held_steps=20)]

    monkeypatch.setattr("agents.tune.run", recorded)
    error = 0.5 / 1.0 + math.degrees(2e-3) / 2.0  # 0.5 mm and 2 mrad in the cost's units, in both episodes
    lost = 100.0 * (2 - 10.0 / 100)  # the second is lost after 10 s
    gains = Gains(force_p=0.1, force_i=0.01, force_d=0.02, torque_p=4e-5, torque_i=1e-6, torque_d=2e-6)
    logarithms = np.log(list(vars(gains).values()))
    assert cost(logarithms, 2, 4.0) == pytest.approx(error + lost / 2)
    assert asked == {"controller": "candidate", "scenario": "random", "control_hz": 4.0, "episodes": 2, "seed": 1000}
    assert vars(gains_of(logarithms)) == pytest.approx(vars(gains))
