# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Commands of ``msg-agents`` that run one process of a network: ``agent``, ``switcher``, ``recorder``; ``prepare``."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from msg_agents.cli.ros_command import RosCommand
from msg_agents.environment import DISCOVERY_TIMEOUT
from msg_agents.run.fork_server import exit_with_pipe
from msg_analysis.cli.console import examples
from msg_analysis.cli.options import (
    PATH,
    RUN_RECORD,
    YAML,
    experiment_argument,
    load_experiment,
    out_option,
    positive_option,
    storage_options,
    suggest,
)
from msg_analysis.errors import ExitCode

if TYPE_CHECKING:
    from msg_agents.nodes.base import NetworkNode
    from msg_agents.stepping.monitoring import ClockOffsets
    from msg_analysis.bags.stored_file import Storage
    from msg_analysis.model.run_record import RunRecord


use_sim_time = click.option(
    "--use-sim-time",
    is_flag=True,
    help="Take the time from /clock, which another program publishes in the same domain (realtime).",
)


def _node_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that the commands of single nodes share."""
    for option in (
        click.argument("run_record", type=RUN_RECORD),
        positive_option(
            "--discovery-timeout", "SECONDS", "How long to wait for the other nodes [s].", default=DISCOVERY_TIMEOUT
        ),
        use_sim_time,
        click.option(
            "--parameter-services",
            is_flag=True,
            help="Offer the parameters to `ros2 param`: six services per node, too many for large networks.",
        ),
        click.option("--lifeline", type=int, hidden=True),
        click.option("--introduction", type=int, hidden=True),
        click.option("--namespace", type=int, hidden=True),
        click.option(
            "--status-file",
            type=PATH,
            metavar="FILE",
            help="Status file, written every second: rejected messages, what the nodes wait for (health checks).",
        ),
    ):
        command = option(command)
    return command


def await_option(text: str, *offered: str) -> Callable[..., Any]:
    """The option ``--await``, for names of nodes; ``text``: its help."""
    return click.option(
        "--await", "readers", multiple=True, metavar="NODE", shell_complete=suggest(*offered), help=text
    )


_await = await_option("A node, such as recorder, that must be present before the run starts. Repeatable.", "recorder")
_timeout = positive_option(
    "--timeout",
    "SECONDS",
    "How long to continue after other nodes have left before the end [s].",
    show_default="no limit",
)
_checkpoint = click.option(
    "--checkpoint",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Directory for what is needed to continue after being killed: the same command then takes over.",
)


def _agents_of_record(context: click.Context, _option: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Shell completion: the agents of the run record on the command line."""
    try:
        agents = len(json.loads(Path(context.params["run_record"]).read_text(encoding="utf-8"))["start"])
    except (OSError, ValueError, KeyError, TypeError):  # better no completion than a wrong one
        return []
    return [CompletionItem(str(i)) for i in range(1, agents + 1) if str(i).startswith(incomplete)]


_agent = click.option(
    "--agent",
    "agents",
    type=int,
    metavar="I",
    multiple=True,
    required=True,
    shell_complete=_agents_of_record,
    help="Number of an agent, from 1. Repeatable.",
)


@click.command(epilog=examples("msg-agents prepare line_ring > run.json"))
@experiment_argument
def prepare(experiment: Path) -> None:
    """Print the run record of a new run of EXPERIMENT.

    Single nodes are started with this file.
    """
    from msg_analysis.twin.simulate import new_record

    what = load_experiment(experiment)
    what.require_available()
    click.echo(new_record(what).to_json(with_key=True))


