"""What is said about bad input: in one line, what it must be and what was received."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest


def told(name: str, must_be: str, received: object) -> str:
    """Return the whole message, as a pattern."""
    return "^" + re.escape(f"Input {name} must be {must_be}; instead received {received!r}.") + "$"


def refusal(call: Callable[[], object]) -> str:
    """Return the message of the ``ValueError`` that ``call`` must raise: one line, what must be and what was."""
    with pytest.raises(ValueError, match=r"^Input .+ must .+; instead received .+") as raised:
        call()
    message = str(raised.value)
    assert "\n" not in message
    assert len(message) < 600
    return message
