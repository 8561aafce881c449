"""The predictive controller: what it comes to, what it remembers, that it knows nothing but observations."""

from __future__ import annotations

import ast
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rollouts import MakeEnv
from walks import first, walk

from agents import planner, predictive, searches, trim
from agents.baseline import tuned_baseline
from agents.catalogue import controller
from agents.predictive import CONVERGED, SOUGHT, Predictive, PredictiveState
from agents.rollout import run
from magenv.actions import pose_to_action
from magenv.forecast import STATE
from magenv.observer import MOMENTS
from magenv.outcome import CONVERGED as SOLVED
from magenv.params import PLANTS, Body, Plant, System
from magenv.poses import from_cartesian
from magenv.task import Layout, unpack


@pytest.mark.parametrize(
    ("scenario", "position_mm", "heading_deg"), [("approach-60", 0.15, 0.3), ("approach-30", 0.5, 1.0)]
)
def test_it_holds_what_the_papers_controller_loses(scenario: str, position_mm: float, heading_deg: float) -> None:
    (record,) = run(Predictive(), scenario, episodes=1, seed=0)
    assert record.success
    assert 1e3 * record.position_error_m.mean() < position_mm
    assert math.degrees(record.heading_error_rad.mean()) < heading_deg


def test_it_holds_five_episodes_of_which_the_tuned_controller_holds_none() -> None:
    ours, tuned = (run(agent, "approach-30", episodes=5, seed=20) for agent in (Predictive(), tuned_baseline()))
    assert [record.success for record in ours] == [True] * 5
    assert [record.success for record in tuned] == [False] * 5
    for one, other in zip(ours, tuned, strict=True):
        held = len(other.position_error_m) - 10  # until five seconds before its loss
        assert one.position_error_m[:held].mean() < 0.5 * other.position_error_m[:held].mean()
        assert one.heading_error_rad[:held].mean() < other.heading_error_rad[:held].mean()


def test_it_holds_with_arms_that_lag_noise_and_magnets_that_are_amiss() -> None:
    """At 10 Hz on ``arm``."""
    records = run(Predictive(2, 10.0, "arm"), "approach-60", "arm", control_hz=10.0, episodes=2, seed=0)
    assert [record.success for record in records] == [True] * 2
    assert 1e3 * np.mean([record.position_error_m.mean() for record in records]) < 1.0
    for record in records:
        assert (record.solver == SOLVED).mean() > 0.8, "plans mostly meet the reference"
    assert not any(record.projected.any() for record in records), "no plan is nearer than the least gap"


@pytest.mark.parametrize("seed", range(3))
def test_how_strong_the_magnets_are_is_learned(make_env: MakeEnv, seed: int) -> None:
    """One EPM against the other, within twenty seconds on ``arm``; against drags, nothing that moves evenly tells."""
    env = make_env(scenario="approach-60", action="pose", plant="arm", control_hz=10.0)
    state = walk(env, Predictive(2, 10.0, "arm"), seed, 200)[2]
    learned = 1.0 + state.rows[0].known[MOMENTS : MOMENTS + 2]
    true = env._episodes.world.physics.epm_moment[0]
    assert abs(true[0] / true[1] - 1.0) > 0.005
    assert learned[0] / learned[1] == pytest.approx(true[0] / true[1], abs=0.02)


