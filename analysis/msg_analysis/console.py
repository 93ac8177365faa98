"""What the command lines have in common: how errors, JSON and examples look."""

from __future__ import annotations

import json
import math
import os
import sys
from typing import TYPE_CHECKING, Any

import click

from msg_analysis.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

BAD_INPUT = 2
INTERRUPTED = 130
BROKEN_PIPE = 141


class CommandGroup(click.Group):
    """The one place where errors of the user become messages and exit codes."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; see click.Group."""
        try:
            return super().invoke(ctx)
        except InputError as error:
            complain(str(error))
            ctx.exit(BAD_INPUT)
        except BrokenPipeError:
            # Nobody reads any more: leave nothing to flush at exit, which would complain again.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            ctx.exit(BROKEN_PIPE)
        except OSError as error:
            if error.filename is None:
                raise
            complain(f"{error.filename}: {error.strerror}")
            ctx.exit(BAD_INPUT)
        except KeyboardInterrupt:
            ctx.exit(INTERRUPTED)


def complain(text: str) -> None:
    """One error on stderr."""
    color = False if "NO_COLOR" in os.environ else None
    click.echo(f"{click.style('error:', fg='red', bold=True)} {text}", err=True, color=color)


def examples(*lines: str) -> str:
    """Epilog of a command's help."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def result_console() -> Console:
    """The rich console for tables on stdout."""
    from rich.console import Console

    class ResultConsole(Console):
        def on_broken_pipe(self) -> None:
            # Rich would exit with 1, which says that a run disagrees with the prediction.
            raise BrokenPipeError

    return ResultConsole(highlight=False, markup=False)


def print_json(document: dict[str, Any]) -> None:
    """One JSON object on stdout; infinite and undefined numbers, which JSON does not have, become null."""
    click.echo(json.dumps(finite(document), allow_nan=False))


def finite(value: Any) -> Any:
    """The same document with None in place of infinite and undefined numbers."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
