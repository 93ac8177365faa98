# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The command line ``msg-agents``.

Results go to stdout, everything else to stderr. Exit codes: 0 success or agreement, 1 disagreement, 2 bad usage or
input, 3 incomplete data. Modules that take long to import are imported by the commands that need them.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import msg_agents
from msg_agents.cli import begin, nodes, replay, watching
from msg_agents.cli.run_result import finish
from msg_agents.cli.watching import WebCommand, announce, page, web_options
from msg_agents.environment import LAST_DOMAIN, RESTARTS, USER_TIMEOUT
from msg_agents.terminal import Interruption
from msg_analysis.cli.console import CommandGroup, examples, print_notes
from msg_analysis.cli.options import (
    RUN_RECORD,
    YAML,
    choice_option,
    duration_option,
    experiment_argument,
    json_option,
    max_missed_option,
    out_option,
    parse_agents,
    positive_option,
    seed_option,
    set_option,
    source_of,
    storage_options,
    suggest,
    verbose_option,
    with_changes,
)
from msg_analysis.cli.runs import runs

if TYPE_CHECKING:
    from msg_agents.run.result import ReportWhen
    from msg_analysis.bags.stored_file import Storage


class _Commands(CommandGroup):
    """Includes the command of the process of a channel, which only a run starts: no list shows it."""

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        """The command of this name."""
        return nodes.channel if name == nodes.channel.name else super().get_command(context, name)


@click.group(cls=_Commands)
@click.version_option(msg_agents.__version__, prog_name="msg-agents")
def main() -> None:
    """Networks of agents under Markov-switching graphs, as ROS 2 processes."""


_no_analyse = click.option(
    "--no-analyse", is_flag=True, help="Do not compare the bag with the prediction: no verdict, no report."
)
_no_fork = click.option(
    "--no-fork", is_flag=True, help="Start every process as a new Python, not forked from one with all imports."
)
_write_report = choice_option(
    "--write-report",
    ["always", "on-failure", "never"],
    "When to write report.html: on-failure means that the verdict is not `agrees`.",
    default="always",
)


def _out(where: str) -> Callable[..., Any]:
    return out_option("DIR", where, default=Path("runs"))


def _override(key: str, metavar: str, values: str, *offered: str) -> Callable[..., Any]:
    text = f"Overrides run.{key}: {values}."
    return click.option(f"--{key}", metavar=metavar, shell_complete=suggest(*offered), help=text)


def _restarts(what: str) -> Callable[..., Any]:
    text = f"How often, in total, killed {what} are restarted."
    return click.option("--restarts", type=click.IntRange(0), metavar="N", default=RESTARTS, help=text)


def _interruption() -> Interruption:
    """Of a run, from the start of its processes to the end of this command, so including its comparison."""
    interruption = Interruption()
    click.get_current_context().call_on_close(interruption.end)
    return interruption


@click.command(
    cls=WebCommand,
    epilog=examples(
        "msg-agents run line_ring",
        "msg-agents run line_ring --web",
        "msg-agents run line_ring --seed 3 --duration 100 --out runs --json",
    ),
)
@experiment_argument
@_out("Directory in which the bag's directory <name>_<time> is created.")
@click.option("--no-record", is_flag=True, help="Do not record: no bag, no verdict.")
@_no_analyse
@_write_report
@max_missed_option
@seed_option
@duration_option
@set_option
@click.option(
    "--until",
    "until_text",
    metavar="PRECISION|decided",
    help="End earlier, in order: when the 95 % interval of the system error that is valid at all times has a "
    "half-width of PRECISION, such as 1%; decided: at 5%, or when the evidence exceeds its threshold.",
)
@_override("pace", "PACE", "lockstep or realtime", "lockstep", "realtime")
@click.option(
    "--speed", type=float, metavar="SPEED", help="Overrides run.speed: units of simulated time per second (realtime)."
)
@_override("delivery", "HOW", "best_effort or reliable (realtime)", "best_effort", "reliable")
@_override("processes", "P", "auto, one_per_agent or a number", "auto", "one_per_agent")
@click.option(
    "--external", metavar="AGENTS", help="Overrides run.external: agents that are programs or robots of yours, 3,5."
)
@click.option(
    "--map",
    "robots",
    type=YAML,
    metavar="MAP",
    help="Where the external agents publish their states: they are robots, and need nothing else (realtime).",
)
@positive_option(
    "--external-timeout",
    "SECONDS",
    "How long to wait for an external agent, to come and for each step [s].",
    default=USER_TIMEOUT,
)
@_restarts("agents or the switcher")
@click.option(
    "--domain", type=click.IntRange(0, LAST_DOMAIN), metavar="D", show_default="a free one", help="ROS_DOMAIN_ID."
)
@nodes.await_option(
    f"A node of yours that must read the states before the run starts, within {USER_TIMEOUT:g} s. Repeatable."
)
@nodes.use_sim_time
@click.option(
    "--channel",
    "channel_file",
    type=YAML,
    metavar="FILE",
    help="Put each process on a host of its own, or as FILE says, with loss, delay and rate between them (root).",
)
@click.option(
    "--pin/--no-pin",
    default=True,
    help="Pin each process to one core if there are more processes than cores: faster (lockstep).",
)
@_no_fork
@storage_options
@web_options
@click.option("--executor", type=click.Choice(["events", "single"]), help="For comparison only.", hidden=True)
@verbose_option
@json_option
def run(
    experiment: Path,
    *,
    out: Path,
    no_record: bool,
    no_analyse: bool,
    write_report: ReportWhen,
    max_missed: float,
    changes: tuple[str, ...],
    until_text: str | None,
    readers: tuple[str, ...],
    use_sim_time: bool,
    external: str | None,
    channel_file: Path | None,
    no_fork: bool,
    storage: Storage,
    web: int | None,
    web_host: str,
    executor: str | None,
    verbose: bool,
    as_json: bool,
    **given: Any,
) -> None:
    """Run EXPERIMENT as processes and compare it with theory.

    The run is recorded to a bag. On a terminal, a panel shows the progress; with --web, a page for browsers does, too.
    """
    from msg_agents.run.folder import load_with_overrides
    from msg_agents.run.runner import run_network
    from msg_agents.watch.panel import RunView
    from msg_analysis.model.run_record import Until

    interruption = _interruption()
    until = Until.parse(until_text) if until_text is not None else None
    values = {key: given.pop(key) for key in ("seed", "duration", "pace", "speed", "delivery", "processes")}
    if external is not None:
        values["external"] = parse_agents(external)
    what = load_with_overrides(
        experiment,
        values,
        change=lambda document: with_changes(document, changes),
        source=source_of(experiment, changes),
    )
    print_notes(what)
    channel = None
    if channel_file is not None:
        if use_sim_time or readers:
            option = "--use-sim-time" if use_sim_time else "--await"
            raise click.UsageError(f"{option}: not with --channel: other programs do not reach its hosts")
        from msg_agents.channel.channel_file import Channel

        channel = Channel.load(channel_file, what)
    with page(web, web_host) as served:
        with RunView(what, served, prints_domain=not as_json) as view:
            if served is not None:
                announce(served, web_host, view.note)
            result = run_network(
                what,
                None if no_record else out,
                readers=readers,
                use_sim_time=use_sim_time,
                storage=storage,
                fork=not no_fork,
                view=view,
                environment={"MSG_AGENTS_EXECUTOR": executor} if executor else None,
                channel=channel,
                interruption=interruption,
                until=until,
                **given,
            )
        how: dict[str, Any] = {"analyse": not no_analyse, "report": write_report, "max_missed": max_missed}
        finish(result, as_json, view.display.end, interruption=interruption, verbose=verbose, **how)