def test_a_trim_is_sought_for_what_pushes(make_env: MakeEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the estimate of the moment, and for where the robots should be at the next command's end."""
    told: list[tuple[Any, ...]] = []
    agent, follow = Predictive(2, 10.0, "arm"), trim.Trim.follow
    monkeypatch.setattr(trim.Trim, "follow", lambda self, *given: told.append(given) or follow(self, *given))
    _, _, state = walk(make_env(scenario="approach-60", action="pose", plant="arm", control_hz=10.0), agent, 0, 5)
    assert len(told) == 5
    assert np.abs(told[-1][1]).max() > 0.0
    np.testing.assert_array_equal(told[-1][1], state.rows[0].known[STATE:MOMENTS])


def test_a_first_plan_that_goes_wrong_is_sought_again_where_epms_travel() -> None:
    """Three EPMs that go from home: the first descent ends where robots are flung away."""
    (record,) = run(Predictive(3, 2.0, "moving"), "approach-60", "moving", n_epm=3, episodes=1, seed=0)
    assert record.success


def test_it_holds_with_arms_at_five_hertz() -> None:
    (record,) = run(Predictive(2, 5.0, "arm"), "approach-60", "arm", control_hz=5.0, episodes=1, seed=2)
    assert record.success


def test_epms_that_are_slower_than_believed_are_seen() -> None:
    slow = "moving:epm_speed_mps=0.5,epm_turn_radps=1.57"
    (record,) = run(Predictive(2, 2.0, "moving"), "approach-60", slow, episodes=1, seed=0)
    assert record.success


def test_doubt_holds_epms_that_are_no_dipoles() -> None:
    """Three episodes of which one is lost by the controller that takes its dipoles at their word."""
    certain, doubting = (
        run(Predictive(doubt=doubt), "approach-60", "cylinders", episodes=3, seed=0) for doubt in (0.0, 0.05)
    )
    assert not all(record.success for record in certain)
    assert all(record.success for record in doubting)


def test_doubt_adds_nothing_where_the_nominal_plant_is_as_doubtful(make_env: MakeEnv) -> None:
    env = make_env(scenario="approach-60", action="pose", plant="arm", control_hz=10.0)
    (plain, _), (doubting, _) = (walk(env, Predictive(2, 10.0, "arm", doubt=doubt), 0, 3)[1:] for doubt in (0.0, 0.2))
    np.testing.assert_array_equal(plain, doubting)


@pytest.mark.parametrize(("n_epm", "control_hz"), [(3, 2.0), (2, 10.0), (3, 10.0), (2, 0.9)])
def test_three_epms_and_other_control_rates(make_env: MakeEnv, n_epm: int, control_hz: float) -> None:
    """The error of the beginning is gone after a second, two holds at least, and stays away."""
    env = make_env(scenario="approach-60", action="pose", n_epm=n_epm, control_hz=control_hz)
    agent, state, errors = Predictive(n_epm, control_hz), None, []
    observation = first(env, 1)
    for _ in range(20):
        action, state = agent.predict(observation, state)
        assert state.status[0] in (CONVERGED, SOUGHT)
        observation, _, terminated, _, info = env.step(action)
        assert not terminated
        errors.append(info["position_error_end_m"])
    settled = max(2, round(control_hz))
    assert max(errors[settled:]) < 5e-5
    assert state.rows[0].commands.shape == (2 if control_hz == 10.0 else 1, n_epm, 6)


@pytest.mark.parametrize(
    ("plant", "control_hz", "commands"),
    [("arm", 10.0, 2), ("arm", 7.0, 2), ("arm", 5.0, 2), ("arm", 4.9, 1), ("paper", 7.0, 1), ("paper", 40.0, 4)],
)
def test_where_epms_travel_the_next_command_but_one_is_planned_too(
    make_env: MakeEnv, plant: str, control_hz: float, commands: int
) -> None:
    """Where they end the one they begin the next; unless a command takes longer than plans look ahead."""
    observation = first(make_env(scenario="approach-60", plant=plant, control_hz=control_hz), 0)
    state = Predictive(2, control_hz, plant).predict(observation)[1]
    assert state.rows[0].commands.shape == (commands, 2, 6)


def test_its_plans_come_from_the_last_one(make_env: MakeEnv) -> None:
    """Once on the way, EPMs move by less than 50 mm a hold: no plan is sought elsewhere."""
    env = make_env(scenario="approach-60", action="pose")
    observations, _, _ = walk(env, Predictive(), 3, 20)
    parts = unpack(np.stack(observations), Layout(System(), PLANTS["paper"].workspace_radius_m, 0.5))
    ways = np.linalg.norm(np.diff(parts.epm_positions, axis=0), axis=-1)
    assert ways[3:].max() < 0.05


def test_a_plan_begins_with_what_the_last_one_planned_for_later(make_env: MakeEnv) -> None:
    """At 20 Hz four commands are planned: the first is given, the others move up, and the last is kept twice."""
    env, agent = make_env(scenario="approach-60", action="pose", control_hz=20.0), Predictive(2, 20.0)
    (action,), state = agent.predict(first(env, 0)[None])
    later = state.rows[0].commands
    assert later.shape == (4, 2, 6)
    np.testing.assert_array_equal(later[3], later[2])
    told = [pose_to_action(from_cartesian(epms[:, :3], epms[:, 3:]), System()).astype(np.float32) for epms in later]
    for one, other in zip([action, *told[:2]], told[:3], strict=True):
        assert np.abs(one - other).max() > 1e-4


def test_its_seed_fixes_its_actions(make_env: MakeEnv) -> None:
    """At the start of this episode a plan is sought elsewhere, from random starts."""
    observation = first(make_env(scenario="approach-30"), 0)
    one, two = Predictive(), Predictive()
    for agent in (one, two):
        agent.seed(8)
    two.predict(observation)  # leaves no trace beyond seed()
    two.seed(8)
    action, state = one.predict(observation)
    assert state.status[0] == SOUGHT
    np.testing.assert_array_equal(two.predict(observation)[0], action)
    two.seed(9)
    assert not np.array_equal(two.predict(observation)[0], action)


def test_a_walk_is_the_same_again(make_env: MakeEnv) -> None:
    env = make_env(scenario="approach-30", action="pose")
    walks = []
    for _ in range(2):
        agent = Predictive()
        agent.seed(3)
        walks.append(walk(env, agent, 0, 6)[1])
    np.testing.assert_array_equal(*walks)


def test_one_observation_or_many(make_env: MakeEnv) -> None:
    """Rows are what they are alone, step after step; here no plan is sought elsewhere, and nothing is random."""
    env = make_env(scenario="approach-60", action="pose")
    alone = [walk(env, Predictive(), seed, 4) for seed in range(3)]
    agent, state = Predictive(), None
    for step in range(4):
        rows = np.stack([observations[step] for observations, _, _ in alone])
        kept = rows.copy()
        actions, state = agent.predict(rows, state, np.full(3, step == 0))
        assert actions.shape == (3, 10)
        assert actions.dtype == np.float32
        assert np.abs(actions).max() <= 1.0
        assert isinstance(state, PredictiveState)
        np.testing.assert_array_equal(state.status, [CONVERGED] * 3)
        np.testing.assert_array_equal(actions, [told[step] for _, told, _ in alone])
        np.testing.assert_array_equal(rows, kept)
    with pytest.raises(ValueError, match="Input observation must be"):
        agent.predict(rows[:, :-1])
    with pytest.raises(ValueError, match=r"Input state must be one of 2 episodes.*instead received 3"):
        agent.predict(rows[:2], state)
    with pytest.raises(ValueError, match=r"Input episode_start must be of shape \(3,\)"):
        agent.predict(rows, state, np.zeros(2, np.bool_))


def test_a_row_does_not_depend_on_its_neighbours(make_env: MakeEnv) -> None:
    """Not even where plans are sought from random starts."""
    env = make_env(scenario="approach-30")
    rows = np.stack([first(env, seed) for seed in (1, 0, 2, 0)])
    together, state = Predictive().predict(rows)
    assert state.status[1] == state.status[3] == SOUGHT
    np.testing.assert_array_equal(Predictive().predict(rows[[0, 1, 1, 3]])[0][[0, 1, 3]], together[[0, 1, 3]])
    assert not np.array_equal(together[1], together[3]), "two rows draw the same random starts"


def test_an_episode_that_starts_forgets_all_of_its_row_alone(make_env: MakeEnv) -> None:
    env = make_env(scenario="approach-60", action="pose")
    (one, _, _), (two, _, _) = (walk(env, Predictive(), seed, 3) for seed in (0, 1))
    rows = [np.stack(pair) for pair in zip(one, two, strict=True)]
    agent, state = Predictive(), None
    for step in range(3):
        _, state = agent.predict(rows[step], state)
    action, state = agent.predict(rows[3], state, np.array([True, False]))
    fresh, _ = Predictive().predict(rows[3])
    np.testing.assert_array_equal(action[0], fresh[0])
    assert not np.array_equal(action[1], fresh[1])


@pytest.mark.parametrize("module", [predictive, planner, trim, searches])
def test_it_imports_neither_plant_nor_environment(module: Any) -> None:
    """It foresees through ``forecast``; what the episodes' world is in truth it cannot ask."""
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    hidden = {"world", "hold", "state", "steps", "episodes", "episode", "starts", "env", "vector_env", "trajectories"}
    assert not modules & {f"magenv.{name}" for name in hidden}
    assert not modules & {"gymnasium", "magenv"}


def test_its_nominal_parameters_are_its_own(make_env: MakeEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    """Made for one plant, it acts alike whatever the plants are then; made for another plant, otherwise."""
    observation = first(make_env(scenario="approach-60"), 0)
    agent, again = Predictive(), Predictive()
    before = agent.predict(observation)[0]
    heavy = Body(mass_kg=0.1, inertia_kgm2=1e-4, drag_linear_nspm=2.0, drag_rotational_nmsprad=1e-3)
    monkeypatch.setitem(PLANTS, "paper", Plant(body=heavy))
    np.testing.assert_array_equal(again.predict(observation)[0], before)
    assert not np.array_equal(Predictive().predict(observation)[0], before)
    assert not np.array_equal(Predictive(plant="high-drag").predict(observation)[0], before)


def test_it_says_which_environment_it_speaks_to(make_env: MakeEnv) -> None:
    agent = Predictive()
    env = make_env(action=agent.action, observation=agent.observation, frame=agent.frame)
    assert env.action_space.contains(agent.predict(env.reset(seed=0)[0])[0])
    for name in ("predictive", "predictive-robust"):
        made = controller(name, 3, 10.0)
        assert isinstance(made, Predictive)
        assert made.name == name


@pytest.mark.parametrize(
    "changes",
    [
        {"n_epm": 0},
        {"control_hz": 0.0},
        {"control_hz": math.nan},
        {"plant": "none"},
        {"doubt": -0.1},
        {"doubt": math.nan},
    ],
)
def test_bad_input_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"Input {next(iter(changes))} must be"):
        Predictive(**changes)
