"""Folders and files that runs write: proven before, and never half a file; what they were made from, in one number."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

from magenv.params import InputError


def check_output_dir(folder: Path) -> None:
    """Make the folder and prove that it can be written, before anything is computed for it.

    Raises
    ------
    ValueError
        If it cannot.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            f"Input out must be a folder that can be written; instead received {str(folder)!r} ({error.strerror})."
        ) from error


def write_file(path: Path, content: bytes) -> None:
    """Write ``content`` to a new name beside ``path`` and move it into place: never half a file."""
    new = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        new.write_bytes(content)
        os.replace(new, path)
    finally:
        new.unlink(missing_ok=True)


def digest_of(folder: Path) -> str:
    """Return a number, in hexadecimal, that changes with the name or content of any file below ``folder``.

    What Python compiles from the sources does not count.
    """
    total = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if path.is_file() and "__pycache__" not in name.parts:
            total.update(str(name).encode() + b"\0" + path.read_bytes())
    return total.hexdigest()
