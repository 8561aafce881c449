"""What makes the batch fast, and that it changes no bit: lanes, threads, machine code, starts drawn ahead."""

from __future__ import annotations

import gc
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import llvmlite.binding
import numba
import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from numba.extending import overload
from numpy.typing import NDArray

from magenv import kernels
from magenv.allocation import allocate, allocate_batch
from magenv.env import TwoRobots
from magenv.hold import hold_rows, hold_shape
from magenv.kernels import in_cache_lines
from magenv.params import PLANTS, System, TaskParams
from magenv.solver import best_of, descend
from magenv.steps import one_kernel, step_kernel
from magenv.trajectories import shaped
from magenv.vector_env import TwoRobotsVector
from magenv.workers import Workers
from magenv.world import World

N = 37
"""Episodes: more than the lanes, and no multiple of them."""
STEPS = 40

Steps = list[tuple[NDArray[Any], ...]]


def actions(row: int, step: int, size: int) -> NDArray[np.float32]:
    """Actions that differ from row to row and from step to step, some gentle, some wild."""
    rng = np.random.default_rng([row, step])
    return (rng.uniform(-1, 1, size) * [0.1, 1.0][row % 2]).astype(np.float32)


def batch(n: int, first: int, threads: int = 1, **arguments: Any) -> Steps:
    """Observations, rewards and flags of episodes of seeds ``first``, ``first`` + 1, ..."""
    env = TwoRobotsVector(n, threads=threads, **arguments)
    size = env.single_action_space.shape[0]  # type: ignore[index]
    told: Steps = [(env.reset(seed=first)[0],)]
    for step in range(STEPS):
        told.append(env.step(np.stack([actions(first + row, step, size) for row in range(n)]))[:4])
    return told


def same(one: Steps, two: Steps, rows: slice) -> bool:
    return all(
        a[rows].tobytes() == b.tobytes() for x, y in zip(one, two, strict=True) for a, b in zip(x, y, strict=True)
    )


@pytest.mark.parametrize(
    ("scenario", "plant", "n_epm"),
    [
        ("approach-45", "paper", 2),
        ("approach-45", "paper", 3),
        ("random", "paper", 2),
        ("random", "paper", 3),
        ("approach-45", "moving", 2),
        ("approach-45", "moving", 3),
        ("approach-45", "cylinders", 2),
        ("approach-45", "arm", 3),
    ],
)
def test_bits_depend_neither_on_lanes_nor_on_threads(scenario: str, plant: str, n_epm: int) -> None:
    """Many, few and single episodes, one to three threads, through many starts."""
    arguments = {"scenario": scenario, "plant": plant, "n_epm": n_epm, "control_hz": 10.0}
    together = batch(N, 0, **arguments)
    flags = np.array([step[2] for step in together[1:]])
    assert flags.any(axis=0).mean() > 0.9, "most episodes must end and begin anew"
    for threads in (2, 3):
        assert same(together, batch(N, 0, threads, **arguments), slice(None))
    for first, n in ((0, 5), (20, 17), (3, 1)):
        assert same(together, batch(n, first, **arguments), slice(first, first + n))


def test_a_scalar_environment_gives_the_bits_of_a_row_beyond_what_is_drawn_ahead() -> None:
    together = batch(N, 0, scenario="random", control_hz=2.0)
    env, row = TwoRobots(scenario="random", control_hz=2.0), 5
    observation, ended, begun = env.reset(seed=row)[0], False, 0
    for step, told in enumerate(together):
        assert observation.tobytes() == told[0][row].tobytes()
        if ended:
            observation, ended = env.reset()[0], False
            begun += 1
        else:
            observation, _, terminated, truncated, _ = env.step(actions(row, step, 10))
            ended = terminated or truncated
    assert begun > 5


def test_many_starts_go_on_along_one_stream() -> None:
    """A hundred episodes, more than are drawn at a time: none comes twice, and a new seed begins anew."""
    env = TwoRobots(scenario="random")
    first = [env.reset(seed=0)[0]] + [env.reset()[0] for _ in range(99)]
    again = [env.reset(seed=0)[0]] + [env.reset()[0] for _ in range(99)]
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(first, axis=0)) == 100


def test_a_generator_put_in_place_is_drawn_from() -> None:
    env = TwoRobots(scenario="approach-60")
    expected = env.reset(seed=3)[0]
    env.reset(seed=4)
    env.np_random = np.random.Generator(np.random.PCG64(np.random.SeedSequence(3)))
    np.testing.assert_array_equal(env.reset()[0], expected)


