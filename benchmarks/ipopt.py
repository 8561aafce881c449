"""IPOPT on the allocation problems, from the same ten starts: the oracle of tests and benchmarks.

``python -m benchmarks.ipopt`` writes the best relative residuals to ``tests/data/allocation_ipopt.json``. It takes
about a minute and needs casadi (``pip install magenv[bench]``).
"""

from __future__ import annotations

import json
import math
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.targets import CLASSES, STARTS, TARGETS, Problem, problem, starts
from magenv.allocation import component_scales
from magenv.params import MU_0
from magenv.poses import POSE_SIZE
from magenv.solver import make_interior
from magenv.wrench import N_ROBOTS, magnet_frame

Floats = NDArray[np.float64]

FILE = Path(__file__).parents[1] / "tests" / "data" / "allocation_ipopt.json"
COMMAND = "python -m benchmarks.ipopt"
OPTIONS = {"tol": 1e-8, "max_iter": 1000, "print_level": 0, "sb": "yes"}


def _wrench(given: Problem, pose: Any) -> Any:
    """Return U as a casadi expression of the pose, written out anew from the laws."""
    import casadi as ca

    def pair(source: Any, target: Any, r: Any) -> tuple[Any, Any]:
        along = ca.dot(source, r)
        distance = ca.norm_2(r)
        field = MU_0 / (4 * math.pi) * (3 * along * r / distance**5 - source / distance**3)
        bracket = source @ r.T + r @ source.T + along * (ca.DM.eye(3) - 5 * (r @ r.T) / distance**2)
        return ca.cross(target, field), 3 * MU_0 / (4 * math.pi) / distance**5 * bracket @ target

    def unit(azimuth: Any, elevation: Any) -> Any:
        return ca.vertcat(ca.cos(elevation) * ca.cos(azimuth), ca.cos(elevation) * ca.sin(azimuth), ca.sin(elevation))

    sources = []
    for at in range(0, POSE_SIZE * given.system.n_epm, POSE_SIZE):
        centre = pose[at + 2] * unit(pose[at], pose[at + 1])
        sources.append((centre, given.system.epm_moment_am2 * unit(pose[at + 3], pose[at + 4])))
    rows = []
    for robot in range(N_ROBOTS):
        here, moment = ca.DM(given.positions[robot]), ca.DM(given.moments[robot])
        mutual = (ca.DM(given.positions[1 - robot]), ca.DM(given.moments[1 - robot]))
        frame = np.empty((3, 3))
        magnet_frame(given.moments[robot], frame)
        torque, force = ca.DM.zeros(3), ca.DM.zeros(3)
        for centre, source in [mutual, *sources]:
            tau, f = pair(source, moment, here - centre)
            torque, force = torque + tau, force + f
        rows += [ca.DM(frame[1:]) @ torque, ca.DM(frame) @ force]
    return ca.vertcat(*rows)


def best(given: Problem, poses: Floats) -> tuple[float, float]:
    """Return IPOPT's least relative residual from the starts (M, 5 N), and the median time of a start in s."""
    import time

    import casadi as ca

    system = given.system
    scales = component_scales()
    x = ca.SX.sym("x", POSE_SIZE * system.n_epm)
    error = (_wrench(given, x) - ca.DM(given.target)) / ca.DM(scales) / float(np.linalg.norm(given.target / scales))
    centres = [
        x[at + 2] * ca.vertcat(ca.cos(x[at + 1]) * ca.cos(x[at]), ca.cos(x[at + 1]) * ca.sin(x[at]), ca.sin(x[at + 1]))
        for at in range(0, POSE_SIZE * system.n_epm, POSE_SIZE)
    ]
    gap = system.gap_min_m
    gaps = [
        (ca.sumsqr(centres[i] - centres[j]) - gap**2) / (2 * gap)
        for i in range(system.n_epm)
        for j in range(i + 1, system.n_epm)
    ]
    low, high = np.full(x.numel(), -np.inf), np.full(x.numel(), np.inf)
    low[2::POSE_SIZE], high[2::POSE_SIZE] = system.r_min_m, system.r_max_m
    nlp = {"x": x, "f": 0.5 * ca.sumsqr(error), "g": ca.vertcat(*gaps)}
    options: Any = {"ipopt": OPTIONS, "print_time": False, "error_on_fail": False}
    solver = ca.nlpsol("ipopt", "ipopt", nlp, options)
    residuals, times = [math.inf], []
    for start in poses.copy():
        make_interior(start, system.r_min_m, system.r_max_m, gap)
        before = time.perf_counter()
        result = solver(x0=start, lbx=low, ubx=high, lbg=0.0, ubg=np.inf)
        times.append(time.perf_counter() - before)
        if not len(gaps) or float(np.min(result["g"])) >= -1e-7:
            residuals.append(math.sqrt(2 * float(result["f"])))
    return min(residuals), float(np.median(times))


def main() -> None:
    """Solve all problems and write the file."""
    table: dict[str, list[float]] = {}
    for n_epm in (2, 3):
        for target_class in CLASSES:
            found = []
            for index in range(TARGETS):
                given = problem(target_class, index, n_epm)
                found.append(best(given, starts(index, given.system)))
            table[f"{target_class}{n_epm}"] = [residual for residual, _ in found]
            milliseconds = 1e3 * STARTS * float(np.median([time for _, time in found]))
            print(f"class {target_class}, {n_epm} EPMs: {milliseconds:.0f} ms for ten starts")
    FILE.parent.mkdir(exist_ok=True)
    made = {"command": COMMAND, "casadi": version("casadi"), "ipopt_options": OPTIONS, "starts": STARTS}
    FILE.write_text(json.dumps({**made, "best_relative_residual": table}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
