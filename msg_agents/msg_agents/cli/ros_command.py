# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Commands that are nodes of ROS 2: they take its arguments, too."""

from __future__ import annotations

import os
from typing import Any

import click

from msg_agents.environment import LAST_DOMAIN, check_domain, tolerate_warnings
from msg_agents.nodes.parameters import GIVES_PARAMETERS, PROCESS, given, mention_qos, merge, name_of, options_of
from msg_agents.run.fork_server import exit_with_lock
from msg_agents.terminal import exit_on_signals
from msg_analysis.cli.options import PATH


class RosCommand(click.Command):
    """Takes arguments for ROS 2; parameters among them replace options that are not on the command line."""

    # rclpy reads the others itself. Parameters of one node are found by its name; by default that of the command.

    def __init__(self, *args: Any, node_name: str | None = None, **options: Any) -> None:
        super().__init__(*args, **options)
        self.params.append(click.Option(["--lifeline-lock"], type=PATH, hidden=True))  # given by launch files
        self.node_name = node_name or self.name or ""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """As in click; with the parameters that the arguments of ROS 2 give."""
        ours, ros = split_arguments(args)
        if ctx.resilient_parsing:  # completion in a shell, perhaps after an option that has no value yet
            while ours and ours[-1].startswith("-"):
                ours.pop()
            return super().parse_args(ctx, ours)
        if not GIVES_PARAMETERS.intersection(ros):
            rest = super().parse_args(ctx, ours)
        else:
            rest = self._parse_with_parameters(ctx, ours, ros)
        PROCESS.options, PROCESS.values = options_of(self), dict(ctx.params)
        return rest

    def invoke(self, ctx: click.Context) -> Any:
        """As in click; without ``--domain``, ROS_DOMAIN_ID is checked first."""
        tolerate_warnings()
        if (folder := ctx.params.pop("lifeline_lock", None)) is not None:
            exit_with_lock(folder)
        if ctx.params.get("domain") is None:
            check_domain()
        return super().invoke(ctx)

    def _parse_with_parameters(self, ctx: click.Context, ours: list[str], ros: list[str]) -> list[str]:
        # Parameters may supply what is required: check that after they have been read.
        required = [each for each in self.params if each.required]
        for each in required:
            each.required = False
        try:
            rest = super().parse_args(ctx, ours)
        finally:
            for each in required:
                each.required = True
        PROCESS.qos_overrides = mention_qos(ros)
        group = ctx.parent.command if ctx.parent else None
        commands = group.commands.values() if isinstance(group, click.Group) else [self]
        nodes = [command for command in commands if isinstance(command, RosCommand)]
        known = [name_of(each) for command in nodes for each in options_of(command)]
        options = options_of(self)
        ctx.params |= merge(ctx, options, given(self.node_name, ros), known)
        for each in required:
            if ctx.params.get(each.name or "") in (None, ()):
                raise click.MissingParameter(f"Or the parameter {name_of(each)!r}.", ctx=ctx, param=each)
        return rest


def split_arguments(args: list[str]) -> tuple[list[str], list[str]]:
    """Split what the user typed into arguments of the command and those for ROS 2, with their ``--ros-args``."""
    ours, ros = list(args), list[str]()
    while "--ros-args" in ours:
        start = ours.index("--ros-args")
        end = ours.index("--", start) + 1 if "--" in ours[start:] else len(ours)
        ros += ours[start:end]
        ours = ours[:start] + ours[end:]
    return ours, ros


domain_option = click.option(
    "--domain", type=click.IntRange(0, LAST_DOMAIN), metavar="D", help="Overrides ROS_DOMAIN_ID of the environment."
)


def enter(domain: int | None) -> None:
    """Set the ROS domain, and let SIGTERM and SIGHUP end the process in order."""
    if domain is not None:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
    exit_on_signals()