def test_one_trajectory_is_kept_once() -> None:
    """Rows of a named scenario share their reference; rows with one of their own give the same motion."""
    system, task, trajectory = System(), TaskParams(), shaped("approach", 0.05)
    plant = TwoRobotsVector(1)._episodes.plant
    shared, own = World(20, system, plant, task, trajectory), World(20, system, plant, task)
    assert len(shared.coefficients) == 1
    robots, epms = np.zeros((2, 6)), np.zeros((2, 6))
    robots[:, :3], epms[:, 2], epms[:, 3] = trajectory.at(0.0), 0.2, 1.0
    epms[1, 2] = -0.2
    for row in range(20):
        own.start(row, trajectory, robots, epms)
        shared.robots[row] = robots
    shared.begin(np.ones(20, np.bool_))
    targets = np.tile(epms, (20, 1, 1))
    one, two = (world.step(targets, np.ones(20, np.bool_)) for world in (shared, own))
    np.testing.assert_array_equal(shared.robots, own.robots)
    np.testing.assert_array_equal(one.numbers, two.numbers)


def test_nan_in_a_lane_never_touches_its_neighbours() -> None:
    """One poisoned row of many, lost at once; the others keep their bits through the steps that follow."""
    sick, well = (TwoRobotsVector(N, scenario="approach-60", control_hz=20.0) for _ in range(2))
    sick.reset(seed=0)
    well.reset(seed=0)
    sick._episodes.world.robots[7, 0, 3] = np.nan
    others = np.arange(N) != 7
    for step in range(6):
        command = np.stack([actions(row, step, 10) for row in range(N)])
        a, b = sick.step(command)[:4], well.step(command)[:4]
        assert all(one[others].tobytes() == two[others].tobytes() for one, two in zip(a, b, strict=True))
        assert np.isfinite(a[0]).all()
        assert step > 0 or a[2][7]


# Machine code


def machine_code(plant: str, n_epm: int = 2) -> Any:
    """The hold in sixteen lanes, compiled here: numba does not show cached code."""
    cached: Any = hold_rows
    world, idle = World(16, System(n_epm=n_epm), PLANTS[plant], TaskParams()), np.zeros(16, np.bool_)
    _, _, *how = world.shape
    fresh = numba.njit(error_model="numpy", nogil=True)(cached.py_func)
    fresh(0, 16, idle, world.robots, world.epms, world.epms, *world.held, *hold_shape(n_epm, 16, *how))
    return fresh


@pytest.fixture(scope="module")
def compiled() -> Any:
    return machine_code("paper")


def check_vectors(fresh: Any, least: int) -> None:
    """Sums of products, ``least`` or more, work on several lanes at once: as many as the processor has."""
    (assembly,) = fresh.inspect_asm().values()
    registers = re.findall(r"\bvfn?m(?:add|sub)\d+pd\b[^\n]*%([xyz]mm)\d+$", assembly, re.M)
    assert len(registers) >= least
    wide = llvmlite.binding.get_host_cpu_features().get("avx512f", False)
    assert set(registers) == {"zmm" if wide else "ymm"}
    assert not re.search(r"\bv?(mul|add)ps\b", assembly), "nothing is rounded to single precision"


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="looks for x86 instructions")
def test_substeps_are_vectorised(compiled: Any) -> None:
    """Five dipoles, 25 sums of products each."""
    check_vectors(compiled, 5 * 25)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="looks for x86 instructions")
@pytest.mark.parametrize(("plant", "n_epm"), [("paper", 3), ("moving", 2), ("moving", 3), ("arm", 3)])
def test_substeps_of_more_epms_and_of_moving_ones_are_vectorised(plant: str, n_epm: int) -> None:
    """Beside the dipoles of the EPMs and the robots, two ways of each EPM that moves: eight sums of products each."""
    check_vectors(machine_code(plant, n_epm), (1 + 2 * n_epm) * 25 + (2 * n_epm * 8 if plant != "paper" else 0))


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="looks for x86 instructions")
def test_cylinders_are_vectorised() -> None:
    """Two EPMs' two ends at each of two robots, eight roots and more of each."""
    (assembly,) = machine_code("cylinders").inspect_asm().values()
    assert len(re.findall(r"\bvsqrtpd\b", assembly)) >= 8 * 8


def test_the_hold_allocates_before_its_loops_and_calls_nothing_within(compiled: Any) -> None:
    """No Python object, no function but that of a contact and roots; four arrays of scratch, however many rows."""
    (ir,) = compiled.inspect_llvm().values()
    functions = re.findall(r"^define .*?^}", ir, re.S | re.M)
    (body,) = [text for text in functions if re.match(r'define [^\n]*@"?_ZN6magenv4hold', text)]
    calls = re.findall(r'call [^@\n]*@"?([^"(\s]+)', body)
    contact = re.compile(r"hypot|sqrt|_ZN6magenv8dynamics15resolve_contact.*")
    assert all(name.startswith(("NRT_", "llvm.")) or contact.fullmatch(name) for name in calls)
    assert not re.search(r"llvm\.(sin|cos|exp|log|pow)", " ".join(calls))
    assert sum("alloc" in name.lower() for name in calls) <= 4


