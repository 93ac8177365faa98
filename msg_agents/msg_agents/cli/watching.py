# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Commands and options that watch a run."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from msg_agents.cli import nodes
from msg_agents.cli.ros_command import RosCommand, domain_option, enter
from msg_analysis.cli.console import examples, print_json, print_note, print_text, result_console
from msg_analysis.cli.options import BAG, RUN_RECORD, json_option, positive_option
from msg_analysis.errors import ExitCode

if TYPE_CHECKING:
    from msg_agents.nodes.live import Watched
    from msg_agents.watch.panel import Display
    from msg_agents.watch.snapshot import SnapshotSource
    from msg_agents.watch.web_server import WebServer


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
    from msg_agents.watch.web_server import WebServer

    with WebServer(host, port) as web:
        yield web


def announce(web: WebServer, host: str, note: Callable[[str], None]) -> None:
    """Note the address of the page, and that other machines can see it where that is so."""
    note(f"live page at {web.address}")
    if host not in LOOPBACK:
        note("all machines that can reach this one can see the page; it is not encrypted and has no password")


_timeout = positive_option("--timeout", "SECONDS", "How long to wait for a network [s].", show_default="no limit")


@click.command(
    cls=WebRosCommand,
    epilog=examples(
        "msg-agents live --domain 42",
        "msg-agents live --domain 42 --web",
        "msg-agents live --reliable --json    # misses nothing of:",
        "msg-agents play BAG --await live",
        "msg-agents live --bag BAG            # also of a replay without its start:",
        "ros2 bag play BAG --start-offset 50",
    ),
)
@click.option(
    "--bag",
    type=BAG,
    metavar="BAG",
    help="Take the experiment from this bag instead of the topic: for a replay that does not publish it.",
)
@click.option(
    "--experiment",
    "run_record",
    type=RUN_RECORD,
    metavar="FILE",
    help="The same from a run record, such as BAG/log/run.json.",
)
@click.option(
    "--reliable",
    is_flag=True,
    help="Receive every state: the network waits for this node if it is too slow. By default it never waits.",
)
@_timeout
@json_option
@web_options
@domain_option
def live(
    *,
    bag: Path | None,
    run_record: Path | None,
    reliable: bool,
    timeout: float | None,
    as_json: bool,
    web: int | None,
    web_host: str,
    domain: int | None,
) -> None:
    """Watch the errors of a network next to their prediction.

    The network runs, or is played. It ends with the run, or with Ctrl-C (exit code 3: the end was not reached). The
    numbers are those of `msg-analysis compare`, also published on the topic `estimate`; they are not a verdict.
    """
    from msg_agents.nodes.live import Live
    from msg_agents.nodes.watch_process import run_watcher
    from msg_agents.watch.panel import Display
    from msg_analysis.report.comparison_text import live_document

    enter(domain)
    record = nodes.record_of(bag, run_record)
    console = result_console()
    panel = console.is_terminal and not as_json
    with page(web, web_host) as served:
        if served is not None:
            announce(served, web_host, print_note)
        with Display(console, served, panel=panel, transient=False) as display:
            view = LiveView(display, None if as_json or panel else print_text)
            node = run_watcher(
                lambda: Live(reliable=reliable, record=record, on_report=view.show, on_note=view.note),
                timeout=timeout,
                on_note=print_note,
                on_look=display.check,
            )
            found = None if node is None else node.outcome
        if found is not None:
            words = "The run has ended." if found.finished else "This page is no longer updated."
            display.end({"text": words, "verdict": None if found.finished else "incomplete"})
    if found is None:
        print_note("no network was seen")
        sys.exit(ExitCode.INCOMPLETE)
    if as_json:
        print_json(live_document(found.report, found.record))
    elif found.report.note and not result_console().is_terminal:
        print_note(found.report.note)
    sys.stdout.flush()
    sys.stderr.flush()
    # All is done, and leaving the middleware may hang.
    os._exit(ExitCode.FINE if found.finished else ExitCode.INCOMPLETE)


class LiveView:
    """Shows what has been seen of a network: drawn by ``display``, and as lines where these are wanted."""

    def __init__(self, display: Display, print_line: Callable[[str], None] | None) -> None:
        self._display, self._print_line = display, print_line
        self._source: SnapshotSource | None = None
        self._notes: list[str] = []  # of the time before the first report

    def note(self, line: str) -> None:
        """Print a note about the network; on the page it is an event."""
        print_note(line)
        if self._source is None:
            self._notes.append(line)
        else:
            self._source.happened(line)

    def show(self, watched: Watched, rate: float) -> None:
        """Show the newest report; ``rate`` in steps per second."""
        from msg_agents.watch.snapshot import SnapshotSource
        from msg_analysis.report.comparison_text import live_line

        experiment, report = watched.record.experiment, watched.report
        if self._source is None:
            self._source = SnapshotSource(experiment)
            self._display.begin(experiment)
            for line in self._notes:
                self._source.happened(line)
        if watched.last_step < experiment.steps:
            self._source.ends_at(watched.last_step)
        self._display.draw(self._source.snapshot(watched.steps, report), experiment)
        if self._print_line is not None:
            self._print_line(live_line(report, watched.last_step, rate))


@click.command(
    cls=RosCommand,
    epilog=examples("msg-agents markers --domain 42", "msg-agents markers --rate 30 --replica 2 --frame map"),
)
@click.option(
    "--rate", type=click.FloatRange(0, 1000, min_open=True), metavar="HZ", default=10.0, help="Updates per second."
)
@click.option("--replica", type=click.IntRange(1), metavar="R", default=1, help="Replica to draw.")
@click.option("--frame", metavar="FRAME", default="network", help="Frame of reference: the fixed frame of RViz.")
@_timeout
@domain_option
def markers(*, rate: float, replica: int, frame: str, timeout: float | None, domain: int | None) -> None:
    """Draw a network for RViz and Foxglove.

    It publishes markers on the topic `markers`: agents on a circle, coloured by how far their states are from the
    mean (or the reference), and the links of the active graph. It ends with the run, or with Ctrl-C (exit code 3:
    the end was not reached). The network never waits for it.
    """
    from msg_agents.nodes.markers import Markers
    from msg_agents.nodes.watch_process import run_watcher

    enter(domain)
    node = run_watcher(
        lambda: Markers(rate=rate, replica=replica - 1, frame=frame, on_note=print_note),
        timeout=timeout,
        on_note=print_note,
    )
    sys.stderr.flush()
    # All is done, and leaving the middleware may hang.
    os._exit(ExitCode.FINE if node is not None and node.done.done() else ExitCode.INCOMPLETE)
