# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Errors of bad input, of bad bags and of unavailable features; exit codes of all commands."""

from __future__ import annotations

import errno
import signal
from enum import IntEnum
from pathlib import Path


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
    FAULT = 70  # of the program itself, as in <sysexits.h>


def killed_by(number: int) -> int:
    """Exit code of a process that a signal ended, as shells report it: 128 + its number.

    Parameters
    ----------
    number
        of the signal
    """
    return 128 + number


INTERRUPTED = killed_by(signal.SIGINT)


def lack(error: BaseException) -> str | None:
    """What this process lacks, and what to do; None: the error has another reason.

    Parameters
    ----------
    error
        that was raised
    """
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.EMFILE, errno.ENFILE):
        return "too many open files: raise the limit, `ulimit -n`"
    # Libraries that cannot be mapped, threads without a stack.
    words = ("failed to map segment", "annot allocate memory", "can't start new thread")
    if isinstance(error, MemoryError) or number == errno.ENOMEM or any(word in str(error) for word in words):
        return "out of memory: end other programs, or raise the limits, `ulimit -v` and `ulimit -u`"
    if number == errno.ENOENT and isinstance(error, OSError) and error.filename is None:
        try:
            Path.cwd()
        except OSError:
            return "the working directory has been deleted: change to another one"
    return None
