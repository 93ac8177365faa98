"""Processes of nodes: who is present, and how a process that hangs ends."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from networks import record_of_two
from waiting import wait_for

pytest.importorskip("rclpy")

import rclpy
from rclpy.node import Node

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_agents.nodes.base import NetworkNode, PeerPresence, PeersLostError
from msg_agents.nodes.process import exit_after
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
    start("switcher", namespace)
    wait_for(lambda: "switcher" in agent.get_node_names())
    assert ("switcher" in agent.names_in_namespace()) == there
    PeerPresence([agent], timeout=0.0).begin()
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(agent)
    executor.spin_until_future_complete(agent.done, timeout_sec=3.0)
    executor.shutdown()
    assert agent.done.done() == (not there)
    with contextlib.nullcontext() if there else pytest.raises(PeersLostError, match="switcher left the network"):
        agent.done.result()


def test_a_peer_that_says_that_it_leaves_is_not_waited_for(
    start: Callable[..., Node], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Although its node is there, and with a timeout that outlasts the test. An agent needs only the switcher."""
    nodes = {name: start(name) for name in ("agent_1", "agent_2", "switcher")}
    monkeypatch.setattr(type(nodes["agent_2"]), "number", property(lambda node: 2 * (node.get_name() == "agent_2")))
    presences = {name: PeerPresence([node], timeout=1000.0) for name, node in nodes.items()}
    agent = nodes["agent_1"]
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
    start("guest", "/other")
    start("recorder", "/other")
    wait_for(lambda: {"guest", "recorder"} <= set(agent.get_node_names()))
    assert agent.undiscovered(["guest", "recorder", "agent_1", "agent_2"]) == ["recorder", "agent_2"]


HANGS = "ctypes.PyDLL(None).pause()"  # with the interpreter's lock held
BEGIN = f"import atexit, ctypes, sys, time; from {exit_after.__module__} import exit_after; print('done');"

linux = pytest.mark.skipif(sys.platform != "linux", reason="this machine: its C library has no such timers")


@linux
@pytest.mark.parametrize(
    ("code", "exit_code"),
    [
        (f"exit_after(1); {HANGS}", 0),
        (f"exit_after(1); atexit.register(lambda: {HANGS})", 0),
        ("exit_after(1); time.sleep(60); sys.exit(3)", 0),
        ("exit_after(60); sys.exit(3)", 3),
        (f"sys.stderr = None; exit_after(1); {HANGS}", 0),
    ],
    ids=["hangs with the lock held", "hangs while the interpreter ends", "works too long", "ends in time", "no stream"],
)
def test_exit_after(code: str, exit_code: int) -> None:
    """What was printed before is not lost."""
    result = subprocess.run([sys.executable, "-c", f"{BEGIN} {code}"], stdout=subprocess.PIPE, text=True, check=False)
    assert (result.returncode, result.stdout) == (exit_code, "done\n")


@linux
def test_nobody_reads_what_was_printed() -> None:
    """The pipe is broken when the buffer is written: the process ends as it would have."""
    code = f"{BEGIN} sys.stdin.read(); exit_after(1); {HANGS}"
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    buffered = os.environ | {"PYTHONUNBUFFERED": ""}
    with subprocess.Popen([sys.executable, "-c", code], env=buffered, **pipes) as process:
        process.stdout.close()
        process.stdin.close()
        assert (process.stderr.read(), process.wait()) == (b"", 0)
