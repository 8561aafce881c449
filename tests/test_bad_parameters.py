"""Bad parameters and arguments of functions are told in one line: what it must be and what was received."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from messages import told
from numpy.typing import NDArray
from rollouts import MakeEnv

from magenv.actions import Actions
from magenv.allocation import allocate
from magenv.dipole import field, field_and_gradient, gradient
from magenv.env import TwoRobots
from magenv.params import Body, Magnet, Plant, System, TaskParams
from magenv.poses import from_cartesian, home_pose, project, to_cartesian
from magenv.task import unpack
from magenv.trajectories import shaped
from magenv.wrench import robot_wrench, wrench_jacobian

POSITIVE = "a positive, finite number"
NOT_NEGATIVE = "a finite number of at least 0"


# Parameters


@pytest.mark.parametrize("value", [0.0, -0.01, math.nan, math.inf, "1", None, True])
@pytest.mark.parametrize("name", ["mass_kg", "inertia_kgm2", "diameter_m"])
def test_body_is_positive(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, POSITIVE, value)):
        Body(**{name: value})


@pytest.mark.parametrize("value", [-0.01, math.nan, math.inf])
@pytest.mark.parametrize("name", ["drag_linear_nspm", "drag_rotational_nmsprad"])
def test_drag_is_not_negative(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, NOT_NEGATIVE, value)):
        Body(**{name: value})
    assert getattr(Body(**{name: 0.0}), name) == 0.0


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["diameter_m", "length_m", "remanence_t"])
def test_magnet_is_positive(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, POSITIVE, value)):
        Magnet(**({"diameter_m": 0.1, "length_m": 0.1} | {name: value}))


def test_numpys_numbers_are_numbers() -> None:
    assert System(n_epm=np.int64(3)).gap_min_m == System(n_epm=3).gap_min_m  # type: ignore[arg-type]
    assert TaskParams(control_hz=np.float32(4)).period_s == 0.25  # type: ignore[arg-type]
    TwoRobots(n_epm=np.int64(2), control_hz=np.float64(2.0)).reset(seed=0)  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [0, -1, 2.0, True, "2", None])
def test_number_of_epms_of_a_system(value: Any) -> None:
    with pytest.raises(ValueError, match=told("n_epm", "a whole number of at least 1", value)):
        System(n_epm=value)


@pytest.mark.parametrize("name", ["r_min_m", "r_max_m", "attraction_max_n"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_limits_of_a_system_are_positive(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, POSITIVE, value)):
        System(**{name: value})


@pytest.mark.parametrize("r_max", [0.1, 0.15])
def test_r_max_below_r_min(r_max: float) -> None:
    with pytest.raises(ValueError, match=told("r_max_m", "greater than r_min_m = 0.15", r_max)):
        System(r_max_m=r_max)


def test_gap_that_fits_nowhere() -> None:
    """The EPMs would have to be farther apart than the outer sphere is wide."""
    with pytest.raises(ValueError, match=r"^Input .+ must be .+; instead received"):
        System(r_max_m=0.16, attraction_max_n=0.1)


@pytest.mark.parametrize("name", ["workspace_radius_m", "substep_s"])
@pytest.mark.parametrize("value", [0.0, -0.1, math.nan])
def test_plant_is_positive(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, POSITIVE, value)):
        Plant(**{name: value})


def test_workspace_holds_the_body() -> None:
    with pytest.raises(ValueError, match=told("workspace_radius_m", "greater than the body's diameter 0.011", 0.01)):
        Plant(workspace_radius_m=0.01)


@pytest.mark.parametrize("value", [1, 0.0, "true", None])
def test_epms_are_cylinders_or_not(value: Any) -> None:
    with pytest.raises(ValueError, match=told("epm_cylinders", "True or False", value)):
        Plant(epm_cylinders=value)


@pytest.mark.parametrize("name", ["loss_distance_m", "tracking_distance_m"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.inf])
def test_task_is_positive(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=told(name, POSITIVE, value)):
        TaskParams(**{name: value})


@pytest.mark.parametrize("name", ["start_position_sd_m", "start_heading_sd_rad"])
def test_start_spread_is_not_negative(name: str) -> None:
    with pytest.raises(ValueError, match=told(name, NOT_NEGATIVE, -1e-3)):
        TaskParams(**{name: -1e-3})


# Functions


def test_dipole_shapes() -> None:
    laws: list[Callable[..., object]] = [field, gradient, field_and_gradient]
    for law in laws:
        for name, arguments in (
            ("moment", ([1, 2], [0, 0, 0], [1, 0, 0])),
            ("source", ([1, 0, 0], [0, 0, 0, 0], [1, 0, 0])),
            ("point", ([1, 0, 0], [0, 0, 0], 1.0)),
        ):
            with pytest.raises(ValueError, match=f"^Input {name} must be an array of shape \\(\\.\\.\\., 3\\)"):
                law(*arguments)


def test_wrench_shapes() -> None:
    positions, moments, pose = np.array([[0.1, 0, 0], [0, 0, 0]]), np.ones((2, 3)), home_pose(2)
    for law in (robot_wrench, wrench_jacobian):
        with pytest.raises(ValueError, match=told("positions", "an array of shape (..., 2, 3)", (3, 3))):
            law(np.zeros((3, 3)), moments, pose, 1.0)
        with pytest.raises(ValueError, match=told("moments", "an array of shape (..., 2, 3)", (3,))):
            law(positions, moments[0], pose, 1.0)
        for bad in (pose[:4], pose[:0], np.array(1.0)):
            with pytest.raises(ValueError, match=told("pose", "an array of shape (..., 5 N)", bad.shape)):
                law(positions, moments, bad, 1.0)
        with pytest.raises(ValueError, match=r"^Input positions, moments, pose must be of leading axes that broadcast"):
            law(np.tile(positions, (2, 1, 1)), np.tile(moments, (3, 1, 1)), pose, 1.0)
        for value in (0.0, -1.0, math.nan, math.inf):
            with pytest.raises(ValueError, match=told("epm_moment_am2", "a positive number", value)):
                law(positions, moments, pose, value)


def test_pose_shapes() -> None:
    with pytest.raises(ValueError, match=told("pose", "an array of shape (..., 5 N)", (7,))):
        to_cartesian(np.zeros(7))
    with pytest.raises(ValueError, match=told("positions", "an array of shape (..., N, 3)", (2, 2))):
        from_cartesian(np.zeros((2, 2)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match=told("directions", "of the shape of positions (2, 3)", (3, 3))):
        from_cartesian(np.zeros((2, 3)), np.zeros((3, 3)))
    for n_epm in (0, 1, 4):
        with pytest.raises(ValueError, match=told("n_epm", "2 or 3", n_epm)):
            home_pose(n_epm)


@pytest.mark.parametrize(
    "pose",
    [np.full(10, np.nan), np.tile(home_pose(2), (2, 1)), home_pose(3), home_pose(2)[:5]],
    ids=["nan", "rows", "three", "one"],
)
def test_projected_pose_is_finite_and_of_the_system(pose: NDArray[np.float64]) -> None:
    with pytest.raises(ValueError, match=r"^Input pose must be"):
        project(pose, System())


def problem(**changes: Any) -> dict[str, Any]:
    return {
        "target": np.full(10, 1e-3),
        "positions": np.array([[0.05, 0.0, 0.0], [-0.05, 0.0, 0.0]]),
        "moments": np.array([[0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]),
        "system": System(),
    } | changes


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"target": np.zeros(6)}, "target"),
        ({"target": np.full(10, np.nan)}, "target"),
        ({"target": np.full(10, 1e160)}, "target"),
        ({"seed": -1}, "seed"),
        ({"max_iterations": -1}, "max_iterations"),
        ({"max_iterations": 2.5}, "max_iterations"),
        ({"tolerance": math.nan}, "tolerance"),
        ({"positions": np.array([[0.0, 1e-9, 0.0], [0.0, -1e-9, 0.0]])}, "positions"),
        ({"seed": "a"}, "seed"),
        ({"positions": np.zeros((2, 2))}, "positions"),
        ({"positions": np.full((2, 3), np.inf)}, "positions"),
        ({"positions": np.zeros((2, 3))}, "positions"),  # coincident robots
        ({"moments": np.zeros((3, 3))}, "moments"),
        ({"moments": np.zeros((2, 3))}, "moments"),  # no direction
        ({"initial": np.zeros(15)}, "initial"),
        ({"initial": np.full(10, np.nan)}, "initial"),
        ({"starts": 0}, "starts"),
        ({"starts": -1}, "starts"),
        ({"starts": 2.5}, "starts"),
        ({"method": "magic"}, "method"),
        ({"force_scale_n": 0.0}, "force_scale_n"),
        ({"torque_scale_nm": -1.0}, "torque_scale_nm"),
        ({"force_scale_n": 1e-300}, "force_scale_n"),
        ({"torque_scale_nm": "a"}, "torque_scale_nm"),
    ],
    ids=lambda v: v if isinstance(v, str) else "-".join(f"{k}={np.shape(x) or x}" for k, x in v.items()),
)
def test_allocation(changes: dict[str, Any], name: str) -> None:
    with pytest.raises(ValueError, match=f"^Input {name} must be .+; instead received"):
        allocate(**problem(**changes))


def test_action_mode() -> None:
    with pytest.raises(ValueError, match=told("action", "one of home, pose, step, wrench, velocity", "push")):
        Actions("push", System())  # type: ignore[arg-type]


@pytest.mark.parametrize("separation", [0.0119, 0.1001, -0.03, math.nan])
def test_separation(separation: float) -> None:
    with pytest.raises(ValueError, match=told("separation_m", "from 0.012 to 0.100", separation)):
        shaped("approach", separation)


def test_shape() -> None:
    with pytest.raises(ValueError, match=told("shape", "one of approach, crossing, meeting, eight, still", "circle")):
        shaped("circle", 0.03)


def test_observation_that_cannot_be_unpacked(make_env: MakeEnv) -> None:
    env = make_env()
    with pytest.raises(ValueError, match=told("observation", "of shape (..., 63)", (62,))):
        unpack(np.zeros(62), env.layout)
    with pytest.raises(ValueError, match=r"^Input observation must be full: errors alone do not tell the poses"):
        unpack(np.zeros(8), make_env(observation="errors").layout)
