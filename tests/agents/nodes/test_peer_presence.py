"""Which nodes count as present: those of the run, not those of another one in the same domain."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.node import Node
from waiting import record_of_two, wait_for

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_agents.nodes.base import NetworkNode, PeerPresence, PeersLostError
from msg_analysis.model.run_record import RunRecord

pytestmark = pytest.mark.filterwarnings("ignore:module .sre_:DeprecationWarning")  # of a package that rclpy imports


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Node]]:
    """Makes nodes in a domain of the test's own."""
    record = RunRecord.from_json(record_of_two(tmp_path).read_text(), "run.json")
    nodes: list[Node] = []

    def make(name: str, namespace: str | None = None) -> Node:
        nodes.append(NetworkNode(name, record=record) if namespace is None else Node(name, namespace=namespace))
        return nodes[-1]

    with free_domain() as domain:
        for name, value in node_environment(domain).items():
            monkeypatch.setenv(name, value)
        rclpy.init()
        yield make
        for node in nodes:
            node.destroy_node()
        rclpy.shutdown()


@pytest.mark.parametrize(("namespace", "there"), [("/", True), ("/other", False)])
def test_a_switcher_of_another_namespace_is_not_ours(start: Callable[..., Node], namespace: str, there: bool) -> None:
    agent = start("agent_1")
    assert isinstance(agent, NetworkNode)
    start("switcher", namespace)
    wait_for(lambda: "switcher" in agent.get_node_names())
    assert ("switcher" in agent.names_in_namespace()) == there
    PeerPresence([agent], patience=0.0).begin()
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(agent)
    executor.spin_until_future_complete(agent.done, timeout_sec=3.0)
    executor.shutdown()
    assert agent.done.done() == (not there)
    if not there:
        with pytest.raises(PeersLostError, match="switcher left the network"):
            agent.done.result()


def test_a_peer_that_says_that_it_leaves_is_not_waited_for(
    start: Callable[..., Node], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Although its node is there, and with a patience that outlasts the test. An agent needs only the switcher."""
    nodes = {name: start(name) for name in ("agent_1", "agent_2", "switcher")}
    monkeypatch.setattr(type(nodes["agent_2"]), "number", property(lambda node: 2 * (node.get_name() == "agent_2")))
    presences = {name: PeerPresence([node], patience=1000.0) for name, node in nodes.items()}
    agent = nodes["agent_1"]
    assert isinstance(agent, NetworkNode)
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(agent)
    for name in ("agent_2", "switcher"):
        wait_for(lambda: agent.count_publishers("/leave") == 3 and nodes["switcher"].count_subscribers("/leave") == 3)
        presences[name].leave()
        executor.spin_until_future_complete(agent.done, timeout_sec=3.0)
        assert agent.done.done() == (name == "switcher")
    executor.shutdown()
    with pytest.raises(PeersLostError, match=r"^switcher left the network before the end of the run: see"):
        agent.done.result()


def test_a_reader_of_the_user_may_be_in_any_namespace(start: Callable[..., Node]) -> None:
    """That of `ros2 bag record` is always in /; another run's nodes have the names of ours."""
    agent = start("agent_1")
    assert isinstance(agent, NetworkNode)
    start("guest", "/other")
    start("recorder", "/other")
    wait_for(lambda: {"guest", "recorder"} <= set(agent.get_node_names()))
    assert agent.undiscovered(["guest", "recorder", "agent_1", "agent_2"]) == ["recorder", "agent_2"]
