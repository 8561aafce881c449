"""Folders of runs: proven, claimed and locked, so that no run takes another's."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

from filelock import FileLock, Timeout

from magenv.files import check_output_dir
from magenv.params import InputError


def lock_folder(folder: Path) -> FileLock | None:
    """Return the lock of a run's folder, held from now on; None where another run holds it.

    The system frees it when the process ends, however it does.
    """
    check_output_dir(folder)
    lock = FileLock(folder / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return None
    return lock


def _claim(folder: Path, taken: Callable[[Path], bool]) -> FileLock | None:
    """Return the lock of a new run's folder; None where it is another run's, begun even at this very moment."""
    lock = lock_folder(folder)
    if lock is not None and taken(folder):
        lock.release()
        return None
    return lock


def new_folder(out: Path | None, default: Path, taken: Callable[[Path], bool], must_be: str) -> tuple[Path, FileLock]:
    """Return a new run's folder and its lock: ``out``, or the first of the default's names (-2, -3, ...) still free.

    Parameters
    ----------
    out : Path, optional
        The folder asked for.
    default : Path
        Where none is asked for.
    taken : callable
        Tells whether a folder holds a run.
    must_be : str
        What ``out`` must be, as the error tells it.

    Raises
    ------
    InputError
        If ``out`` holds a run or cannot be written.
    """
    names = (default.with_name(f"{default.name}-{k}") for k in itertools.count(2))
    for folder in itertools.chain([default], names) if out is None else [out]:
        lock = _claim(folder, taken)
        if lock is not None:
            return folder, lock
    raise InputError(f"Input out must be {must_be}; instead received {str(out)!r}.")
