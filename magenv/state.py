"""All that the kernels of a step know of many episodes, in one argument.

A kernel that is called from Python unpacks each argument anew; thirty arrays cost as much as a short hold. Here they
are unpacked once. The arrays stay numpy's: whoever holds them sees what the kernels write.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from numba import types
from numba.experimental import structref
from numba.extending import intrinsic
from numpy.typing import NDArray

from magenv.kernels import kernel, uncounted
from magenv.magnets import Size
from magenv.steering_cost import Steering
from magenv.streams import Keys
from magenv.travel import Motion

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]
Observations = NDArray[np.float32]


class State(NamedTuple):
    """``n`` episodes: what changes, what is told, and the parameters; see ``World`` and ``Episodes`` for the former."""

    robots: Floats
    """(n, 2, 6)"""
    epms: Floats
    """(n, N, 6)"""
    constants: Floats
    """(n, 10) of a substep, see ``dynamics.constants``."""
    mass: Floats
    """(n, 2) kg"""
    epm_moment: Floats
    """(n, N) A m^2"""
    epm_size: Size
    """See ``magnets``."""
    coefficients: Floats
    """(n or 1, 32, 2, 3, 4)"""
    duration: Floats
    """(n or 1,) s"""
    step: Integers
    """(n,) control periods since the start."""
    numbers: Floats
    """(6, n) rows named by ``Measurements.NUMBERS``."""
    counts: Integers
    """(2, n) rows named by ``Measurements.COUNTS``."""
    period: float
    substeps: int
    loss_distance: float
    tracking_distance: float
    diameter: float
    wall_radius: float
    motion: Motion
    routes: Floats
    """See ``hold.hold_rows``, as the next three."""
    queue: Floats
    slow: Floats
    rubs: tuple[float, float, float]
    uncertain: bool
    """Whether anything of the plant is drawn; see ``uncertainty``, as for the next ten."""
    plant_keys: Keys
    plant_key: Keys
    mismatch: float
    nominal: tuple[float, ...]
    inertia: Floats
    drag_linear: Floats
    drag_rotational: Floats
    ipm_moments: Floats
    substep: float
    noise_position: float
    noise_heading: float

    targets: Floats
    """(n, N, 6) commanded EPMs."""
    projected: Bools
    """(n,) whether the least gap or reach made them differ from the action."""
    solver: Integers
    """(n,) how the search for poses ended in ``wrench`` and ``velocity``, codes into ``outcome.OUTCOMES``; else 0."""
    home: Floats
    """(5 N,) pose at home."""
    low: Floats
    """(5 N,) bounds of poses."""
    high: Floats
    limits: Floats
    """(7,) least and greatest radius, least gap, shell of the arms, m: see ``reach.make_allowed``."""
    wrench_starts: Floats
    """(k, 5 N) starts of the allocation."""
    wrench_scale: Floats
    """(10,)"""
    steering: Steering
    ipm_moment: float
    nominal_epm_moment: float

    offsets: Floats
    """(n, k, 6) starts drawn ahead."""
    used: Integers
    """(n,) so many of them are used."""
    position_sd: float
    heading_sd: float
    held_epms: Floats
    """(n, 1 or 0, N, 6) where they start instead of at home: each row's, all rows', or no such thing."""
    home_epms: Floats
    """(N, 6) in the robots' frame."""

    every: Bools
    """(n,) all true."""
    measured: Floats
    """(n, 2, 3) poses of the robots at this control instant."""
    before: Floats
    """(n, 2, 3) and at the one before."""
    expected: Floats
    """(n, 12) state of the robots as the last hold was to bring it about, in ``velocity``; at rest at first."""
    paid: Floats
    """(3, n) reward terms, then the reward."""
    ended: Bools
    """(2, n) terminated, truncated."""
    time: Floats
    """(n,) s"""
    references: Floats
    """(n, 2, 3) at that time."""
    poses: Floats
    """(n, 5 N) of the EPMs."""
    r_max: float
    carried: bool
    bounds: Observations
    """(d,) of an observation."""
    action: Floats
    """(1, size) of a single episode, taken by ``step_one``."""
    observation: Observations
    """(1, d) of a single episode."""


@structref.register
class _PackedType(types.StructRef):
    """Numba's type of a packed state."""


class _Packed(structref.StructRefProxy):
    """A packed state, as Python sees it."""

    arrays: State


structref.define_proxy(_Packed, _PackedType, State._fields)  # type: ignore[no-untyped-call]


def _pack_parts(typing_context: Any, state: Any) -> Any:
    parts = tuple(zip(state.fields, state.types, strict=True))
    packed = _PackedType(parts)  # type: ignore[no-untyped-call]
    new: Any = structref.new

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        one = context.compile_internal(builder, lambda: new(packed), packed(), ())
        for i, (name, kind) in enumerate(parts):
            put = context.get_setattr(name, types.void(packed, kind))
            put(builder, (one, builder.extract_value(arguments[0], i)))
        return one

    return packed(state), generate


pack_parts = cast("Callable[[State], _Packed]", intrinsic(_pack_parts))
"""Return a packed state of these parts: its own constructor, of an argument each, took long to compile."""


@kernel
def _pack(state: State) -> _Packed:
    return pack_parts(uncounted(state))


def packed(state: State) -> State:
    """Return the state as one argument of kernels, in which its parts have the same names; nothing is copied."""
    one = _pack(state)
    one.arrays = state  # which kernels see without owning them live as long as what they see them by
    return cast("State", one)


def type_of(state: State) -> Any:
    """Return numba's type of a packed state, to compile a kernel for it beforehand."""
    return cast("_Packed", state)._numba_type_