@click.command(cls=RosCommand, epilog=examples("msg-agents agent run.json --agent 1 --agent 2 --await recorder"))
@_node_options
@_agent
@_await
@_checkpoint
@_timeout
def agent(
    run_record: Path, *, agents: tuple[int, ...], readers: tuple[str, ...], checkpoint: Path | None, **options: Any
) -> None:
    """Run one or more agents in one process."""
    from msg_analysis.errors import InputError

    record = load_record(run_record)
    record.experiment.require_available()
    total = record.experiment.agents
    for number in agents:
        if not 1 <= number <= total:
            raise InputError(f"--agent: {number}: expected a number from 1 to {total}")
    if len(set(agents)) < len(agents):
        raise InputError(f"--agent: {list(agents)}: expected each agent once")

    def nodes() -> list[NetworkNode]:
        from msg_agents.nodes.agent_group import AgentGroup
        from msg_agents.nodes.process import store_participant
        from msg_agents.recovery import take_over
        from msg_analysis.messages.topics import agent_node_name

        indices = [number - 1 for number in agents]
        model, directory = record.model, _make(checkpoint)
        takeovers = take_over(directory, map(agent_node_name, indices))
        group = AgentGroup(record=record, model=model, agents=indices, readers=readers, checkpoints=directory)
        store_participant(takeovers, group.nodes[0])
        return list(group.nodes)

    _run_nodes(nodes, record, **options)


@click.command(
    cls=RosCommand, epilog=examples("msg-agents external run.json --agent 5 --map map.yaml --await recorder")
)
@_node_options
@_agent
@click.option("--map", "map_file", type=YAML, metavar="MAP", required=True, help="Where its state is: topic and field.")
@_await
@click.option("--checkpoint", type=PATH, hidden=True)
def external(
    run_record: Path,
    *,
    agents: tuple[int, ...],
    map_file: Path,
    readers: tuple[str, ...],
    checkpoint: Path | None,
    **options: Any,
) -> None:
    """Stand in a run for a robot of one's own.

    The robot publishes its state on the topic that the map names, in real time, and may read what it hears of agent J
    on agent_I/heard/agent_J (std_msgs/Float64). `msg-agents run --external --map` starts this by itself.
    """
    from msg_agents.nodes.topic_agent import TopicAgent
    from msg_analysis.bags.log_map import load_map
    from msg_analysis.errors import InputError

    if len(agents) > 1:
        raise InputError(f"--agent: {list(agents)}: expected one agent: start a process for each robot")
    record = load_record(run_record)
    robot = TopicAgent(record, agents[0], load_map(map_file), readers=readers)
    _run_nodes(lambda: list(robot.make_nodes(checkpoint)), record, **options)


@click.command(cls=RosCommand, epilog=examples("msg-agents switcher run.json --await recorder"))
@_node_options
@_await
@_checkpoint
@_timeout
@click.option("--steps", type=PATH, hidden=True)
@click.option("--active-graph", type=PATH, hidden=True)
@click.option("--clocks", type=PATH, hidden=True)
def switcher(
    run_record: Path,
    *,
    readers: tuple[str, ...],
    checkpoint: Path | None,
    steps: Path | None,
    active_graph: Path | None,
    clocks: Path | None,
    timeout: float | None,
    **options: Any,
) -> None:
    """Run the switcher.

    It publishes the experiment and the active graph.
    """
    record = load_record(run_record)

    def report(reached: Sequence[int]) -> None:
        from msg_agents.run.result import write_report

        if steps is not None:
            write_report(steps, reached)

    def note_clocks(offsets: ClockOffsets, warning: str | None) -> None:
        from msg_agents.run.result import write_report

        if clocks is not None:
            write_report(clocks, {"offsets": offsets.to_json(), "warning": warning})

    def tell_channel(file: Path | None) -> Callable[[int], None]:
        if file is None:
            return lambda _: None
        from msg_agents.channel.process import ActiveGraphFile

        return ActiveGraphFile(file).set_mode

    def nodes() -> list[NetworkNode]:
        from msg_agents.nodes.base import ACK_TIMEOUT
        from msg_agents.nodes.process import store_participant
        from msg_agents.nodes.switcher import SWITCHERS
        from msg_agents.recovery import take_over

        model, directory = record.model, _make(checkpoint)
        takeovers = take_over(directory, ["switcher"])
        kind = SWITCHERS[record.experiment.run.pace]
        node = kind(
            record=record,
            model=model,
            readers=list(readers),
            on_progress=report,
            on_graph=tell_channel(active_graph),
            checkpoints=directory,
            on_clocks=None if timeout is None else note_clocks,
            ack_timeout=max(ACK_TIMEOUT, timeout or 0.0),
        )
        store_participant(takeovers, node)
        return [node]

    _run_nodes(nodes, record, timeout=timeout, **options)


