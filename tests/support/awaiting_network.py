"""Networks whose agents and switcher wait for another node before their first step."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from msg_agents.environment import node_environment
from msg_agents.process_layout import ProcessSpec, lay_out_network
from msg_agents.run.fork_server import ForkServer
from msg_agents.run.supervisor import Supervisor
from msg_analysis.model.run_record import RunRecord

BAG = "bag"  # what is recorded, in the directory of the network


@contextmanager
def network_awaiting(node: str, record: RunRecord, directory: Path, domain: int) -> Iterator[Supervisor]:
    """The processes of a run, which are ended at the end of the context."""
    (directory / "run.json").write_text(record.to_json(with_key=True))
    environment = node_environment(domain)
    with (
        ForkServer(environment, directory / "fork_server.log") as server,
        Supervisor(directory, environment, fork_server=server) as nodes,
    ):
        recorder, *others = lay_out_network(record.experiment, directory / "run.json", directory / BAG)
        nodes.start([recorder, *(_awaiting(node, spec) for spec in others)])
        yield nodes


def _awaiting(node: str, spec: ProcessSpec) -> ProcessSpec:
    return dataclasses.replace(spec, arguments=(*spec.arguments, "--await", node))


def failures_of(nodes: Supervisor) -> list[tuple[str, str | None, str]]:
    """Processes that have failed: name, how, and the last line that they printed."""
    return [(child.spec.name, child.failure, child.last_line()) for child in nodes.failures]
