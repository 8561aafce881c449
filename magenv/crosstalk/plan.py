"""Which points the analysis is made of: the paper's panels and the atlas."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from magenv.crosstalk.sweep import Task
from magenv.wrench import WRENCH_SIZE

LINE, SIDE = 0.0, 90.0
"""The first moment's angle against the line that joins the robots: in line with it, or side by side."""
ARRANGEMENTS = {LINE: "line", SIDE: "side"}
PANELS = (
    ("2-epms-orthogonal-15cm", 2, 0.15, 90.0),
    ("2-epms-parallel-15cm", 2, 0.15, 0.0),
    ("2-epms-orthogonal-5cm", 2, 0.05, 90.0),
    ("2-epms-parallel-5cm", 2, 0.05, 0.0),
    ("3-epms-parallel-15cm", 3, 0.15, 0.0),
    ("3-epms-parallel-5cm", 3, 0.05, 0.0),
)
"""The paper's six matrices: name, EPMs, distance, relative angle."""
DISTANCES_M = tuple(round(0.01 * k, 3) for k in range(2, 21))
DISTANCE_ANGLES = (0.0, 30.0, 60.0, 90.0)
ANGLES_DEG = tuple(10.0 * k for k in range(10))
ANGLE_DISTANCES_M = (0.03, 0.05, 0.1, 0.15)
FRONTIER_DISTANCES_M = (0.02, 0.03, 0.05, 0.08, 0.11, 0.15)
FRONTIER_ANGLES = (0.0, 45.0, 90.0)
FRONTIER_LIMIT = 0.05
FRONTIER_MORE_EPMS = 4
MAP_STEP_DEG = 15
HOLDABLE_STARTS = 50
"""That nothing holds is known only from many."""
STABILITY_DISTANCES_M = (0.02, 0.0225, 0.025, 0.0275, 0.03, 0.035, 0.04, 0.05, 0.06, 0.08, 0.1)
STABILITY_PAIRS = ((SIDE, 0.0), (SIDE, 180.0), (LINE, 0.0))
STABILITY_HOLDS = 100
MOUNTINGS_DEG = tuple(15.0 * k for k in range(7))
RATIOS = (1.0, 0.75, 0.5, 0.25, 0.1)


def panels(n_epm: Sequence[int], amplitude: float, starts: int) -> Iterator[Task]:
    """Yield the paper's panels: the matrices, and crosstalk over distance and over angle for each number of EPMs."""

    def point(panel: str, n: int, distance: float, angle: float, first: float) -> Task:
        name = panel if first == LINE else f"{panel}-{ARRANGEMENTS[first]}"
        return Task(
            "crosstalk",
            {
                "panel": name,
                "n_epm": n,
                "distance_m": distance,
                "angle_deg": angle,
                "first_deg": first,
                "amplitude": amplitude,
                "starts": starts,
            },
        )

    for first in ARRANGEMENTS:
        for panel, n, distance, angle in PANELS:
            if n in n_epm:
                yield point(panel, n, distance, angle, first)
        for n in n_epm:
            for angle in DISTANCE_ANGLES:
                for distance in DISTANCES_M:
                    yield point("distance", n, distance, angle, first)
            for distance in ANGLE_DISTANCES_M:
                for angle in ANGLES_DEG:
                    yield point("angle", n, distance, angle, first)


def frontier(n_epm: Sequence[int], amplitude: float, starts: int) -> Iterator[Task]:
    """Yield the authority frontier; the amplitude is what it finds."""
    for n in sorted({*n_epm, FRONTIER_MORE_EPMS}):
        for first in ARRANGEMENTS:
            for angle in FRONTIER_ANGLES:
                for distance in FRONTIER_DISTANCES_M:
                    for component in range(WRENCH_SIZE):
                        yield Task(
                            "frontier",
                            {
                                "n_epm": n,
                                "distance_m": distance,
                                "angle_deg": angle,
                                "first_deg": first,
                                "component": component,
                                "limit": FRONTIER_LIMIT,
                                "starts": starts,
                            },
                        )


def holdable(n_epm: Sequence[int], amplitude: float, starts: int) -> Iterator[Task]:
    """Yield the map of the holdable separation over both moments' angles; the rest of it follows by symmetry."""
    for n in n_epm:
        for first, second in map_corner():
            arguments = {"n_epm": n, "first_deg": float(first), "second_deg": float(second)}
            yield Task("holdable", arguments | {"starts": HOLDABLE_STARTS})


def map_corner() -> Iterator[tuple[int, int]]:
    """Yield the pairs of angles of which all others are images (see ``images``)."""
    seen: set[tuple[int, int]] = set()
    for first in range(0, 360, MAP_STEP_DEG):
        for second in range(0, 360, MAP_STEP_DEG):
            if (first, second) not in seen:
                seen |= set(images(first, second))
                yield first, second


def images(first: int, second: int) -> Iterator[tuple[int, int]]:
    """Yield the pairs of angles (degrees) that are held as the given one is.

    Both moments reversed (and those of the EPMs), both mirrored at the line that joins the robots, robots exchanged.
    """
    for a, b in ((first, second), (second, first)):
        for sign in (1, -1):
            for turn in (0, 180):
                yield (sign * a + turn) % 360, (sign * b + turn) % 360


def stability(n_epm: Sequence[int], amplitude: float, starts: int) -> Iterator[Task]:
    """Yield the stability of the hold over distance."""
    for n in n_epm:
        for first, angle in STABILITY_PAIRS:
            for in_plane in (False, True):
                for distance in STABILITY_DISTANCES_M:
                    yield Task(
                        "stability",
                        {
                            "n_epm": n,
                            "distance_m": distance,
                            "angle_deg": angle,
                            "first_deg": first,
                            "in_plane": in_plane,
                            "holds": STABILITY_HOLDS,
                        },
                    )


def validity(n_epm: Sequence[int], amplitude: float, starts: int) -> Iterator[Task]:
    """Yield the paper's panels with exact magnets, r_min measured from the workspace centre and from the robots."""
    for _, n, distance, angle in PANELS:
        if n in n_epm:
            for source in ("centre", "robots"):
                yield Task(
                    "validity",
                    {
                        "n_epm": n,
                        "distance_m": distance,
                        "angle_deg": angle,
                        "first_deg": LINE,
                        "amplitude": amplitude,
                        "starts": starts,
                        "r_min_from": source,
                    },
                )


def unlike(n_epm: Sequence[int], amplitude: float, starts: int) -> Iterator[Task]:
    """Yield parallel robots 5 cm apart whose magnets differ in mounting angle, or in size."""
    for n in n_epm:
        for first in ARRANGEMENTS:
            kinds = [(angle, 1.0) for angle in MOUNTINGS_DEG] + [(0.0, ratio) for ratio in RATIOS[1:]]
            for mounting, ratio in kinds:
                yield Task(
                    "unlike",
                    {
                        "n_epm": n,
                        "distance_m": 0.05,
                        "first_deg": first,
                        "mounting_deg": mounting,
                        "ratio": ratio,
                        "amplitude": amplitude,
                        "starts": starts,
                    },
                )


PARTS: dict[str, Callable[[Sequence[int], float, int], Iterator[Task]]] = {
    "panels": panels,
    "frontier": frontier,
    "holdable": holdable,
    "stability": stability,
    "validity": validity,
    "unlike": unlike,
}
