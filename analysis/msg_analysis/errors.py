# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Errors of bad input, of bad bags and of unavailable features; exit codes of all commands."""

from __future__ import annotations

import signal
from enum import IntEnum


class InputError(ValueError):
    """Bad input. The message names the key or file, the value, what was expected and what to do. Exit code 2."""


class NotAvailableError(InputError):
    """Something that the file format or the library has, but that is not there for this experiment."""


class BagError(InputError):
    """A bag that cannot be read or written, or that does not hold one run of a network."""


class ExitCode(IntEnum):
    """What a command found."""

    FINE = 0  # success; a comparison agrees
    DISAGREES = 1
    BAD_INPUT = 2
    INCOMPLETE = 3  # data are missing, or the end was not reached
    LATE = 4  # in real time: nothing disagrees, but too many steps were late


def killed_by(number: int) -> int:
    """Exit code of a process that a signal ended, as shells report it: 128 + its number.

    Parameters
    ----------
    number
        of the signal
    """
    return 128 + number


INTERRUPTED = killed_by(signal.SIGINT)
