"""Where results were made: on which machine, by which state of the program."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_PROGRAM = ("agents", "magenv", "train.py")
UNKNOWN = "unknown"


def cpu() -> str:
    """Return the processor's name."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def machine() -> str:
    """Return processor, number of cores and system: what results and wall times depend on."""
    return f"{cpu()}, {os.cpu_count()} cores, {platform.system()}"


def commit() -> str:
    """Return the commit of the program, ``+changes`` behind it where its files differ from it; ``unknown`` if none."""
    if _git("rev-parse", "--show-prefix") != "":  # no repository, or one in which the program is installed
        return UNKNOWN
    found = _git("rev-parse", "--short=12", "HEAD")
    changed = _git("status", "--porcelain", "--", *_PROGRAM)
    return UNKNOWN if not found else found + ("+changes" if changed else "")


def _git(*arguments: str) -> str | None:
    """Return what git tells, None where it fails or is missing."""
    try:
        done = subprocess.run(["git", "-C", str(_ROOT), *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
