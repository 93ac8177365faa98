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

"""Commands of ``msg-agents`` about running and recorded networks: ``play``, ``live`` and ``markers``."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from msg_agents.cli import nodes
from msg_agents.cli.ros_command import RosCommand
from msg_agents.cli.web_options import WebRosCommand, announce, page, web_options
from msg_agents.processes.environment import LAST_DOMAIN
from msg_agents.terminal.interruption import exit_on_signals
from msg_analysis.cli.console import examples, print_json, print_text, result_console
from msg_analysis.cli.options import BAG, RUN_RECORD, PositiveFloat, json_option
from msg_analysis.common.exit_codes import ExitCode
from msg_analysis.common.text.notes import print_note

if TYPE_CHECKING:
    from msg_agents.nodes.replay.player import Played
    from msg_agents.nodes.watching.live import Watched
    from msg_agents.watching.display import Display
    from msg_agents.watching.snapshot import SnapshotSource

_domain = click.option(
    "--domain", type=click.IntRange(0, LAST_DOMAIN), metavar="D", help="Overrides ROS_DOMAIN_ID of the environment."
)
_timeout = click.option(
    "--timeout",
    type=PositiveFloat(),
    metavar="SECONDS",
    show_default="no limit",
    help="How long to wait for a network [s].",
)


def _topics_of_bag(context: click.Context, _option: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Shell completion: the topics of the bag on the command line."""
    from msg_analysis.bags.format.metadata import read_metadata
    from msg_analysis.errors import InputError

    try:
        information = read_metadata(Path(context.params["bag"])) or {}
        names = [entry["topic_metadata"]["name"] for entry in information["topics_with_message_count"]]
    except (InputError, OSError, KeyError, TypeError):  # better no completion than a wrong one
        return []
    return [CompletionItem(name) for name in sorted(names) if name.startswith(incomplete)]


