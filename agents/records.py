"""What is kept of an episode, and its file: arrays alone, no code, nothing that would need the simulation again."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magenv.files import write_file
from magenv.params import InputError, require

Floats = NDArray[np.float64]

FORMAT = "magenv records 2"


@dataclass(frozen=True, eq=False)
class Record:
    """One episode of one controller. K holds were begun; of M the scenario consists (K < M where control was lost)."""

    controller: str
    scenario: str
    plant: str
    n_epm: int
    control_hz: float
    action: str
    """Action mode the controller speaks."""
    seed: int
    """Of the episode."""
    success: bool
    """Control was kept to the end of the reference."""
    loss: str
    """Kind of loss of control, one of ``magenv.world.LOSSES``."""
    loss_time_s: float | None
    """The first substep at which control was lost, None where it was kept."""
    separation_tracked_m: float | None
    """Distance of the robots at the last instant at which both were near their references; None if at none."""
    time_s: Floats
    """(K+1,) time of each recorded state: the control instants and, where control was lost, that moment."""
    robots: Floats
    """(K+1, 2, 3) true x, y (m) and heading (rad)."""
    epm_pose: Floats
    """(K+1, 5 N) pose vectors of the EPMs."""
    reference: Floats
    """(M+1, 2, 3) reference x, y (m) and heading (rad) at all control instants of the scenario, also after a loss."""
    position_error_m: Floats
    """(K,) position error, mean over both robots and the substeps of the hold."""
    heading_error_rad: Floats
    """(K,) absolute heading error, mean likewise."""
    position_error_end_m: Floats
    """(K,) position error at the end of the hold, mean over both robots."""
    heading_error_end_rad: Floats
    """(K,) absolute heading error at the end of the hold."""
    separation_min_m: Floats
    """(K,) least distance of the robots in the hold."""
    substeps: NDArray[np.int64]
    """(K,) substeps of the hold: fewer where control was lost in it."""
    projected: NDArray[np.bool_]
    """(K,) whether the command's EPMs were too close, or out of reach, and were moved."""
    solver: NDArray[np.int64]
    """(K,) how the solver behind the command ended, codes into ``magenv.outcome.OUTCOMES``."""
    step_ms: Floats
    """(K,) wall time of ``predict``."""


# A file holds one array per field: scalars (episodes,), arrays of all episodes end to end. None is written as NaN.
_TEXT = ("controller", "scenario", "plant", "action", "loss")
_OPTIONAL = ("loss_time_s", "separation_tracked_m")
_SCALARS: dict[str, type] = {
    **dict.fromkeys(_TEXT, str),
    "n_epm": int,
    "control_hz": float,
    "seed": int,
    "success": bool,
    **dict.fromkeys(_OPTIONAL, float),
}
_STATES = ("time_s", "robots", "epm_pose")
_REFERENCE = "reference"
_HOLDS = tuple(f.name for f in fields(Record) if f.name not in (*_SCALARS, *_STATES, _REFERENCE))


def save(records: list[Record], path: Path) -> None:
    """Write episodes of systems with equally many EPMs to one ``.npz`` file.

    Raises
    ------
    ValueError
        If there are none, or their numbers of EPMs differ.
    """
    alike = {record.n_epm for record in records}
    require(len(alike) == 1, "records", "episodes with equally many EPMs, one at least", f"n_epm {sorted(alike)}")
    arrays: dict[str, NDArray[Any]] = {"format": np.array(FORMAT)}
    for name, kind in _SCALARS.items():
        values = [getattr(record, name) for record in records]
        arrays[name] = np.array([np.nan if value is None else value for value in values], dtype=kind)
    arrays["holds"] = np.array([len(record.substeps) for record in records])
    arrays["instants"] = np.array([len(record.reference) for record in records])
    for name in (*_STATES, _REFERENCE, *_HOLDS):
        arrays[name] = np.concatenate([getattr(record, name) for record in records])
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_file(path, buffer.getvalue())


def load(path: Path) -> list[Record]:
    """Read the episodes of a file that ``save`` wrote; nothing in it is run.

    Raises
    ------
    ValueError
        If there is no such file, or it is not one of ``save``.
    """
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            return _records({name: file[name] for name in file.files})
    except (OSError, LookupError, ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"Input records file must be a readable file of magenv's records (.npz, {FORMAT!r}); "
            f"instead received {str(path)!r}."
        ) from error


def _records(arrays: dict[str, NDArray[Any]]) -> list[Record]:
    """Return the episodes of a file's arrays; raises where they are not those of ``save``."""
    require(str(arrays["format"]) == FORMAT, "format", FORMAT, arrays["format"])
    holds, instants = arrays["holds"], arrays["instants"]
    values: list[dict[str, Any]] = [{} for _ in holds]
    for name, kind in _SCALARS.items():
        require(len(arrays[name]) == len(holds), name, f"of length {len(holds)}", len(arrays[name]))
        for value, scalar in zip(values, arrays[name], strict=True):
            value[name] = None if name in _OPTIONAL and np.isnan(scalar) else kind(scalar)
    lengths = dict.fromkeys(_STATES, holds + 1) | {_REFERENCE: instants} | dict.fromkeys(_HOLDS, holds)
    rows = {"robots": (2, 3), _REFERENCE: (2, 3), "epm_pose": (5 * values[0]["n_epm"],)}
    for name, length in lengths.items():
        shape = (length.sum(), *rows.get(name, ()))
        require(arrays[name].shape == shape, name, f"of shape {shape}", arrays[name].shape)
        for value, part in zip(values, np.split(arrays[name], np.cumsum(length)[:-1]), strict=True):
            value[name] = part
    return [Record(**value) for value in values]
