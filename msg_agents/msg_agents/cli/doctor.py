# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The command ``doctor``."""

from __future__ import annotations

import sys
from collections import Counter
from typing import TYPE_CHECKING

import click

from msg_analysis.cli.console import examples, print_json, result_console
from msg_analysis.cli.options import json_option
from msg_analysis.errors import ExitCode

if TYPE_CHECKING:
    from rich.console import Console

    from msg_agents.doctor.checks import Check


STYLES = {"ok": "green", "warning": "bold yellow", "error": "bold red"}


@click.command(epilog=examples("msg-agents doctor"))
@json_option
def doctor(*, as_json: bool) -> None:
    """Say what this machine and shell would do to a run, and what to do about it.

    The last check runs two processes for a second. Exit code 2: a run cannot work; warnings do not change it.
    """
    from msg_agents.doctor.network_checks import examine

    console, found = result_console(), []
    for check in examine():
        found.append(check)
        if not as_json:
            _print_check(console, check)
    counts = Counter(check.status for check in found)
    can_run = not counts["error"]
    if as_json:
        counted = {"errors": counts["error"], "warnings": counts["warning"]}
        print_json({"can_run": can_run, **counted, "checks": [check.to_json() for check in found]})
    else:
        console.print(_summary(counts["error"], counts["warning"]), soft_wrap=True)
    if not can_run:
        sys.exit(ExitCode.BAD_INPUT)


def _print_check(console: Console, check: Check) -> None:
    """One line; terminals get the text folded in a column of its own."""
    from rich.table import Table
    from rich.text import Text

    status, name = Text(f"{check.status:<8}", STYLES[check.status]), Text(f"{check.name.replace('_', ' '):<20}", "bold")
    if console.is_terminal:
        row = Table.grid(padding=(0, 1))
        row.add_row(status, name, Text(check.text, overflow="fold"))
        row.columns[0].no_wrap = row.columns[1].no_wrap = True
        console.print(row)
    else:
        console.print(Text(" ").join([status, name, Text(check.text)]))


def _summary(errors: int, warnings: int) -> str:
    noted = f" ({warnings} warning{'s' * (warnings > 1)})" if warnings else ""
    return f"A run cannot work here{noted}." if errors else f"A run can work here{noted}."
