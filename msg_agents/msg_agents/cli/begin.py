# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Commands to begin with: ``demo``, ``examples``, ``new``, ``doctor``, ``schema``."""

from __future__ import annotations

import shlex
import sys
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from msg_analysis.cli.console import examples as example_lines
from msg_analysis.cli.console import print_json, print_note, print_text, result_console
from msg_analysis.cli.options import PATH, choice_option, json_option, positive_option
from msg_analysis.errors import ExitCode, InputError
from msg_analysis.experiment.examples import (
    FOLDER,
    KINDS,
    MOST_AGENTS,
    SUFFIX,
    Choices,
    experiment_name,
    experiment_text,
    names,
    shows,
    text_of,
    trace_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

    from msg_agents.doctor.checks import CheckResult


DEMO = "line_ring"
DEFAULT = Choices()


def demo_of(run: click.Command) -> click.Command:
    """The command ``demo``: ``run`` with all its options, of one example."""

    def demo(**options: Any) -> None:
        cast("Callable[..., None]", run.callback)(FOLDER / f"{DEMO}{SUFFIX}", **options)

    return type(run)(
        "demo",
        params=[parameter for parameter in run.params if not isinstance(parameter, click.Argument)],
        callback=demo,
        help=f"Run the example {DEMO}: a verdict in some seconds.\n\n"
        f"Five agents, a switcher and a recorder. The same as `msg-agents run {DEMO}` with the installed file.",
        epilog=example_lines("msg-agents demo", "msg-agents demo --web", "msg-agents demo --duration 100 --json"),
    )


@click.command(epilog=example_lines("msg-agents examples", "msg-agents examples line_ring > mine.yaml"))
@click.argument("name", required=False)
@json_option
def examples(name: str | None, *, as_json: bool) -> None:
    """List the examples, or print the file of one.

    Every command that takes an experiment takes these names. A trace that an example reads is printed by its own name.
    """
    if name is not None and (trace := trace_of(name)):
        print_note(f"{name} reads {trace}, which has to be beside it: msg-agents examples {trace} > {trace}")
    if name is None and as_json:
        print_json({"examples": [{"name": each, "shows": shows(each)} for each in names()]})
    elif name is None:
        from rich.table import Table

        table = Table(box=None, show_header=False, pad_edge=False)
        table.add_column(no_wrap=True)
        table.add_column()
        for each in names():
            table.add_row(each, shows(each))
        result_console().print(table)
    elif as_json:
        print_json({"name": name, "shows": shows(name), "text": text_of(name)})
    else:
        click.echo(text_of(name), nl=False)


@click.command(
    epilog=example_lines(
        "msg-agents new",
        "msg-agents new lab.yaml --agents 8 --graph ring --graph star",
        "msg-agents new lab.yaml --time discrete --switching 0.1 --leader 1",
    )
)
@click.argument("file", type=PATH, default=Path("network.yaml"))
@click.option("--agents", type=click.IntRange(2, MOST_AGENTS), metavar="M", default=DEFAULT.agents, help="How many.")
@click.option(
    "--graph",
    "graphs",
    type=click.Choice(KINDS),
    multiple=True,
    default=DEFAULT.graphs,
    help="A graph of the network. Repeatable: the network switches between the graphs.",
)
@choice_option(
    "--time",
    ["continuous", "discrete"],
    "Continuous: Euler steps of run.dt; discrete: one step is one unit of time.",
    default=DEFAULT.time,
)
@positive_option(
    "--switching",
    "RATE",
    "How often a graph is left: jumps per unit of time; in discrete time the probability of a jump after a step.",
    default=DEFAULT.switching,
)
@positive_option("--noise", "F", "Noise gain of all agents.", default=DEFAULT.noise)
@click.option(
    "--loss",
    type=click.FloatRange(0, 1, max_open=True),
    metavar="P",
    default=DEFAULT.loss,
    help="Probability that a message is lost.",
)
@click.option(
    "--leader",
    "leaders",
    type=click.IntRange(1),
    multiple=True,
    metavar="AGENT",
    help="An agent that knows the reference, which the others follow. Repeatable; without one, the agents agree.",
)
@positive_option("--duration", "T", "Duration of the run, in units of simulated time.", show_default="4000 steps")
@json_option
def new(file: Path, *, as_json: bool, **given: Any) -> None:
    """Write a new experiment, with comments, to FILE.

    FILE must not exist. Without options, a terminal asks for the values; otherwise what is not given has its default.
    """
    from msg_analysis.common.files import require_place, write_whole
    from msg_analysis.experiment.experiment import Experiment
    from msg_analysis.experiment.loading import parse_yaml

    if file.exists():
        raise InputError(f"{file}: exists already: remove it, or choose another name")
    context = click.get_current_context()
    options = {parameter.name for parameter in context.command.params if isinstance(parameter, click.Option)}
    untouched = all(
        context.get_parameter_source(name) is click.core.ParameterSource.DEFAULT for name in options if name
    )
    asked = untouched and sys.stdin.isatty() and sys.stderr.isatty()
    chosen = _ask(context.command) if asked else Choices(**given)
    _check(chosen)
    require_place(file)
    name = experiment_name(file.stem)
    text = experiment_text(name, chosen)
    Experiment.parse(parse_yaml(text, str(file)), source=str(file)).require_available()
    write_whole(file, text.encode())
    if as_json:
        print_json({"file": str(file), "experiment": name})
        return
    word = shlex.quote(str(file))
    print_text(str(file))
    print_text(f"Next: msg-analysis predict {word}")
    print_text(f"      msg-agents run {word}")


def _check(chosen: Choices) -> None:
    """Refuse what does not fit together, in the words of the options. Raises InputError."""
    if not chosen.graphs:
        raise InputError(f"--graph: none: expected at least one of {', '.join(KINDS)}")
    if repeated := [kind for kind in KINDS if chosen.graphs.count(kind) > 1]:
        raise InputError(f"--graph: {repeated[0]}: expected different graphs: remove one")
    if "ring" in chosen.graphs and chosen.agents < 3:
        raise InputError(f"--agents: {chosen.agents}: expected at least 3 for a ring: give more, or another --graph")
    for leader in chosen.leaders:
        if leader > chosen.agents:
            raise InputError(f"--leader: {leader}: expected an agent from 1 to {chosen.agents}")
    if chosen.time == "discrete" and not chosen.switching < 1:
        raise InputError(f"--switching: {chosen.switching:g}: expected a probability below 1 in discrete time")
    steps = chosen.length / chosen.step
    if round(steps) < 1 or abs(steps - round(steps)) > 1e-9 * steps:
        raise InputError(f"--duration: {chosen.length:g}: expected a multiple of the step {chosen.step:g}")


def _ask(command: click.Command) -> Choices:
    """The values of the options, each typed on the terminal; Enter takes the default."""

    def answer(text: str, name: str, default: Any) -> Any:
        (option,) = (each for each in command.params if each.name == name)
        return click.prompt(text, default=default, type=option.type, err=True)

    click.echo("A new experiment: Enter takes the value in brackets.", err=True)
    agents = answer("Agents", "agents", DEFAULT.agents)
    kinds, several = ", ".join(DEFAULT.graphs), _words(click.Choice(KINDS))
    graphs = click.prompt(f"Graphs, of {', '.join(KINDS)}", default=kinds, value_proc=several, err=True)
    time = answer("Time", "time", DEFAULT.time)
    switching = DEFAULT.switching
    if len(graphs) > 1:
        what = "Jumps per unit of time" if time == "continuous" else "Probability of a jump after a step"
        switching = answer(what, "switching", DEFAULT.switching)
    noise = answer("Noise gain", "noise", DEFAULT.noise)
    loss = answer("Probability that a message is lost", "loss", DEFAULT.loss)
    agent = _words(click.IntRange(1, agents))
    leaders = click.prompt("Leaders, numbers of agents", default="none", value_proc=agent, err=True)
    chosen = Choices(agents, graphs, time, switching, noise, loss, leaders)
    return replace(chosen, duration=answer("Duration", "duration", chosen.length))


def _words(kind: Any) -> Callable[[str], tuple[Any, ...]]:
    """Reads values of a click type with commas or spaces between them; ``none``: an empty tuple."""

    def read(text: str) -> tuple[Any, ...]:
        words = text.replace(",", " ").split()
        return () if words == ["none"] else tuple(dict.fromkeys(kind.convert(word, None, None) for word in words))

    return read


@click.command(epilog=example_lines("msg-agents schema > channel.schema.json"))
def schema() -> None:
    """Print the JSON Schema of channel files, for editors."""
    from msg_agents.channel.channel_file import json_schema

    print_json(json_schema(), indent=2)


STYLES = {"ok": "green", "warning": "bold yellow", "error": "bold red"}


@click.command(epilog=example_lines("msg-agents doctor"))
@json_option
def doctor(*, as_json: bool) -> None:
    """Check whether this machine can run networks.

    It also shows how to fix problems. The last check runs two processes for a second. Exit code 2: a run cannot work;
    warnings do not change it.
    """
    from msg_agents.doctor.network_checks import examine

    console, found = result_console(), []
    for check in examine():
        found.append(check)
        if not as_json:
            _print_check(console, check)
    counts = Counter(check.status for check in found)
    can_run = not counts["error"]
    if as_json:
        counted = {"errors": counts["error"], "warnings": counts["warning"]}
        print_json({"can_run": can_run, **counted, "checks": [asdict(check) for check in found]})
    else:
        noted = f" ({counts['warning']} warning{'s' * (counts['warning'] > 1)})" if counts["warning"] else ""
        console.print(f"A run can{'' if can_run else 'not'} work here{noted}.", soft_wrap=True)
    if not can_run:
        sys.exit(ExitCode.BAD_INPUT)


def _print_check(console: Console, check: CheckResult) -> None:
    """One line; terminals get the text folded in a column of its own."""
    from rich.table import Table
    from rich.text import Text

    status, name = Text(f"{check.status:<8}", STYLES[check.status]), Text(f"{check.name.replace('_', ' '):<20}", "bold")
    if console.is_terminal:
        row = Table.grid(padding=(0, 1))
        row.add_row(status, name, Text(check.text, overflow="fold"))
        row.columns[0].no_wrap = row.columns[1].no_wrap = True
        console.print(row)
    else:
        console.print(Text(" ").join([status, name, Text(check.text)]))
