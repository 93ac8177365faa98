# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The commands ``play`` and ``check`` of ``msg-agents``: a recorded network again, by a player or by the twin."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from msg_agents.cli.nodes import await_option
from msg_agents.cli.ros_command import RosCommand, domain_option, enter
from msg_analysis.cli.console import examples, print_json, print_text
from msg_analysis.cli.options import BAG, json_option, positive_option
from msg_analysis.errors import ExitCode

if TYPE_CHECKING:
    from msg_agents.nodes.player import Played


def _topics_of_bag(context: click.Context, _option: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Shell completion: the topics of the bag on the command line."""
    from msg_analysis.bags.files import read_metadata
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
        from msg_agents.replay import parse_rate

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
@positive_option("--duration", "SECONDS", "Seconds of the bag to play.")
@click.option("-l", "--loop", is_flag=True, help="Start again at the end.")
@click.option("--paused", is_flag=True, help="Start paused; the space bar continues.")
@positive_option("--clock", "HZ", "Publish the time of the bag on /clock at this rate.")
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
@await_option("Start when NODE reads the topics. Repeatable.")
@positive_option("--wait-timeout", "SECONDS", "How long to wait for readers [s].", default=30.0)
@domain_option
@json_option
def play(bag: Path, *, subscribers: int | None, domain: int | None, as_json: bool, **options: Any) -> None:
    """Play BAG: publish its messages in the recorded order.

    No message is lost: the player waits for slow readers.

    On a terminal, space pauses and continues, s plays one message, the right arrow goes forward by 5 %, a number and
    enter to that time in seconds, up and down change the rate.
    """
    from msg_agents.nodes.player import PlayOptions
    from msg_agents.nodes.player import play as play_bag

    enter(domain)
    chosen = PlayOptions(subscribers=subscribers or 0, **options)
    with PlayBar(bag.name) as bar:
        try:
            played = play_bag(
                bag, chosen, on_progress=bar.update, on_note=bar.note, on_stop=bar.hide, on_continue=bar.show
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


KEYS = "space: pause  s: one message  right: 5 % forward  number, enter: to that time  up, down: rate"


class PlayBar:
    """Prints notes on stderr and, on a terminal, a bar with the time in the bag and the rate, and the keys below."""

    def __init__(self, name: str) -> None:
        from rich.console import RenderableType
        from rich.progress import BarColumn, Progress, TextColumn
        from rich.text import Text

        from msg_agents.nodes.player import Played
        from msg_analysis.common.console import SafeConsole

        class BarAndKeys(Progress):
            def get_renderables(self) -> Iterable[RenderableType]:
                yield from super().get_renderables()
                if sys.stdin is not None and sys.stdin.isatty():
                    yield Text(KEYS, style="dim")

        self.played: Played = Played()
        self._console = SafeConsole(stderr=True)
        self._progress = BarAndKeys(
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
        state = f"{played.now:.1f}/{played.length:.1f} s  {pace}{', paused' if played.paused else ''}"
        if not played.begun:
            state = "waiting for readers"
        elif played.typed:
            state += f"  go to {played.typed} s"
        self._progress.update(self._task, completed=played.now, total=played.length, state=state, refresh=True)

    def note(self, line: str) -> None:
        """Print a note, above the bar."""
        from msg_analysis.common.console import print_note

        print_note(line, self._console)


@click.command(epilog=examples("msg-agents check runs/line_ring_20250101_120000", "msg-agents check"))
@click.argument("bag", type=BAG, required=False)
@json_option
def check(bag: Path | None, *, as_json: bool) -> None:
    """Recompute a run with the twin, bit for bit.

    The first step and agent that differ are reported. Without BAG, the newest bag below ./runs is checked.
    """
    from msg_analysis.bags.reading import read_bag
    from msg_analysis.cli.console import WorkProgress
    from msg_analysis.common.resources import watched
    from msg_analysis.common.text import with_names
    from msg_analysis.twin.check import check as check_trajectory

    path = bag or _newest_bag(Path("runs"))
    with WorkProgress() as progress, watched(progress):
        run = read_bag(path)
        outcome = check_trajectory(run)
    if as_json:
        document = {"bag": str(path), "equal": outcome.difference is None, "compared": outcome.compared}
        print_json(document | {"missing": outcome.missing, "difference": outcome.difference})
    elif outcome.difference:
        first = with_names(outcome.difference, run.record.experiment.names)
        print_text(f"{path}: differs from the twin, first: {first}")
    else:
        missing = f", {outcome.missing} missing" if outcome.missing else ""
        print_text(f"{path}: equal to the twin to the last bit: {outcome.compared} states{missing}")
    sys.exit(ExitCode.DISAGREES if outcome.difference else ExitCode.INCOMPLETE if outcome.missing else ExitCode.FINE)


def _newest_bag(directory: Path) -> Path:
    bags = sorted(directory.glob("*/metadata.yaml"), key=lambda file: file.stat().st_mtime)
    if not bags:
        raise click.UsageError(f"no bag below {directory.absolute()}: give one")
    return bags[-1].parent
