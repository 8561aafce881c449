"""Physical and task parameters: frozen dataclasses, SI units, derived values as properties.

Every value says where it comes from: **paper** (Davy et al. 2023), **literature** (source named) or **calibrated**
(chosen so that the paper's controller shows the paper's outcome; see README, "Where the numbers come from").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from numbers import Integral, Real
from typing import Any

import numpy as np

MU_0 = 4e-7 * math.pi
"""Vacuum permeability in H/m, the value of the paper."""


class InputError(ValueError):
    """What was passed in is not what it must be: the user's to mend, unlike any other ``ValueError``."""


def require(condition: bool, name: str, must_be: str, received: object) -> None:
    """Raise ``InputError`` in the one form used for all bad input of this package."""
    if not condition:
        raise InputError(f"Input {name} must be {must_be}; instead received {received!r}.")


def common_shape(**shapes: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape to which named shapes broadcast, or raise ``InputError``."""
    try:
        return np.broadcast_shapes(*shapes.values())
    except ValueError:
        names, received = ", ".join(shapes), list(shapes.values())
        raise InputError(
            f"Input {names} must be of leading axes that broadcast; instead received {received}."
        ) from None


def _is_number(value: object) -> bool:
    """Return whether a value is a finite number, Python's or numpy's, and no bool."""
    return not isinstance(value, bool) and isinstance(value, Real) and math.isfinite(value)


def is_whole(value: object) -> bool:
    """Return whether a value is a whole number by its type, Python's or numpy's, and no bool."""
    return isinstance(value, (int, Integral)) and not isinstance(value, bool)


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        require(_is_number(value) and value > 0, name, "a positive, finite number", value)


@dataclass(frozen=True)
class Magnet:
    """Cylindrical permanent magnet, uniformly magnetised along its axis."""

    diameter_m: float
    length_m: float
    remanence_t: float = 1.48
    """Remanence of NdFeB N52 (literature: upper end of the grade's 1.43 to 1.48 T)."""

    def __post_init__(self) -> None:
        _require_positive(diameter_m=self.diameter_m, length_m=self.length_m, remanence_t=self.remanence_t)

    @property
    def volume_m3(self) -> float:
        """Volume in m^3."""
        return math.pi / 4 * self.diameter_m**2 * self.length_m

    @property
    def moment_am2(self) -> float:
        """Magnetic moment in A m^2: remanence times volume over the vacuum permeability."""
        return self.remanence_t * self.volume_m3 / MU_0


@dataclass(frozen=True)
class System:
    """The magnets and the limits of the external ones (paper, section III)."""

    n_epm: int = 2
    """Number of external permanent magnets (EPMs)."""
    ipm: Magnet = field(default_factory=lambda: Magnet(diameter_m=5e-3, length_m=5e-3))
    """The magnet inside each robot (paper)."""
    reference_epm: Magnet = field(default_factory=lambda: Magnet(diameter_m=0.1, length_m=0.1))
    """Two of these are the total magnetic volume that the EPMs share, whatever their number (paper)."""
    r_min_m: float = 0.15
    """Least distance of an EPM's centre from the workspace centre (paper)."""
    r_max_m: float = 0.5
    """Greatest distance of an EPM's centre from the workspace centre (ours: reach of a collaborative arm)."""
    attraction_max_n: float = 98.1
    """Greatest mutual attraction of two EPMs, 10 kg of payload (paper)."""

    def __post_init__(self) -> None:
        require(is_whole(self.n_epm) and self.n_epm >= 1, "n_epm", "a whole number of at least 1", self.n_epm)
        _require_positive(r_min_m=self.r_min_m, r_max_m=self.r_max_m, attraction_max_n=self.attraction_max_n)
        require(self.r_max_m > self.r_min_m, "r_max_m", f"greater than r_min_m = {self.r_min_m}", self.r_max_m)
        if self.n_epm > 1:  # two points of a sphere are at most 2 r apart, three sqrt(3) r
            room = (2.0 if self.n_epm == 2 else math.sqrt(3.0)) * self.r_max_m
            require(
                self.gap_min_m <= room,
                "attraction_max_n",
                f"so large that the gap is at most {room:.3g} m",
                self.attraction_max_n,
            )

    @property
    def ipm_moment_am2(self) -> float:
        """Moment of a robot's magnet in A m^2."""
        return self.ipm.moment_am2

    @cached_property
    def epm(self) -> Magnet:
        """The magnet that each EPM is: of the reference's shape and of its share of the volume."""
        share, one = (2.0 / self.n_epm) ** (1.0 / 3.0), self.reference_epm
        return replace(one, diameter_m=share * one.diameter_m, length_m=share * one.length_m)

    @cached_property
    def epm_moment_am2(self) -> float:
        """Moment of each EPM in A m^2: the volume of two reference magnets shared by ``n_epm``."""
        return 2.0 / self.n_epm * self.reference_epm.moment_am2

    @cached_property
    def gap_min_m(self) -> float:
        """Least distance of two EPM centres in m: there, coaxial, they attract each other with ``attraction_max_n``."""
        return float((3 * MU_0 * self.epm_moment_am2**2 / (2 * math.pi * self.attraction_max_n)) ** 0.25)


@dataclass(frozen=True)
class Body:
    """A robot's body: a disc in the plane of motion."""

    mass_kg: float = 0.010
    """Literature: 8.56 g (MagRobot, capsule of 0.126 A m^2); rounded up."""
    inertia_kgm2: float = 1e-6
    """About the vertical; a capsule of 10 g, 11 mm wide and 26 mm long, has 6e-7, and carries fluid with it."""
    drag_linear_nspm: float = 0.15
    """Viscous drag against translation, N s/m (calibrated, within 0.15 to 0.4)."""
    drag_rotational_nmsprad: float = 6.8e-5
    """Viscous drag against rotation, N m s/rad (calibrated, within 5e-5 to 2e-4)."""
    diameter_m: float = 0.011
    """Literature: commercial capsules are 10 to 12 mm wide."""

    def __post_init__(self) -> None:
        _require_positive(mass_kg=self.mass_kg, inertia_kgm2=self.inertia_kgm2, diameter_m=self.diameter_m)
        for name in ("drag_linear_nspm", "drag_rotational_nmsprad"):
            value = getattr(self, name)
            require(_is_number(value) and value >= 0, name, "a finite number of at least 0", value)


EPM_WAY_MAX_M, EPM_TURN_MAX_RAD = 0.02, 0.2
"""Greatest way and turn of an EPM in a substep: what it does halfway must stand for what it does on the way."""


@dataclass(frozen=True)
class Plant:
    """What the controllers act on: bodies, wall, integrator."""

    body: Body = field(default_factory=Body)
    workspace_radius_m: float = 0.100
    """Radius of the circular wall."""
    substep_s: float = 0.005
    """The integrator's step, fixed in seconds whatever the control rate."""
    epm_speed_mps: float = math.inf
    """Greatest speed of an EPM's centre, m/s; infinite together with the next, the EPMs jump (paper)."""
    epm_turn_radps: float = math.inf
    """Greatest angular speed of an EPM's moment, rad/s."""
    epm_acceleration_mps2: float = math.inf
    """Greatest change of an EPM's centre's speed along its way, m/s^2."""
    epm_turn_acceleration_radps2: float = math.inf
    """Greatest change of its moment's angular speed, rad/s^2."""
    latency_s: float = 0.0
    """From the instant at which the robots are measured until the command made of it acts on the EPMs, s."""
    noise_position_m: float = 0.0
    """Standard deviation of a measured position, per axis."""
    noise_heading_rad: float = 0.0
    """Standard deviation of a measured heading."""
    mismatch: float = 0.0
    """Every mass, drag and magnetic moment is drawn within this share of its nominal value, anew in each episode."""
    dry_friction_n: float = 0.0
    """Coulomb friction against a robot's translation, N."""
    dry_friction_nm: float = 0.0
    """Coulomb friction against its rotation, N m."""
    disturbance_n: float = 0.0
    """Amplitude of a slow force on each robot, per axis, N: sinusoids of 20 to 60 s, drawn anew in each episode."""
    arm_reach_m: float = math.inf
    """Greatest distance of an EPM's centre from the shoulder of the arm that carries it; infinite, no arm limits it."""
    arm_reach_min_m: float = 0.41
    """Least such distance, m: a KUKA LBR iiwa 14 R820, links of 0.42 and 0.4 m, with its elbow bent by 120 degrees."""
    arm_distance_m: float = 0.47
    """Of the shoulders from the workspace centre, level; the arms stand evenly round it (ours, as the next)."""
    arm_height_m: float = 0.45
    """Of the shoulders above the robots' plane, m: 0.36 m above what the arms stand on (data sheet)."""
    home_turn_rad: float = 0.0
    """By how much the ring on which the EPMs stand at home is turned about the robots' heading: two of them stand on a
    level at -0.593, one above the other at 0.977."""
    epm_cylinders: bool = False
    """Whether EPMs act on the robots as the cylinders that they are (``System.epm``) and not as dipoles. The robots'
    magnets stay dipoles: 20 mm apart the force between them is 1.2 % off at most, that of an EPM at 0.15 m 12 %."""

    def __post_init__(self) -> None:
        _require_positive(workspace_radius_m=self.workspace_radius_m, substep_s=self.substep_s)
        for name, other, most in (
            ("epm_speed_mps", self.epm_turn_radps, EPM_WAY_MAX_M / self.substep_s),
            ("epm_turn_radps", self.epm_speed_mps, EPM_TURN_MAX_RAD / self.substep_s),
        ):
            value = getattr(self, name)
            fits = _is_number(value) and 0.0 < value <= most and other != math.inf
            must_be = f"a number above 0 and at most {most:g}, or infinite as the other limit of the EPMs' speed is"
            require(fits or value == other == math.inf, name, must_be, value)
        for name in ("epm_acceleration_mps2", "epm_turn_acceleration_radps2"):
            value = getattr(self, name)
            require(value == math.inf or (_is_number(value) and value > 0.0), name, "a number above 0", value)
        limits = {"latency_s": 10.0, "noise_position_m": 1.0, "noise_heading_rad": math.pi, "mismatch": 0.9}
        for name in (*limits, "dry_friction_n", "dry_friction_nm", "disturbance_n"):
            value, limit = getattr(self, name), limits.get(name, math.inf)
            must_be = "a finite number of at least 0" + ("" if limit == math.inf else f" and at most {limit:g}")
            require(_is_number(value) and 0.0 <= value <= limit, name, must_be, value)
        reach, least = self.arm_reach_m, self.arm_reach_min_m
        require(reach == math.inf or (_is_number(reach) and reach > 0.0), "arm_reach_m", "a number above 0", reach)
        require(
            _is_number(least) and 0.0 <= least < reach,
            "arm_reach_min_m",
            f"a number of at least 0 and below arm_reach_m = {reach:g}",
            least,
        )
        _require_positive(arm_distance_m=self.arm_distance_m)
        require(_is_number(self.arm_height_m), "arm_height_m", "a finite number", self.arm_height_m)
        turn = self.home_turn_rad
        require(_is_number(turn) and abs(turn) <= math.pi, "home_turn_rad", "a number from -pi to pi", turn)
        require(isinstance(self.epm_cylinders, bool), "epm_cylinders", "True or False", self.epm_cylinders)
        require(
            self.workspace_radius_m > self.body.diameter_m,
            "workspace_radius_m",
            f"greater than the body's diameter {self.body.diameter_m}",
            self.workspace_radius_m,
        )

    def substeps(self, period_s: float) -> int:
        """Return how many equal substeps make up a period (s): as few as are none longer than ``substep_s``."""
        return max(1, math.ceil(period_s / self.substep_s - 1e-9))

    @property
    def epms_jump(self) -> bool:
        """Whether the EPMs are at once where they are commanded."""
        return self.epm_speed_mps == math.inf

    @property
    def is_rough(self) -> bool:
        """Whether anything but magnets and viscous drag acts on the robots."""
        return self.dry_friction_n > 0.0 or self.dry_friction_nm > 0.0 or self.disturbance_n > 0.0

    @property
    def is_noisy(self) -> bool:
        """Whether measurements are inexact."""
        return self.noise_position_m > 0.0 or self.noise_heading_rad > 0.0


PLANTS: dict[str, Plant] = {
    "paper": Plant(),
    # Ends of the ranges of drag (see README, "Where the numbers come from").
    "low-drag": Plant(body=Body(drag_linear_nspm=0.15, drag_rotational_nmsprad=5e-5)),
    "high-drag": Plant(body=Body(drag_linear_nspm=0.4, drag_rotational_nmsprad=2e-4)),
    # Data sheets of the UR5e and UR10e: typical speed of the tool 1 m/s, wrists 180 degrees/s.
    "moving": Plant(epm_speed_mps=1.0, epm_turn_radps=math.pi),
    "arm": Plant(
        # As above. Accelerations: between the defaults of URScript's movel and movej (1.2 m/s^2, 1.4 rad/s^2) and the
        # limits of a Franka arm without load (13 m/s^2, 25 rad/s^2): an EPM weighs 6 kg.
        epm_speed_mps=1.0,
        epm_turn_radps=math.pi,
        epm_acceleration_mps2=5.0,
        epm_turn_acceleration_radps2=10.0,
        latency_s=0.1,  # 20 ms of localisation (Zeng, ICRA 2026), the rest computing and the arms' controllers
        noise_position_m=1.3e-3,  # localisation of two capsules: 1.28 mm, 1.13 degrees (Zeng, ICRA 2026)
        noise_heading_rad=math.radians(1.1),
        mismatch=0.2,
    ),
    "cylinders": Plant(epm_cylinders=True),
}
# Data sheet of the LBR iiwa 14 R820: 0.82 m from axis 2 to the wrist, round whose centre the EPM may be turned anyhow.
PLANTS["arm-reach"] = replace(PLANTS["arm"], arm_reach_m=0.82)
"""The plants by name. ``paper``: EPMs jump to their commanded poses, exact localisation. ``low-drag``,
``high-drag``: the same at the ends of what robots' drag may be. ``moving``: as ``paper``, but the EPMs move there at
finite speed, and act on the robots on the way. ``arm``: they do so with finite acceleration, commands act late,
measurements are noisy, and the plant's parameters are not quite the nominal ones. ``arm-reach``: nor do the arms reach
everywhere. ``cylinders``: as ``paper``, but the EPMs are cylinders; to controllers they are dipoles on every plant."""


CONTROL_HZ_RANGE = (0.01, 1000.0)


@dataclass(frozen=True)
class TaskParams:
    """Control rate, start and limits of an episode."""

    control_hz: float = 2.0
    """Control rate (paper)."""
    start_position_sd_m: float = 1e-3
    """Standard deviation of a robot's start offset, per axis."""
    start_heading_sd_rad: float = math.radians(3.0)
    """Standard deviation of a robot's start heading offset."""
    loss_distance_m: float = 0.030
    """Control is lost where a robot is farther than this from its reference."""
    tracking_distance_m: float = 0.015
    """A robot nearer than this to its reference counts as tracking (``separation_tracked``)."""

    def __post_init__(self) -> None:
        low, high = CONTROL_HZ_RANGE
        fits = _is_number(self.control_hz) and low <= self.control_hz <= high
        require(fits, "control_hz", f"a number from {low} to {high}", self.control_hz)
        _require_positive(
            loss_distance_m=self.loss_distance_m,
            tracking_distance_m=self.tracking_distance_m,
        )
        for name in ("start_position_sd_m", "start_heading_sd_rad"):
            value = getattr(self, name)
            require(_is_number(value) and value >= 0, name, "a finite number of at least 0", value)

    @property
    def period_s(self) -> float:
        """Control period in s."""
        return 1.0 / self.control_hz


def plant_named(text: str) -> Plant:
    """Return the plant that ``text`` tells: a name, or a name and what differs, as in ``arm:latency_s=0,mismatch=0.1``.

    Raises
    ------
    ValueError
        If there is no such plant or parameter, or a value is not of its type or out of its range.
    """
    known = ", ".join(sorted(PLANTS))
    require(isinstance(text, str), "plant", f"one of {known}", text)
    name, colon, changes = text.partition(":")
    require(name in PLANTS, "plant", f"one of {known}", text)
    return replace(PLANTS[name], **_changes(text, changes)) if colon else PLANTS[name]


def _changes(text: str, changes: str) -> dict[str, Any]:
    """Return the parameters told by the second part of a plant's text."""
    known, found = {f.name: f.type for f in fields(Plant) if f.type in ("float", "bool")}, dict[str, Any]()
    for change in changes.split(","):
        name, _, value = change.partition("=")
        require(
            name in known and name not in found,
            "plant",
            "one with parameters out of " + ", ".join(known) + ", each once",
            text,
        )
        if known[name] == "bool":
            require(value in ("true", "false"), "plant", f"changed by true or false in {name}", text)
            found[name] = value == "true"
            continue
        try:
            found[name] = float(value)
        except ValueError:
            raise InputError(f"Input plant must be changed by numbers in {name}; instead received {text!r}.") from None
    return found
