# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Consoles of the commands, and the progress of long work."""

from __future__ import annotations

import errno
import io
import math
import os
import signal
import stat
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Self

import click
from click.exceptions import Exit

from msg_analysis.errors import INTERRUPTED, ExitCode, InputError, killed_by, lack

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Task
    from rich.text import Text

    from msg_analysis.experiment.experiment import Experiment
    from msg_analysis.sweeps.grid import SweepGrid


# Our models have no plugins. pydantic would look for some in all packages that are installed: 30 ms of each command.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "true")

NOT_WRITTEN = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EBADF}


SHORT_HELP = 55  # most letters of the first sentence of a command's help, which the list of commands shows


class CommandGroup(click.Group):
    """A click group that turns errors of the user into messages and exit codes; all help pages share its settings."""

    def __init__(self, *args: Any, **attributes: Any) -> None:
        attributes["context_settings"] = {"help_option_names": ["-h", "--help"], "show_default": True}
        super().__init__(*args, **attributes)
        self.sections: dict[str, list[str]] = {}  # of the list of commands: title, names

    def add_section(self, title: str, *commands: click.Command) -> None:
        """Add commands, which the list of commands shows below this title."""
        self.sections[title] = [str(command.name) for command in commands]
        for command in commands:
            self.add_command(command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write the commands of each section; see click.Group."""
        width = max(map(len, self.commands))
        for title, names in self.sections.items():
            with formatter.section(title):
                rows = [(f"{name:<{width}}", self.commands[name].get_short_help_str(SHORT_HELP)) for name in names]
                formatter.write_dl(rows)

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run the program; see click.Command."""
        _open_closed_streams()
        _tolerate_streams()
        os.environ["MPLBACKEND"] = "Agg"  # that of a Jupyter kernel, for example, cannot be loaded here
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
        from msg_analysis.common.text import visible

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

        if error.filename is not None and lack(error) is None:
            complain(f"{error.filename}: {error.strerror}")
        elif error.errno in NOT_WRITTEN:
            place = "stdout" if _stdout_can_fail() else "a file"
            _drop_stdout()
            complain(f"{place}: {error.strerror}: the result could not be written")
        elif words := lack(error) or no_temporary_directory(error):
            complain(words)
        else:
            raise _fault(error) from error
        raise Exit(ExitCode.BAD_INPUT) from error
    except KeyboardInterrupt as error:
        raise Exit(INTERRUPTED) from error
    except (Exit, click.Abort):
        raise
    except Exception as error:
        if isinstance(error.__cause__, KeyboardInterrupt):  # Python 3.11, while a class is being made
            raise Exit(INTERRUPTED) from error
        raise _fault(error) from error


def _fault(error: Exception) -> Exit:
    """Say what the process lacks, or that the program has a fault; the end of the command."""
    if words := lack(error):
        complain(words)
        return Exit(ExitCode.BAD_INPUT)
    from traceback import format_exception

    complain("a fault of this program: please report it, with the lines below and the command")
    click.echo("".join(format_exception(error)), err=True, nl=False)  # its last line is shown of a node
    return Exit(ExitCode.FAULT)


def _open_closed_streams() -> None:
    """Occupy the numbers of closed standard streams: a file or socket would get them, and receive what is printed."""
    # Printing to a closed stdout then fails, as in other programs; what is printed to a closed stderr is dropped.
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


def plain_matplotlib() -> None:
    """Before a command draws: the settings of the user, such as LaTeX, are for other figures."""
    import matplotlib as mpl

    mpl.rcdefaults()


def complain(text: str, label: str = "error:") -> None:
    """Print one error on stderr, behind a label that is red on a terminal."""
    from msg_analysis.common.text import visible

    color = False if os.environ.get("NO_COLOR") else None
    click.echo(f"{click.style(label, fg='red', bold=True)} {visible(text)}", err=True, color=color)


def examples(*lines: str) -> str:
    """Epilog of a command's help: commands as a user would type them."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def result_console() -> Console:
    """The rich console for tables on stdout."""
    from msg_analysis.common.console import ResultConsole

    return ResultConsole()


def print_text(text: str) -> None:
    """Print lines on stdout, with the names in them made safe for terminals."""
    from msg_analysis.common.text import visible

    click.echo(visible(text))


def print_json(document: dict[str, Any], indent: int | None = None) -> None:
    """Print one JSON object on stdout; infinite numbers and NaN become null."""
    from msg_analysis.common.text import json_text

    click.echo(json_text(document, indent))


def print_result(document: dict[str, Any], show: Callable[[dict[str, Any], Console], None], *, as_json: bool) -> None:
    """Print a document on stdout: as one JSON object, or as ``show`` does it."""
    if as_json:
        print_json(document)
    else:
        show(document, result_console())


def print_note(line: str) -> None:
    """Print one line on stderr, behind a coloured ``note:``."""
    from msg_analysis.common import console

    console.print_note(line)


def print_notes(read: Experiment | SweepGrid) -> None:
    """Print the notes on the files with graphs of an experiment or a sweep."""
    for note in read.notes:
        print_note(note)


_LINE_PERIOD = 10.0  # s between two lines where there is no terminal
_SHORT = 2.0  # s of work of which nothing is shown
_REFRESH = 0.1  # s between two updates of a bar


class _Progress:
    """Progress display, a context manager."""

    time_left = False  # whether to show it beside the time so far

    def __init__(self, title: str = "", clock: Callable[[], float] = time.monotonic) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn
        from rich.text import Text

        from msg_analysis.common.console import SafeConsole

        times = self._times

        class TimesColumn(ProgressColumn):
            def render(self, _: Task) -> Text:
                return Text(times())

        console = SafeConsole(stderr=True, highlight=False, markup=False)
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[words]}"),
            TimesColumn() if self.time_left else TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._console = console
        self._title = title
        self._task = self._bar.add_task(title, total=None, words="")
        self._clock = clock
        self._begun = self._told = clock()
        self._first: int | None = None  # done when the work began, by an earlier call for example
        self._newest = (0, 0, self._begun)  # done, of how many, when
        self._shown = 0.0

    def __enter__(self) -> Self:
        return self

    def _times(self) -> str:
        """The time so far, and what is left at the mean speed so far, once it is known."""
        from msg_analysis.common.text import duration_text

        now = self._clock()
        text = f"{duration_text(now - self._begun)} so far"
        done, total, when = self._newest
        new = done - (self._first or 0)
        if new <= 0 or done >= total:
            return text
        left = (total - done) * (when - self._begun) / new - (now - when)
        return f"{text}, {duration_text(math.ceil(max(left, 0.0)))} left"

    def _show(self, title: str, done: int, total: int, text: str, in_short: str) -> None:
        if self._first is None:
            self._first = done
        self._newest = done, total, self._clock()
        self._bar.start()
        self._bar.update(self._task, completed=done, total=total, description=title, words=in_short)
        if not self._console.is_terminal and self._clock() - self._told >= _LINE_PERIOD:
            self._told = self._clock()
            self._console.print(f"{title}: {text}" + (f", {self._times()}" if self.time_left else ""))

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:  # elsewhere, older versions of rich would print an empty line
            self._bar.stop()


class SweepProgress(_Progress):
    """Progress of a sweep, a context manager."""

    time_left = True

    def done(self, done: int, total: int, failed: int = 0) -> None:
        """Show how many points are done, and how many of these failed; a ``SweepProgress`` of ``run_jobs``."""
        without = f"{failed} without a result" if failed else ""
        self._show(self._title, done, total, f"{done} of {total}" + (f", {without}" if failed else ""), without)


class SolveProgress(_Progress):
    """Progress of a search: a ``SearchProgress`` of ``theory.leaders.search``, and a context manager."""

    def __call__(self, stage: str, done: int, total: int, best: float) -> None:
        """Show stage, evaluations done and to do, and the smallest system error so far; see ``SearchProgress``."""
        found = f"{best:.6g}"
        text = f"{done} of {total}, smallest system error {found}"
        self._show(f"{self._title}: {stage}", done, total, text, f"E {found}")


class WorkProgress(_Progress):
    """How far long work is, in percent: a ``common.long_work.Watch``, and a context manager; nothing in short work."""

    def __call__(self, what: str, done: int, total: int) -> None:
        """Show what is being done, and how much of it is done."""
        now = self._clock()
        if now - self._begun < _SHORT or now - self._shown < _REFRESH:
            return
        self._shown = now
        percent = 100 * done // max(total, 1)
        self._show(what, percent, 100, f"{percent} %", "%")
