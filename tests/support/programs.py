"""Every command of both command lines."""

from __future__ import annotations

import click

from msg_agents.cli.main import main as agents
from msg_analysis.cli.main import main as analysis

PROGRAMS: dict[str, click.Group] = {"msg-analysis": analysis, "msg-agents": agents}
COMMANDS = [(program, name) for program, group in PROGRAMS.items() for name in group.commands]


def command_of(program: str, name: str) -> click.Command:
    return PROGRAMS[program].commands[name]


def context_of(program: str, name: str) -> click.Context:
    group = PROGRAMS[program]
    return click.Context(
        command_of(program, name), info_name=name, parent=group.make_context(program, ["-h"], resilient_parsing=True)
    )
