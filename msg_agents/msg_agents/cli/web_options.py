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

"""Options and helpers of the commands that serve a live page for browsers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import click

from msg_agents.cli.ros_command import RosCommand

if TYPE_CHECKING:
    from msg_agents.watching.web_server import WebServer

PORT, HOST = 8421, "127.0.0.1"
LOOPBACK = {"127.0.0.1", "localhost", "::1"}
Function = TypeVar("Function", bound=Callable[..., Any])


def web_options(function: Function) -> Function:
    """Add the options ``--web`` and ``--web-host`` to a command."""
    host = click.option(
        "--web-host",
        default=HOST,
        show_default=True,
        metavar="ADDRESS",
        help="Address of the page of --web; 0.0.0.0: for all machines that can reach this one.",
    )
    web = click.option(
        "--web",
        type=click.IntRange(0, 65535),
        metavar="[PORT]",
        is_flag=False,
        flag_value=PORT,
        default=None,
        help=f"Serve a live page for browsers on this port; {PORT} if none is given, 0: any free port.",
    )
    return web(host(function))


def with_port(args: list[str]) -> list[str]:
    """The arguments with the default port after every ``--web`` that no number follows."""
    pairs = zip(args, [*args[1:], ""], strict=False)
    return [f"--web={PORT}" if one == "--web" and not after.isdigit() else one for one, after in pairs]


class WebCommand(click.Command):
    """A command that takes ``--web`` with or without a port."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """See click.Command."""
        return super().parse_args(ctx, with_port(args))


class WebRosCommand(WebCommand, RosCommand):
    """A command of a ROS 2 node that takes ``--web`` with or without a port."""


@contextmanager
def page(port: int | None, host: str) -> Iterator[WebServer | None]:
    """Serve the live page inside the context (port 0: any free port); None without a port."""
    if port is None:
        yield None
        return
    from msg_agents.watching.web_server import WebServer

    with WebServer(host, port) as web:
        yield web


def announce(web: WebServer, host: str, note: Callable[[str], None]) -> None:
    """Note the address of the page, and that other machines can see it where that is so."""
    note(f"live page at {web.address}")
    if host not in LOOPBACK:
        note("all machines that can reach this one can see the page; it is not encrypted and has no password")
