"""The inverse: time and quality of the allocation on the fixed problems, against IPOPT from the same starts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import combinations

import numpy as np

from benchmarks import ipopt
from benchmarks.measure import EXTRA, Contestant, Effort, Floats, installed, on_cores, side_by_side, tell
from benchmarks.peak import gain_of_two, multiply_adds
from benchmarks.table import LeftOut, Limit, Line, Row
from benchmarks.targets import CLASSES, STARTS, Problem, TargetClass, problem, starts
from magenv.allocation import Method, Solution, allocate, allocate_batch, component_scales
from magenv.poses import to_cartesian

TITLE = "Allocation"

TIME_S: dict[TargetClass, float] = {"A": 1.0e-3, "B": 2.5e-3, "C": 5.0e-3}
MET = 1e-8
"""Relative residual of a target that is met."""
SHARE_OF_TARGETS: dict[TargetClass, float] = {"A": 1.0, "B": 1.0, "C": 0.95}
MOVED = 0.02
"""By how much the target of a warm start has moved, as a share of its scaled norm."""
FEASIBLE_M = 1e-9
WARM_S = 0.05e-3
INTERIOR_POINT: Method = "interior-point"
SCIPY: tuple[Method, ...] = ("trust-constr", "SLSQP")
SCIPY_TARGETS = 10


def measure(effort: Effort) -> Iterator[Line]:
    """Measure all of this part."""
    allocate(*problem("A", 0))  # compiles
    with on_cores(1):
        for target_class in CLASSES:
            yield from _class(target_class, effort)
        yield from _warm(effort)
        yield from _scipy(effort)
    yield from _batch(effort)


def _class(target_class: TargetClass, effort: Effort) -> Iterator[Line]:
    """Ten starts on every target of a class."""
    peer = installed("casadi")
    ours, theirs, residuals, bests, feasible = [], [], [], [], 0
    for index in range(effort.targets):
        given = problem(target_class, index)
        if peer:
            best, start_s = ipopt.best(given, starts(index, given.system))
            bests.append(best)
            theirs.append(STARTS * start_s)
        took = []
        for _ in range(effort.repeats):
            before = time.perf_counter()
            solution = allocate(*given, seed=index)
            took.append(time.perf_counter() - before)
        ours.append(float(np.median(took)))
        residuals.append(solution.relative_residual)
        feasible += is_feasible(solution, given)
        tell(f"class {target_class}: target {index + 1} of {effort.targets}")
    what, unit = f"class {target_class}, ten starts", f"of {effort.targets}"
    limit = Limit(TIME_S[target_class], "s", at_least=False)
    if peer:
        ratio = float(np.median(np.array(theirs) / np.array(ours)))
        yield Row(what, float(np.median(ours)), "s", "IPOPT", float(np.median(theirs)), ratio, limit)
    else:
        yield Row(what, float(np.median(ours)), "s", wanted=limit)
    wanted = Limit(float(np.ceil(SHARE_OF_TARGETS[target_class] * effort.targets)), unit)
    met = _met(residuals)
    if target_class == "A":
        met_by_peer = _met(bests) if peer else float("nan")
        name = "IPOPT" if peer else ""
        yield Row(f"{what}: relative residual below {MET:g}", met, unit, name, met_by_peer, wanted=wanted)
    elif peer:
        matched = sum(mine <= 1.01 * best + MET for mine, best in zip(residuals, bests, strict=True))
        worst = max(mine / (best + MET) for mine, best in zip(residuals, bests, strict=True))
        note = f"{met} below {MET:g}; largest share of IPOPT's residual {worst:.3g}"
        yield Row(f"{what}: residual at most 1.01 x IPOPT's best + {MET:g}", matched, unit, wanted=wanted, note=note)
    else:
        yield LeftOut(f"{what}: residual against IPOPT's best", f"casadi is not installed: {EXTRA}")
    everywhere = Limit(effort.targets, unit)
    yield Row(f"{what}: feasible to {FEASIBLE_M:g} m", feasible, unit, wanted=everywhere)


def is_feasible(solution: Solution, given: Problem) -> bool:
    """Return whether radii and gaps of the returned pose are within their limits."""
    centres, _ = to_cartesian(solution.pose)
    radii = np.linalg.norm(centres, axis=1)
    system = given.system
    inside = bool(np.all((radii >= system.r_min_m - FEASIBLE_M) & (radii <= system.r_max_m + FEASIBLE_M)))
    gaps = [float(np.linalg.norm(a - b)) for a, b in combinations(centres, 2)]
    return inside and min(gaps) >= system.gap_min_m - FEASIBLE_M


def moved(given: Problem, rng: np.random.Generator) -> Floats:
    """Return the target moved in a random direction."""
    scales = component_scales()
    step = rng.normal(size=len(scales))
    step *= MOVED * np.linalg.norm(given.target / scales) / np.linalg.norm(step)
    return given.target + step * scales


def _warm(effort: Effort) -> Iterator[Row]:
    """Class A again from the solution of a target nearby, random starts only where that fails."""
    rng = np.random.default_rng(0)
    ours, met, fell_back = [], 0, 0
    count = 5 * effort.targets
    for index in range(count):
        given = problem("A", index)
        before_move = allocate(*given, seed=index)
        target = moved(given, rng)
        took = []
        for _ in range(effort.repeats):
            before = time.perf_counter()
            solution = allocate(target, *given[1:], initial=before_move.pose, seed=index, stop_early=True)
            took.append(time.perf_counter() - before)
        ours.append(float(np.median(took)))
        met += solution.relative_residual < MET
        fell_back += solution.starts > 1
    what = f"warm start, class A moved by {100 * MOVED:g} %"
    note = f"{fell_back} of {count} went on to random starts; mean {1e3 * np.mean(ours):.3g} ms"
    yield Row(what, float(np.median(ours)), "s", wanted=Limit(WARM_S, "s", at_least=False), note=note)
    yield Row(f"{what}: relative residual below {MET:g}", met, f"of {count}")


def _scipy(effort: Effort) -> Iterator[Row]:
    """One start on targets of class A, against SciPy's interior point and its sequential least squares."""
    count = min(effort.targets, SCIPY_TARGETS)
    times: dict[Method, list[float]] = {method: [] for method in (INTERIOR_POINT, *SCIPY)}
    residuals: dict[Method, list[float]] = {method: [] for method in times}
    for index in range(count):
        given = problem("A", index)
        for method in times:
            before = time.perf_counter()
            solution = allocate(*given, seed=index, starts=1, method=method)
            times[method].append(time.perf_counter() - before)
            residuals[method].append(solution.relative_residual)
        tell(f"class A, one start: target {index + 1} of {count}")
    ours = times.pop(INTERIOR_POINT)
    ours_met, wanted = _met(residuals.pop(INTERIOR_POINT)), f"of {count} below {MET:g}"
    for method, theirs in times.items():
        ratio = float(np.median(np.array(theirs) / np.array(ours)))
        reached = f"relative residual {np.median(residuals[method]):.2g} in the median"
        note = (
            f"same start and exact gradients; {ours_met} {wanted}, of the peer {_met(residuals[method])}, its {reached}"
        )
        yield Row(
            "class A, one start",
            float(np.median(ours)),
            "s",
            f"SciPy {method}",
            float(np.median(theirs)),
            ratio,
            note=note,
        )


