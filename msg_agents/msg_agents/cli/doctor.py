"""The command ``doctor``."""

from __future__ import annotations

import sys
from collections import Counter

import click

from msg_agents.processes.fork_server import early_server
from msg_analysis.cli.console import examples, print_json, result_console
from msg_analysis.cli.options import json_option
from msg_analysis.common.exit_codes import ExitCode

STYLES = {"ok": "green", "warning": "bold yellow", "error": "bold red"}


@click.command(epilog=examples("msg-agents doctor", "msg-agents doctor --json"))
@json_option
def doctor(*, as_json: bool) -> None:
    """Say what this machine and shell would do to a run, and what to do about it.

    The last check runs two processes for a second. Exit code 2: a run cannot work; warnings do not change it.
    """
    click.get_current_context().with_resource(early_server())
    from rich.text import Text

    from msg_agents.doctor.examination import examine

    console, found = result_console(), []
    for check in examine():
        found.append(check)
        if not as_json:
            words = (f"{check.status:<9}", STYLES[check.status]), (f"{check.name.replace('_', ' '):<21}", "bold")
            console.print(Text.assemble(*words, check.text), soft_wrap=True)
    counts = Counter(check.status for check in found)
    can_run = not counts["error"]
    if as_json:
        counted = {"errors": counts["error"], "warnings": counts["warning"]}
        print_json({"can_run": can_run, **counted, "checks": [check.to_json() for check in found]})
    else:
        console.print(_summary(counts["error"], counts["warning"]), soft_wrap=True)
    if not can_run:
        sys.exit(ExitCode.BAD_INPUT)


def _summary(errors: int, warnings: int) -> str:
    noted = f" ({warnings} warning{'s' * (warnings > 1)})" if warnings else ""
    return f"A run cannot work here{noted}." if errors else f"A run can work here{noted}."
