"""How the scripts meet their user: one line for bad input, exit codes, the command as it was typed."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

import tyro

from magenv.params import InputError

Config = TypeVar("Config")

FAILED = 1
BAD_INPUT = 2
INTERRUPTED = 130


class RunError(Exception):
    """What ends a run although its input was sound, and is no fault of the program: told in one line."""


def command_line() -> str:
    """Return the command that started this process."""
    spec = sys.modules["__main__"].__spec__
    what = [Path(sys.argv[0]).name] if spec is None else ["-m", spec.name.removesuffix(".__main__")]
    return shlex.join(["python", *what, *sys.argv[1:]])


def parse(kind: type[Config], default: Config | None = None) -> Config:
    """Read the command line into a configuration, whose docstring is the help.

    Parameters
    ----------
    kind : type
        A dataclass.
    default : optional
        What holds where the command line says nothing, in place of the dataclass's own defaults.

    Raises
    ------
    InputError
        If the command line is unsound.
    """
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            config = tyro.cli(kind, default=default, description=kind.__doc__, config=(tyro.conf.FlagCreatePairsOff,))
    except SystemExit as exit_:
        if not exit_.code:
            raise
        # Of the framed message the first part: what is wrong; hints follow below a rule.
        lines = [line.strip("│ ") for line in told.getvalue().splitlines() if line.startswith("│")]
        rule = next((i for i, line in enumerate(lines) if set(line) == {"─"}), len(lines))
        raise InputError(_in_plain_words(" ".join(lines[:rule]) or told.getvalue().strip())) from None
    return cast("Config", config)


def _in_plain_words(error: str) -> str:
    """Return the parser's message without its talk of types and classes."""
    error = re.sub(r"^Error parsing [\w.]+: (?=Input )", "", error)  # our own message, from a dataclass
    number = re.match(
        r"Error parsing (--\S+): (?:no type matching \{None\}\|)?"
        r"(INT|FLOAT|invalid literal for int|could not convert string to float).*?('.*?')",
        error,
    )
    if number is None:
        return error
    whole = "whole " if number[2] in ("INT", "invalid literal for int") else ""
    return f"Input {number[1]} must be a {whole}number; instead received {number[3]}."


def friendly(main: Callable[[], None]) -> None:
    """Run ``main``; bad input ends it with one line and exit code 2, a ``RunError`` so with 1, Ctrl-C with 130.

    A fault of ours is raised.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs are born deaf to it
    try:
        main()
    except (InputError, OSError, RunError) as error:
        print("error:", *str(error).split(), file=sys.stderr)  # one line
        sys.exit(FAILED if isinstance(error, RunError) else BAD_INPUT)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