def test_the_lanes_begin_with_a_cache_line() -> None:
    @numba.njit
    def beginnings(rows: int, times: int) -> list[int]:
        arrays = [in_cache_lines(rows, 16) for _ in range(times)]
        for array in arrays:
            array[:] = 1.0
        return [array.ctypes.data for array in arrays]

    assert not any(at % 64 for rows in (1, 7, 78) for at in beginnings(rows, 10))


@pytest.mark.parametrize("make", [step_kernel, one_kernel])
def test_kernels_close_over_no_kernel(make: Any) -> None:
    """Numba's key of what is on disk would be another in every process."""
    made = make("home", *World(1, System(), PLANTS["paper"], TaskParams()).shape)
    assert made.py_func.__closure__
    assert not any(isinstance(cell.cell_contents, Dispatcher) for cell in made.py_func.__closure__)


@pytest.mark.parametrize("collected", [True, False])
def test_garbage_is_collected_after_compilation_as_before(collected: bool) -> None:
    seen: list[bool] = []

    def watched(law: Callable[[float], float]) -> Any:
        """A kernel, not kept on disk, that looks on while it is compiled."""

        def within(x: float) -> float:
            return x

        @overload(within)
        def looking_on(x):  # type: ignore[no-untyped-def]  # numba wants the signature of what is returned
            seen.append(gc.isenabled())
            return law

        compiled = numba.njit(lambda x: within(x))
        kernels._OURS.add(compiled)
        return compiled

    before = gc.isenabled()
    (gc.enable if collected else gc.disable)()
    try:
        assert watched(lambda x: 2.0 * x)(1.0) == 2.0
        seen.append(gc.isenabled())
        with pytest.raises(numba.core.errors.TypingError):
            watched(lambda x: x + "")(1.0)  # type: ignore[operator, return-value]
        seen.append(gc.isenabled())
    finally:
        (gc.enable if before else gc.disable)()
    assert not seen[0]
    assert not any(seen[2:-1])
    assert seen[1] == seen[-1] == collected


# Threads


@pytest.mark.parametrize("threads", [0, -1, True, 1.5, "2"])
def test_threads_must_be_a_whole_number(threads: Any) -> None:
    with pytest.raises(ValueError, match=r"Input threads must be a whole number of at least 1"):
        Workers(threads)


def test_every_row_is_run_once_and_errors_are_told() -> None:
    for at_once in (None, 1, 3, 50):
        seen: list[int] = []
        Workers(3, at_once).run(lambda first, last, seen: seen.extend(range(first, last)), 20, seen)
        assert sorted(seen) == list(range(20))

    def fail(first: int, last: int) -> None:
        if last == 20:
            raise ArithmeticError

    with pytest.raises(ArithmeticError):
        Workers(3).run(fail, 20)


FORK = """
import os, sys
import numpy as np
from magenv.vector_env import TwoRobotsVector
env = TwoRobotsVector(8, scenario="approach-60", threads=2)
env.reset(seed=0)
env.step(np.zeros((8, 10), np.float32))
child = os.fork()
again = env.step(np.zeros((8, 10), np.float32))[0]
assert np.isfinite(again).all()
if child == 0:
    os._exit(0)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(platform.system() == "Windows", reason="needs fork")
def test_a_fork_after_a_threaded_step_works() -> None:
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORK], check=True, timeout=120)


def test_the_solver_is_compiled_once_for_all_who_call_it() -> None:
    """Half a minute each: for one allocation, for many, for the wrench action of one episode and of many."""
    positions, moments = [[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]], [[0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]
    allocate(np.full(10, 1e-4), positions, moments, System(), starts=1)
    allocate_batch(np.full((2, 10), 1e-4), positions, moments, System(), starts=1)
    one, many = TwoRobots(action="wrench"), TwoRobotsVector(5, action="wrench")
    one.reset(seed=0)
    one.step(np.zeros(6, np.float32))
    many.reset(seed=0)
    many.step(np.zeros((5, 6), np.float32))
    assert len(best_of.nopython_signatures) == 1  # type: ignore[attr-defined]
    # none where the machine code of its callers came from the disk: whether it does depends on what ran before
    assert len(descend.nopython_signatures) <= 1  # type: ignore[attr-defined]
