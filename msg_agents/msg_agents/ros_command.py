"""Commands that are ROS 2 nodes."""

from __future__ import annotations

import click


class RosCommand(click.Command):
    """Takes arguments for ROS 2 as any ROS node does: ``--ros-args ... [--]``. rclpy finds them by itself."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """See click.Command."""
        while "--ros-args" in args:
            start = args.index("--ros-args")
            end = args.index("--", start) + 1 if "--" in args[start:] else len(args)
            args = args[:start] + args[end:]
        return super().parse_args(ctx, args)
