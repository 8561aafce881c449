"""What all figures of the system analysis have in common."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from magenv.allocation import FORCE_SCALE_N, TORQUE_SCALE_NM
from magenv.crosstalk.plan import LINE, SIDE
from magenv.crosstalk.tasks import Row
from magenv.params import System

Floats = NDArray[np.float64]
Rows = Sequence[Row]

LINES: tuple[dict[str, Any], ...] = (
    {"color": "#000000", "linestyle": "-", "marker": "o"},
    {"color": "#D55E00", "linestyle": "--", "marker": "s"},
    {"color": "#0072B2", "linestyle": "-.", "marker": "^"},
    {"color": "#909090", "linestyle": ":", "marker": "D"},
)
"""Told apart by colour-blind eyes and in grey."""
TITLES = {LINE: "first moment along the joining line", SIDE: "first moment at right angles to it"}
_SYSTEM = System()
BOUNDS = (
    f"radii {_SYSTEM.r_min_m:g} to {_SYSTEM.r_max_m:g} m, "
    f"EPMs attract each other with at most {_SYSTEM.attraction_max_n:g} N"
)
"""In words, for every figure."""
_DPI = 130


def png(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=_DPI)
    return content.getvalue()


def new_figure(width: float, height: float, title: str) -> Figure:
    """Return an empty figure of a size (inches)."""
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title, fontsize=10)
    return figure


def setting(rows: Rows, starts: str) -> str:
    """Return in words what the targets were."""
    amplitude = rows[0]["amplitude"]
    force, torque = 1e3 * amplitude * FORCE_SCALE_N, 1e3 * amplitude * TORQUE_SCALE_NM
    return f"amplitude {amplitude:g} of the paper's targets: {force:g} mN, {torque:g} mN m; {starts}\n{BOUNDS}"


def where(rows: Rows, **values: object) -> list[Row]:
    """Return the rows whose columns have these values."""
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def finish(axes: Axes, label: str, unit: str) -> None:
    """Give axes their labels, a grid and a legend."""
    axes.set_xlabel(label)
    axes.set_ylabel(unit)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