def _met(residuals: list[float]) -> int:
    return sum(residual < MET for residual in residuals)


def _batch(effort: Effort) -> Iterator[Row]:
    """Class A in one call, against one by one, and two threads against one."""
    given = [problem("A", index) for index in range(effort.batch)]
    system = given[0].system
    targets, positions, moments = (np.stack(values) for values in list(zip(*given, strict=True))[:3])

    def one_by_one() -> None:
        for one in given:
            allocate(*one)

    def at_once(threads: int) -> Callable[[], object]:
        return lambda: allocate_batch(targets, positions, moments, system, threads=threads)

    times = side_by_side(
        {
            "two threads": Contestant(at_once(2), effort.batch, cores=2),
            "two of the machine": multiply_adds(2),
            "one thread": Contestant(at_once(1), effort.batch),
            "one of the machine": multiply_adds(1),
            "one by one": Contestant(one_by_one, effort.batch),
        },
        effort.repeats,
    )
    what = f"{effort.batch:,} targets of class A in one call"
    machine = gain_of_two(times.speedup("two of the machine", "one of the machine"))
    for name, peer, limit, note in (
        ("one thread", "one by one", 1.0, "per target"),
        ("two threads", "one thread", 1.7, f"per target; {machine}"),
    ):
        ratio = times.speedup(name, peer)
        seconds, theirs = times.seconds(name), times.seconds(peer)
        yield Row(f"{what}, {name}", seconds, "s", peer, theirs, ratio, Limit(limit), note=note)
