# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What the command lines share: streams, errors and exit codes, JSON, and the examples in help pages."""

from __future__ import annotations

import errno
import io
import os
import signal
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import click
from click.exceptions import Exit

from msg_analysis.common.exit_codes import INTERRUPTED, ExitCode, killed_by
from msg_analysis.common.text.json_numbers import json_text
from msg_analysis.common.text.safe_text import visible
from msg_analysis.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

# Our models have no plugins. pydantic would look for some in all packages that are installed: 30 ms of each command.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "true")

NOT_WRITTEN = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EBADF}


class CommandGroup(click.Group):
    """A click group that turns errors of the user into messages and exit codes; all help pages share its settings."""

    def __init__(self, *args: Any, **attributes: Any) -> None:
        attributes["context_settings"] = {"help_option_names": ["-h", "--help"], "show_default": True}
        super().__init__(*args, **attributes)

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run the program; see click.Command."""
        _open_closed_streams()
        _tolerate_streams()
        return super().main(*args, **extra)

    def make_context(self, *args: Any, **extra: Any) -> click.Context:
        """Parse the command line, answer ``--help`` and ``--version``; see click.Command."""
        with _exit_codes():
            return super().make_context(*args, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; see click.Group."""
        with _exit_codes():
            return super().invoke(ctx)


@contextmanager
def _exit_codes() -> Iterator[None]:
    try:
        yield
    except click.ClickException as error:
        vars(error)["message"] = visible(error.message)
        raise
    except InputError as error:
        complain(str(error))
        raise Exit(ExitCode.BAD_INPUT) from error
    except BrokenPipeError as error:
        _drop_stdout()
        raise Exit(killed_by(signal.SIGPIPE)) from error
    except OSError as error:
        from msg_analysis.common.files import no_temporary_directory

        if error.filename is not None:
            complain(f"{error.filename}: {error.strerror}")
        elif error.errno in NOT_WRITTEN:
            place = "stdout" if _stdout_can_fail() else "a file"
            _drop_stdout()
            complain(f"{place}: {error.strerror}: the result could not be written")
        elif words := no_temporary_directory(error):
            complain(words)
        else:
            raise
        raise Exit(ExitCode.BAD_INPUT) from error
    except KeyboardInterrupt as error:
        raise Exit(INTERRUPTED) from error


def _open_closed_streams() -> None:
    """Occupy the numbers of closed standard streams, so that no file or socket gets them and receives what is printed.

    Printing to a closed stdout then fails, as in other programs; what is printed to a closed stderr is dropped.
    """
    for number, mode in ((0, os.O_WRONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)  # takes the lowest free number
            if number == 1:
                sys.stdout = os.fdopen(1, "w")
            elif number == 2:
                sys.stderr = os.fdopen(2, "w")


class _Unfailing(io.FileIO):
    """A file that drops what cannot be written: it is full, or its reader has gone."""

    def write(self, data: Any) -> int:
        """As many bytes as there are."""
        with suppress(OSError):
            super().write(data)
        return len(data)


def _tolerate_streams() -> None:
    """Notes and errors that cannot be printed, or characters that stdout does not have, change no result."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    if isinstance(sys.stderr, io.TextIOWrapper) and sys.stderr is sys.__stderr__:
        unfailing = io.BufferedWriter(_Unfailing(sys.stderr.fileno(), "w", closefd=False))
        encoding = sys.stderr.encoding
        sys.stderr = io.TextIOWrapper(unfailing, encoding, "backslashreplace", line_buffering=True)


def _stdout_can_fail() -> bool:
    """Whether an error without a file name is that of stdout: our files have names; pipes, terminals are never full."""
    try:
        number = sys.stdout.fileno()
        return stat.S_ISREG(os.fstat(number).st_mode) or (
            stat.S_ISCHR(os.fstat(number).st_mode) and not os.isatty(number)
        )
    except (OSError, ValueError):  # a stream without a file, in tests
        return False


def _drop_stdout() -> None:
    """Redirect stdout to /dev/null, so that the flush at exit does not fail again."""
    with suppress(OSError, ValueError):  # a stream without a file, in tests
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def complain(text: str, label: str = "error:") -> None:
    """Print one error on stderr, behind a label that is red on a terminal."""
    color = False if os.environ.get("NO_COLOR") else None
    click.echo(f"{click.style(label, fg='red', bold=True)} {visible(text)}", err=True, color=color)


def examples(*lines: str) -> str:
    """Epilog of a command's help: commands as a user would type them."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def result_console() -> Console:
    """The rich console for tables on stdout."""
    from msg_analysis.common.text.safe_console import ResultConsole

    return ResultConsole()


def print_text(text: str) -> None:
    """Print lines on stdout, with the names in them made safe for terminals."""
    click.echo(visible(text))


def print_json(document: dict[str, Any], indent: int | None = None) -> None:
    """Print one JSON object on stdout; infinite numbers and NaN become null."""
    click.echo(json_text(document, indent))
