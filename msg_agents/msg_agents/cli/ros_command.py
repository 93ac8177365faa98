"""Commands that are ROS 2 nodes."""

from __future__ import annotations

from typing import Any

import click

from msg_agents.nodes.ros.node_parameters import (
    GIVES_PARAMETERS,
    PROCESS,
    given,
    mention_qos,
    merge,
    name_of,
    options_of,
)
from msg_agents.processes.environment import check_domain


class RosCommand(click.Command):
    """Takes arguments for ROS 2 as any ROS node does: ``--ros-args ... [--]``.

    rclpy finds them by itself. Parameters among them stand for options that are not on the command line.

    Parameters
    ----------
    *args
        see click.Command
    node_name
        by which parameters are found, where they are given to a certain node; the command's name by default
    **options
        see click.Command
    """

    def __init__(self, *args: Any, node_name: str | None = None, **options: Any) -> None:
        super().__init__(*args, **options)
        self.node_name = node_name or self.name or ""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """See click.Command."""
        ours, ros = split_arguments(args)
        if ctx.resilient_parsing:  # a shell asks how the line could go on, perhaps behind an option without its value
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
        """See click.Command."""
        if ctx.params.get("domain") is None:
            check_domain()
        return super().invoke(ctx)

    def _parse_with_parameters(self, ctx: click.Context, ours: list[str], ros: list[str]) -> list[str]:
        # Whether something is missing turns out only when the parameters have been read.
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
    """Arguments of the command, and those for ROS 2 with their ``--ros-args``.

    Parameters
    ----------
    args
        as the user has typed them
    """
    ours, ros = list(args), list[str]()
    while "--ros-args" in ours:
        start = ours.index("--ros-args")
        end = ours.index("--", start) + 1 if "--" in ours[start:] else len(ours)
        ros += ours[start:end]
        ours = ours[:start] + ours[end:]
    return ours, ros
