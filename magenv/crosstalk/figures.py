"""Figures of the system analysis, from the rows of the tables alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from magenv.crosstalk.atlas_figures import frontier, holdable, stability, unlike, validity
from magenv.crosstalk.panel_figures import matrices, sweeps
from magenv.crosstalk.style import Rows

_DRAWN: Mapping[str, tuple[Callable[[Rows, str], Iterator[tuple[str, bytes]]], ...]] = {
    "crosstalk": (matrices, sweeps),
    "frontier": (frontier,),
    "holdable": (holdable,),
    "stability": (stability,),
    "validity": (validity,),
    "unlike": (unlike,),
}


def draw(tables: Mapping[str, Rows], starts: str) -> Iterator[tuple[str, bytes]]:
    """Yield names and PNG images of all figures that the tables give."""
    for table, rows in tables.items():
        for function in _DRAWN[table]:
            yield from function(rows, starts)