class _Rate(click.types.FloatParamType):
    """A positive number, or "max" (infinite)."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """See click.ParamType."""
        from msg_agents.replay.bag_clock import parse_rate

        try:
            return parse_rate(value)
        except ValueError:
            self.fail(f"{value}: expected a positive number, or max (as a parameter, .inf)", param, ctx)


@click.command(
    cls=RosCommand,
    node_name="player",
    epilog=examples(
        "msg-agents play runs/line_ring_20260114_083441",
        "msg-agents play BAG --rate max --await recorder",
        "msg-agents play BAG --topics '/agent_*/state' --start-offset 10 --clock 100",
        "msg-agents play BAG --remap /agent_1/state:=/lab/one",
    ),
)
@click.argument("bag", type=BAG)
@click.option(
    "-r",
    "--rate",
    type=_Rate(),
    metavar="RATE",
    default="1",
    help="Seconds of the bag per second; of a network's bag, units of simulated time. max: as fast as readers allow.",
)
@click.option(
    "--start-offset",
    type=click.FloatRange(0, 1e9),
    default=0.0,
    metavar="SECONDS",
    help="Seconds of the bag to leave out at the start.",
)
@click.option("--duration", type=PositiveFloat(), metavar="SECONDS", help="Seconds of the bag to play.")
@click.option("-l", "--loop", is_flag=True, help="Start again at the end.")
@click.option("--paused", is_flag=True, help="Start paused; the space bar continues.")
@click.option(
    "--clock",
    type=PositiveFloat(),
    metavar="HZ",
    help="Publish the time of the bag on /clock at this rate.",
)
@click.option(
    "--topics",
    multiple=True,
    metavar="TOPIC",
    shell_complete=_topics_of_bag,
    help="Play only this topic, or pattern such as '/agent_*/state'. Repeatable.",
)
@click.option(
    "-x",
    "--exclude",
    multiple=True,
    metavar="TOPIC",
    shell_complete=_topics_of_bag,
    help="Do not play this topic, or pattern. Repeatable.",
)
@click.option("-m", "--remap", "remaps", multiple=True, metavar="OLD:=NEW", help="Rename a topic. Repeatable.")
@click.option(
    "--wait-for-subscribers",
    "subscribers",
    type=click.IntRange(1),
    metavar="N",
    help="Start when every topic has N readers (except latched topics, whose readers miss nothing).",
)
@click.option("--await", "readers", multiple=True, metavar="NODE", help="Start when NODE reads the topics. Repeatable.")
@click.option(
    "--wait-timeout",
    type=PositiveFloat(),
    metavar="SECONDS",
    default=30.0,
    help="How long to wait for readers [s].",
)
@_domain
@json_option
def play(
    bag: Path,
    *,
    rate: float,
    start_offset: float,
    duration: float | None,
    loop: bool,
    paused: bool,
    clock: float | None,
    topics: tuple[str, ...],
    exclude: tuple[str, ...],
    remaps: tuple[str, ...],
    subscribers: int | None,
    readers: tuple[str, ...],
    wait_timeout: float,
    domain: int | None,
    as_json: bool,
) -> None:
    """Play BAG, a bag of ROS 2: publish its messages in the recorded order.

    No message is lost: the player waits for slow readers.

    On a terminal, space pauses and continues, s or the right arrow plays one message, up and down change the rate.
    """
    from msg_agents.nodes.replay.player import PlayOptions
    from msg_agents.nodes.replay.player import play as play_bag

    _enter(domain)
    options = PlayOptions(
        rate=rate,
        start_offset=start_offset,
        duration=duration,
        loop=loop,
        paused=paused,
        clock=clock,
        topics=topics,
        exclude=exclude,
        remaps=remaps,
        subscribers=subscribers or 0,
        readers=readers,
        wait_timeout=wait_timeout,
    )
    with PlayBar(bag.name) as bar:
        try:
            played = play_bag(
                bag, options, on_progress=bar.update, on_note=bar.note, on_stop=bar.hide, on_continue=bar.show
            )
        except (KeyboardInterrupt, SystemExit):
            if bar.played.begun:
                bar.note(f"stopped at {bar.played.now:g} s of the bag after {bar.played.messages} messages")
            else:
                bar.note("stopped before the start: only latched messages were played")
            raise
    held = f"; waited {played.held_back:.1f} s for readers" if played.held_back >= 0.1 else ""
    click.echo(f"{played.messages} messages played in {played.seconds:.1f} s{held}", err=True)
    if as_json:
        print_json({"messages": played.messages, "seconds": played.seconds, "held_back": played.held_back})


class PlayBar:
    """Prints notes on stderr and, on a terminal, a bar with the time in the bag and the rate."""

    def __init__(self, name: str) -> None:
        from rich.progress import BarColumn, Progress, TextColumn

        from msg_agents.nodes.replay.player import Played
        from msg_analysis.common.text.safe_console import SafeConsole

        self.played: Played = Played()
        self._console = SafeConsole(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[state]}"),
            console=self._console,
            disable=not self._console.is_terminal,
            transient=True,
            auto_refresh=False,  # no thread: it might hold a lock that a signal handler needs
        )
        self._task = self._progress.add_task(name, total=None, state="waiting for readers")

    def __enter__(self) -> PlayBar:
        self.show()
        return self

    def __exit__(self, *_: object) -> None:
        self.hide()

    def show(self) -> None:
        """Draw the bar from now on."""
        self._progress.start()

    def hide(self) -> None:
        """Remove the bar, and leave the terminal as it was."""
        self._progress.stop()

    def update(self, played: Played) -> None:
        """Show how far it came."""
        self.played = played
        pace = "as fast as it goes" if math.isinf(played.rate) else f"x {played.rate:.3g}"
        state = f"{played.now:.1f}/{played.length:.1f} s  {'paused' if played.paused else pace}"
        if not played.begun:
            state = "waiting for readers"
        self._progress.update(self._task, completed=played.now, total=played.length, state=state, refresh=True)

    def note(self, line: str) -> None:
        """Print a note, above the bar."""
        print_note(line, self._console)


def _enter(domain: int | None) -> None:
    """Set the ROS domain, and let SIGTERM and SIGHUP end the process in order."""
    if domain is not None:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
    exit_on_signals()


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
@_domain
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

    _enter(domain)
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

    def show(self, watched: Watched, rate: float) -> None:
        """Show the newest report; ``rate`` in steps per second."""
        from msg_agents.watching.snapshot import SnapshotSource
        from msg_analysis.report.terminal.live_text import live_line

        experiment, report = watched.record.experiment, watched.report
        if self._source is None:
            self._source = SnapshotSource(experiment)
            self._display.begin(experiment)
        self._display.draw(self._source.snapshot(watched.steps, report), experiment)
        if self._print_line is not None:
            self._print_line(live_line(report, watched.record, rate))


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
@_domain
def markers(*, rate: float, replica: int, frame: str, timeout: float | None, domain: int | None) -> None:
    """Draw a network, running or played, for RViz and Foxglove: markers on the topic `markers`.

    Agents on a circle, coloured by how far their states are from the mean (or the reference), and the links of the
    active graph. It ends with the run, or with Ctrl-C (exit code 3: the end was not reached). The network never waits
    for it.
    """
    from msg_agents.nodes.watching.markers import show_markers

    _enter(domain)
    over = show_markers(rate=rate, replica=replica - 1, frame=frame, timeout=timeout, on_note=print_note)
    sys.stderr.flush()
    # All is done, and leaving the middleware may hang.
    os._exit(ExitCode.FINE if over else ExitCode.INCOMPLETE)
