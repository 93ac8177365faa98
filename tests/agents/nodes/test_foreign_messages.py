"""Every node of a network, given damaged messages on every topic that it reads: it refuses them, and goes on."""

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import experiment

pytest.importorskip("rclpy")

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_agents.nodes.agent_group import AgentGroup
from msg_agents.nodes.base import CLOCK_BOUND, NetworkNode, PeerPresence
from msg_agents.nodes.recorder import Recorder
from msg_agents.nodes.switcher import SWITCHERS, RealtimeSwitcher
from msg_analysis.messages import topics
from msg_analysis.messages.acceptance import graph_message, sign
from msg_analysis.messages.cdr import encode_batch
from msg_analysis.messages.messages import AgentState, Progress, encode_string
from msg_analysis.model.graph_path import HoldingPeriod
from msg_analysis.model.run_record import RunRecord
from msg_analysis.twin.simulate import new_record

pytestmark = pytest.mark.filterwarnings("ignore:module .sre_:DeprecationWarning")  # of a package that rclpy imports
DAMAGES = 100  # of a message on a topic
NONSENSE = [b"", b"\0", b"\0\1\0\0", b"\xff" * 200, bytes(range(40))]
BAD_NUMBERS = ["", "three", "nan", "inf", "-inf", "1e400", "9" * 5000, "\u0967,5", "1;2"]


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with free_domain() as domain:
        for name, value in node_environment(domain).items():
            monkeypatch.setenv(name, value)
        rclpy.init()
        yield
        rclpy.shutdown()


def health(name: str, bound: str, key: str = CLOCK_BOUND) -> bytes:
    status = DiagnosticStatus(name=f"{name}: network", values=[KeyValue(key=key, value=bound)])
    return bytes(serialize_message(DiagnosticArray(status=[status])))


def messages(record: RunRecord) -> dict[str, bytes]:
    """A good one for each topic; those that end a process are not signed, since a damage may change nothing."""
    state = AgentState(0, record.run.bytes, 1, 0, 0, np.zeros(record.experiment.run.replicas)).encode()
    good = {topic.name: state for topic in (topics.STATE, topics.TRUTH)}
    good |= {topic.name: encode_batch(record.run.bytes, [state]) for topic in (topics.STATES, topics.TRUTHS)}
    signed = topics.PROGRESS, topics.RESEND, topics.EPOCH, topics.STOP
    good |= {
        topic.name: sign(Progress(0, record.run.bytes, 0, 0), topic, record.key if topic in signed else None).encode()
        for topic in (*signed, topics.END, topics.LEAVE)
    }
    good[topics.GRAPH.name] = graph_message(record, HoldingPeriod(0, 0, 0, 5)).encode()
    good[topics.EXPERIMENT.name] = encode_string(record.to_json())
    good[topics.DIAGNOSTICS.name] = health("agent_1", "3.5")
    return good


def damaged(data: bytes, rng: random.Random) -> bytes:
    found = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(found)) if found else 0
        kind = rng.randrange(3)
        if kind == 0:
            found[place : place + 1] = bytes([rng.randrange(256)])
        elif kind == 1:
            found[place : place + 4] = b"\xff" * 4
        else:
            del found[place:]
    return bytes(found)


def nodes_of(record: RunRecord, directory: Path) -> list[NetworkNode]:
    model = record.model
    group = AgentGroup(record=record, model=model, agents=[0, 1], readers=["recorder"])
    switcher = SWITCHERS[record.experiment.run.pace](
        record=record, model=model, readers=["recorder"], on_clocks=lambda *_: None
    )
    return [*group.nodes, switcher, Recorder(record=record, directory=directory / "bag")]


@pytest.mark.usefixtures("ros")
@pytest.mark.parametrize("pace", ["lockstep", "realtime"])
def test_damaged_messages(tmp_path: Path, pace: str) -> None:
    """Damaged copies of what a topic carries, and bytes that are nothing; the seed is fixed."""
    record = new_record(experiment(3, run={"pace": pace, "duration": 10, "replicas": 2}, noise={"broadcast": 0.1}))
    rng, good, read = random.Random(1), messages(record), set()
    nodes = nodes_of(record, tmp_path)
    presence = PeerPresence(nodes, 30.0)
    for node in nodes:
        for subscription in list(node.subscriptions):
            name = subscription.topic_name.removeprefix(node.get_namespace())
            data = good.get(name) or good.get(f"/{name}") or good[topics.STATE.name]
            read.add(subscription.topic_name)
            for damage in [damaged(data, rng) for _ in range(DAMAGES)] + NONSENSE:
                subscription.callback(damage)
        assert not node.done.done()
    for node in nodes:
        node.finish(complete=False, deadline=0.0)
    for node in nodes:
        node.destroy_node()
    del presence
    assert {"/graph", "/resend", "/progress", "/experiment", "/end", "/leave", "/states", "/agent_3/state"} <= read
    assert ("/diagnostics" in read) == (pace == "realtime")


@pytest.mark.usefixtures("ros")
@pytest.mark.parametrize("text", BAD_NUMBERS)
def test_diagnostics_that_are_not_of_this_run(text: str) -> None:
    """Any program may publish there, under any name; what is no number of an agent is counted."""
    record = new_record(experiment(3, run={"pace": "realtime"}))
    found: list[dict[str, Any]] = []
    switcher = RealtimeSwitcher(
        record=record, model=record.model, readers=[], on_clocks=lambda offsets, _: found.append(offsets.to_json())
    )
    (reads,) = [each for each in switcher.subscriptions if each.topic_name == topics.DIAGNOSTICS.name]
    for name in ("lidar", "agent_1", "switcher"):
        reads.callback(health(name, text))
    assert switcher.refused == {(topics.DIAGNOSTICS.name, "not finite"): 1}
    assert found[-1] == []
    reads.callback(health("agent_1", "2.5"))
    assert [entry["node"] for entry in found[-1]] == ["agent_1"]
    switcher.destroy_node()


@pytest.mark.usefixtures("ros")
def test_clock_before_zero() -> None:
    """rclpy itself reads the topic, and raises ValueError."""
    record = new_record(experiment(3, run={"pace": "realtime"}))
    switcher = RealtimeSwitcher(record=record, model=record.model, readers=[])
    switcher.set_parameters([Parameter("use_sim_time", value=True)])
    (reads,) = [each for each in switcher.subscriptions if each.topic_name == topics.CLOCK.name]
    reads.callback(Clock(clock=Time(sec=7)))
    for sec in (-1, -(2**31)):
        reads.callback(Clock(clock=Time(sec=sec)))
    assert switcher.get_clock().now().nanoseconds == 7 * 10**9
    assert switcher.refused == {(topics.CLOCK.name, "negative time"): 2}
    switcher.destroy_node()
