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

"""The commands ``live`` and ``markers`` of ``msg-agents``: networks, running or played, are watched."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from msg_agents.cli import nodes
from msg_agents.cli.ros_command import RosCommand, domain_option, enter
from msg_agents.cli.web_options import WebRosCommand, announce, page, web_options
from msg_analysis.cli.console import examples, print_json, print_text, result_console
from msg_analysis.cli.options import BAG, RUN_RECORD, PositiveFloat, json_option
from msg_analysis.common.exit_codes import ExitCode
from msg_analysis.common.text.notes import print_note

if TYPE_CHECKING:
    from msg_agents.nodes.watching.live import Watched
    from msg_agents.watching.display import Display
    from msg_agents.watching.snapshot import SnapshotSource

_timeout = click.option(
    "--timeout",
    type=PositiveFloat(),
    metavar="SECONDS",
    show_default="no limit",
    help="How long to wait for a network [s].",
)


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
    """Watch a network, running or played: its errors so far next to their prediction.

    It ends with the run, or with Ctrl-C (exit code 3: the end was not reached). The numbers are those of `msg-analysis
    compare`, also published on the topic `estimate`; they are not a verdict.
    """
    from msg_agents.nodes.watching.live import watch
    from msg_agents.watching.display import Display
    from msg_analysis.report.terminal.live_text import live_document

    enter(domain)
    record = nodes.record_of(bag, run_record)
    console = result_console()
    panel = console.is_terminal and not as_json
    with page(web, web_host) as served:
        if served is not None:
            announce(served, web_host, print_note)
        with Display(console, served, panel=panel, transient=False) as display:
            view = LiveView(display, None if as_json or panel else print_text)
            found = watch(
                reliable=reliable,
                record=record,
                timeout=timeout,
                on_report=view.show,
                on_note=print_note,
                on_event=view.note,
                on_look=display.check,
            )
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
        from msg_agents.watching.snapshot import SnapshotSource
        from msg_analysis.report.terminal.live_text import live_line

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
    "--rate",
    type=click.FloatRange(0, 1000, min_open=True),
    metavar="HZ",
    default=10.0,
    help="Updates per second.",
)
@click.option("--replica", type=click.IntRange(1), metavar="R", default=1, help="Replica to draw.")
@click.option("--frame", metavar="FRAME", default="network", help="Frame of reference: the fixed frame of RViz.")
@_timeout
@domain_option
def markers(*, rate: float, replica: int, frame: str, timeout: float | None, domain: int | None) -> None:
    """Draw a network, running or played, for RViz and Foxglove: markers on the topic `markers`.

    Agents on a circle, coloured by how far their states are from the mean (or the reference), and the links of the
    active graph. It ends with the run, or with Ctrl-C (exit code 3: the end was not reached). The network never waits
    for it.
    """
    from msg_agents.nodes.watching.markers import show_markers

    enter(domain)
    over = show_markers(rate=rate, replica=replica - 1, frame=frame, timeout=timeout, on_note=print_note)
    sys.stderr.flush()
    # All is done, and leaving the middleware may hang.
    os._exit(ExitCode.FINE if over else ExitCode.INCOMPLETE)