@click.command(cls=RosCommand, epilog=examples("msg-agents recorder run.json --out runs/mine"))
@_node_options
@out_option("BAG", "Bag to write; must not exist.", required=True)
@storage_options
@_timeout
def recorder(run_record: Path, *, out: Path, storage: Storage, **options: Any) -> None:
    """Record the run in RUN_RECORD to a bag."""
    record = load_record(run_record)

    def nodes() -> list[NetworkNode]:
        from msg_agents.nodes.recorder import Recorder, keep_freed_memory

        keep_freed_memory()
        return [Recorder(record=record, directory=out, storage=storage)]

    _run_nodes(nodes, record, **options)


@click.command()
@click.option("--control", type=int, required=True)
def channel(control: int) -> None:
    """Be the channel of a run, which tells it over the socket CONTROL what to do."""
    from msg_agents.channel.process import serve

    serve(control)


def _run_nodes(
    nodes: Callable[[], list[NetworkNode]],
    record: RunRecord,
    *,
    lifeline: int | None,
    namespace: int | None,
    parameter_services: bool,  # noqa: ARG001  see LeanNode
    status_file: Path | None,
    introduction: int | None,
    timeout: float | None = None,
    **options: Any,  # of ``run_nodes``
) -> None:
    if namespace is not None:
        from msg_agents.channel.process import enter

        enter(namespace)
    if lifeline is not None:
        exit_with_pipe(lifeline)
    from msg_agents.nodes.process import run_nodes

    executor = os.environ.get("MSG_AGENTS_EXECUTOR") or "events"
    throughput = record.experiment.run.pace == "lockstep"
    options |= {"status_file": status_file, "relay": introduction, "peer_timeout": timeout}
    options["one_record"] = lifeline is not None and timeout is None
    if not run_nodes(nodes, executor=executor, throughput=throughput, **options):
        sys.exit(ExitCode.INCOMPLETE)


def _make(directory: Path | None) -> Path | None:
    from msg_analysis.errors import InputError

    if directory is not None:
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--checkpoint: {directory}: cannot be made ({error.strerror}): choose another") from error
    return directory


LONGEST_RECORD = 512 << 20  # bytes; those of large networks in discrete time hold the matrices of their steps


_read_ahead: dict[Path, RunRecord] = {}  # in a fork server, and in what it has forked


def load_record(path: Path) -> RunRecord:
    """Read a run record from ``msg-agents prepare``; InputError if it cannot be read or is not one."""
    from msg_analysis.model.run_record import RunRecord

    return _read_ahead.get(path) or RunRecord.from_json(_text_of(path), str(path))


def read_record_ahead(path: Path) -> None:
    """Read a run record, and prepare its model, for the processes that this one forks: they need not do it again."""
    from msg_analysis.errors import InputError
    from msg_analysis.model.run_record import RunRecord

    if path in _read_ahead:
        return
    with suppress(InputError):  # the nodes will say it
        text = _text_of(path)
        if '"protocol": {' not in text:  # whose code its user wrote: it is imported in the processes of the nodes only
            record = RunRecord.from_json(text, str(path))
            _ = record.model  # kept in the record
            _read_ahead[path] = record


def _text_of(path: Path) -> str:
    from msg_analysis.common.files import read_text
    from msg_analysis.errors import InputError

    try:
        return read_text(path, LONGEST_RECORD)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}): expected a run record from msg-agents prepare") from error


def record_of(bag: Path | None, run_record: Path | None) -> RunRecord | None:
    """The run record of a bag or a file; None without either."""
    if bag is not None and run_record is not None:
        raise click.UsageError("--bag and --experiment: expected at most one of them")
    if run_record is not None:
        from msg_analysis.errors import InputError

        try:
            return load_record(run_record)
        except InputError as error:
            raise InputError(f"--experiment: {error}: expected a run record, such as log/run.json of a run") from error
    if bag is not None:
        from msg_analysis.bags.reading import read_record

        return read_record(bag)
    return None
