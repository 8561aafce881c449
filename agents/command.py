"""How the scripts meet their user: one line for bad input, exit codes, the command as it was typed."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path

BAD_INPUT = 2
INTERRUPTED = 130


def command_line() -> str:
    """Return the command that started this process."""
    return shlex.join(["python", Path(sys.argv[0]).name, *sys.argv[1:]])


def friendly(main: Callable[[], None]) -> None:
    """Run ``main``; bad input ends it with one line and exit code 2, Ctrl-C with exit code 130."""
    try:
        main()
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