@click.command(
    epilog=examples(
        "msg-agents prepare line_ring > run.json   # once; copy it to all hosts",
        "msg-agents host run.json hosts.yaml            # on every host",
    )
)
@click.argument("run_record", type=RUN_RECORD)
@click.argument("hosts", type=YAML)
@click.option("--name", metavar="NAME", show_default="the name of this machine", help="Name of this host in HOSTS.")
@_out("Where <name>_<time> is created: bag, report and logs on the recorder's host, logs on the others.")
@positive_option("--discovery-timeout", "SECONDS", "How long to wait for the other hosts [s].", default=USER_TIMEOUT)
@positive_option(
    "--timeout",
    "SECONDS",
    "How long this host continues after another one has left the run before its end [s].",
    default=30.0,
)
@_restarts("processes of this host")
@_no_analyse
@_write_report
@max_missed_option
@_no_fork
@click.option(
    "--profile", "only_profile", is_flag=True, help="Only print the discovery profile, for other ROS 2 tools."
)
@storage_options
@verbose_option
@json_option
def host(
    run_record: Path,
    hosts: Path,
    *,
    name: str | None,
    out: Path,
    discovery_timeout: float,
    timeout: float,
    restarts: int,
    no_analyse: bool,
    write_report: ReportWhen,
    max_missed: float,
    no_fork: bool,
    only_profile: bool,
    storage: Storage,
    verbose: bool,
    as_json: bool,
) -> None:
    """Run one host's part of a network on several hosts.

    The file HOSTS says which agents run where. Give all hosts the same RUN_RECORD (from `msg-agents prepare`) and
    HOSTS; start them in any order. The recorder's host compares the record with the theory, as `msg-agents run`
    does; the others end with the run.
    """
    from msg_agents.process_layout import Hosts
    from msg_agents.run.folder import temporary_directory
    from msg_agents.run.runner import run_network
    from msg_agents.watch.panel import RunView
    from msg_analysis.common.text import agent_name
    from msg_analysis.experiment.problems import show

    interruption = _interruption()
    record = nodes.load_record(run_record)
    what = record.experiment
    places = Hosts.load(hosts, what)
    if only_profile:
        click.echo(places.profile(what), nl=False)
        return
    assignment = places.assignment(name or socket.gethostname(), discovery_timeout, timeout)
    mine = show([agent_name(agent + 1, what.names) if what.names else agent + 1 for agent in assignment.agents])
    with temporary_directory() as folder, RunView(what) as view:
        also = " and the recorder" if assignment.has_recorder else ""
        view.note(f"this host runs agents {mine}{also} in ROS_DOMAIN_ID {places.domain}")
        result = run_network(
            what,
            out,
            domain=places.domain,
            restarts=restarts,
            storage=storage,
            fork=not no_fork,
            view=view,
            environment=places.environment(what, folder),
            record=record,
            assignment=assignment,
            interruption=interruption,
        )
    how: dict[str, Any] = {"analyse": not no_analyse, "report": write_report, "max_missed": max_missed}
    finish(result, as_json, interruption=interruption, verbose=verbose, **how)
    if not assignment.has_recorder and not as_json:
        click.echo(f"the run has ended: its verdict is on {places.recorder}")


main.add_section("Start here", begin.demo_of(run), begin.examples, begin.new, begin.doctor)
main.add_section("Runs", run, host, runs, watching.live, watching.markers, begin.schema)
main.add_section("Bags", replay.check, replay.play)
main.add_section("Single nodes", nodes.prepare, nodes.agent, nodes.external, nodes.switcher, nodes.recorder)
