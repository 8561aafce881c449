"""How the scripts meet their user: one line for bad input, exit codes, the command as it was typed."""

from __future__ import annotations

import contextlib
import io
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import tyro

Config = TypeVar("Config")

BAD_INPUT = 2
INTERRUPTED = 130


def command_line() -> str:
    """Return the command that started this process."""
    return shlex.join(["python", Path(sys.argv[0]).name, *sys.argv[1:]])


def parse(kind: type[Config]) -> Config:
    """Read the command line into a configuration, whose docstring is the help; bad words are a ``ValueError``."""
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.cli(kind, description=kind.__doc__, config=(tyro.conf.FlagCreatePairsOff,))
    except SystemExit as exit_:
        if not exit_.code:
            raise
        # Of the framed message the first part: what is wrong; hints follow below a rule.
        lines = [line.strip("│ ") for line in told.getvalue().splitlines() if line.startswith("│")]
        rule = next((i for i, line in enumerate(lines) if set(line) == {"─"}), len(lines))
        raise ValueError(" ".join(lines[:rule]) or told.getvalue().strip()) from None


def friendly(main: Callable[[], None]) -> None:
    """Run ``main``; bad input ends it with one line and exit code 2, Ctrl-C with exit code 130."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs are born deaf to it
    try:
        main()
    except (ValueError, OSError) as error:
        print("error:", *str(error).split(), file=sys.stderr)  # one line
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
