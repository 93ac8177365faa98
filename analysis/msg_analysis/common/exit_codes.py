"""Exit codes of all commands, as docs/commands.md lists them."""

from __future__ import annotations

import signal
from enum import IntEnum


class ExitCode(IntEnum):
    """What a command found."""

    FINE = 0  # success; a comparison agrees
    DISAGREES = 1
    BAD_INPUT = 2
    INCOMPLETE = 3  # data are missing, or the end was not reached


def killed_by(number: int) -> int:
    """Exit code of a process that a signal ended, as shells report it."""
    return 128 + number


INTERRUPTED = killed_by(signal.SIGINT)
