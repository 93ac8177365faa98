"""The nodes as ROS 2 users start them: parameters, namespaces, remapping, launch; a node that knows nothing of ours."""

import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader
from networks import run_file
from waiting import participants

from msg_agents.discovery.rtps import free_domain
from msg_agents.run.launch import ANALYSIS, NETWORK_ARGUMENTS, LaunchedNetwork, environment
from msg_analysis.bags.reading import read_bag
from msg_analysis.twin.check import check

ROOT = Path(__file__).parents[2]


@pytest.fixture
def domain(network: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Of all processes of the test, on this machine only; after ``network``, which clears the environment of ROS."""
    with free_domain() as number:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield number


def python(code: str, **options: Any) -> subprocess.Popen[str]:
    pipes = dict.fromkeys(("stdout", "stderr"), subprocess.PIPE)
    return subprocess.Popen([sys.executable, "-P", "-c", code], **pipes, text=True, **options)


def topics(bag: Path) -> Counter[str]:
    """Messages by topic, as mcap's own reader counts them."""
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        return Counter(channel.topic for _, channel, _ in make_reader(stream).iter_messages())


@pytest.mark.usefixtures("domain")
def test_parameters_namespace_and_remapping(network: Any) -> None:
    """One parameter file for all, in a namespace, one topic under another name: complete, and as the twin says."""
    # In the bag the topic has its own name. Another network of the same domain, in a namespace of its own, is not in
    # the way, though its nodes have the same names.
    nodes = []
    bags = {"/lab": network.directory / "lab", "/hall": network.directory / "hall"}
    for seed, (namespace, bag) in enumerate(bags.items()):
        record = run_file(network.directory, 5, run={"seed": seed})
        record = record.rename(record.with_stem(bag.name))
        file = network.directory / f"{bag.name}.yaml"
        sections = {
            "/**": {"run": str(record), "await": ["recorder"]},
            f"{namespace}/recorder": {"out": str(bag), "compression": "lz4", "parameter_services": True},
            f"{namespace}/agent_4": {
                f"qos_overrides.{namespace}/agent_4/state.publisher.durability": "transient_local"
            },
        }
        file.write_text(yaml.safe_dump({name: {"ros__parameters": section} for name, section in sections.items()}))
        ros = [
            "--ros-args",
            "--params-file",
            file,
            "-r",
            f"__ns:={namespace}",
            "-r",
            f"agent_1/state:=/other{namespace}/one",
        ]
        nodes.append(network.start("recorder", *ros))
        if namespace == "/lab":  # before the run can be over
            described = json.loads(network.ended(python(DESCRIBE))[0])
        nodes += [
            network.start("agent", *ros, "-p", "agents:=[1, 3]"),
            network.start("agent", "--agent", "2", "--agent", "4", "--agent", "5", *ros),
            network.start("switcher", *ros),
        ]
    for node in nodes:
        assert network.ended(node)[0] == ""
    assert described["out"] == {"type": 4, "read_only": True, "value": str(bags["/lab"])}
    assert described["compression"]["value"] == "lz4"
    for namespace, bag in bags.items():
        found = topics(bag)
        assert {name: found[name] for name in found if name.endswith("/state")} == {
            f"{namespace}/agent_{i}/state": 301 for i in range(1, 6)
        }
        assert found[f"{namespace}/experiment"] == 1
        trajectory = read_bag(bag)
        assert trajectory.completeness.complete
        assert check(trajectory).difference is None
        assert trajectory.completeness.refused == {}


DESCRIBE = """
import json, sys
import rclpy
from rclpy.parameter_client import AsyncParameterClient
rclpy.init(args=sys.argv)
node = rclpy.create_node("asking")
client = AsyncParameterClient(node, "/lab/recorder")
assert client.wait_for_services(timeout_sec=60)
names = ["out", "compression"]
def ask(request):  # again if there is no answer: a server does not wait until the reader of its answers is discovered
    for _ in range(10):
        future = request(names)
        rclpy.spin_until_future_complete(node, future, timeout_sec=5)
        if future.done():
            return future.result()
descriptors, values = ask(client.describe_parameters).descriptors, ask(client.get_parameters).values
print(json.dumps({
    d.name: {"type": d.type, "read_only": d.read_only, "value": v.string_value} for d, v in zip(descriptors, values)
}))
"""


@pytest.mark.usefixtures("domain")
def test_what_the_launch_files_do(network: Any) -> None:
    """The processes as launch_ros starts them, the ends as launch tells them, then the analysis."""
    arguments = {name: default for name, (default, _) in NETWORK_ARGUMENTS.items()} | {
        "experiment": str(network.file()),
        "out": str(network.directory / "runs"),
        "processes": "2",
        "namespace": "/lab",
    }
    launched = LaunchedNetwork(arguments)
    ros = ["--ros-args", "-r", "__ns:=/lab"]
    running = {spec.name: network.execute(*spec.arguments, *ros, **environment()) for spec in launched.processes}
    for name, process in running.items():
        assert not launched.over
        process.communicate(timeout=90)
        launched.ended(name, process.returncode)
    assert launched.over
    assert launched.bag
    comparison = launched.analysis()
    assert comparison
    analysis = network.start(*comparison, program="msg-analysis")
    stdout, stderr = analysis.communicate(timeout=90)
    launched.ended(ANALYSIS, analysis.returncode)
    assert (launched.reason is None) == (analysis.returncode == 0)
    assert analysis.returncode in (0, 1), stderr  # which, is a matter of the seed
    assert "mean-square error " in stdout
    launched.close()
    assert json.loads((launched.bag / "log/run.json").read_text())["experiment"]["name"] == "net"
    assert (launched.bag / "report.html").is_file()
    assert topics(launched.bag)["/lab/agent_5/state"] == 301
    assert check(read_bag(launched.bag)).difference is None


def watcher() -> str:
    """The node of docs/ros.md."""
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs/ros.md").read_text(encoding="utf-8"), re.M | re.S)
    (code,) = [block for block in blocks if "class Watcher" in block]
    assert "msg_agents." not in code
    assert "msg_analysis" not in code
    return code


@pytest.mark.timeout(150)
def test_a_node_of_your_own(network: Any, domain: int) -> None:
    """A plain rclpy node sees graphs and states of a running network, and ends with it."""
    watching = python(watcher(), cwd=network.directory)
    network.wait_for(lambda: participants(domain), 60, "the watcher has a node")  # later it would wait for ever
    # 3 s; the last graph is there for a second: the watcher ends with the run, whatever it has not read yet.
    schedule = [[0, "line"], [5, "ring"], [10, "line"]]
    file = network.file(switching={"schedule": schedule}, run={"pace": "realtime", "speed": 5, "processes": 2})
    result = network.completed(network.record(file, "--domain", str(domain), "--json"))
    assert result["rejected_messages"] == []
    printed, _ = network.ended(watching)
    graphs = re.findall(r"^steps (\d+) to (\d+): (line|ring), (\d+) arcs$", printed, re.M)
    assert (graphs[0][0], graphs[-1][1]) == ("0", "299")
    assert all(arcs == {"line": "8", "ring": "10"}[name] for _, _, name, arcs in graphs)
    states = re.findall(r"^agent (\d): (\d+) states$", printed, re.M)
    assert [agent for agent, _ in states] == list("12345")
    assert all(0 < int(count) <= 301 for _, count in states)
    assert (network.directory / "states.png").read_bytes()[:4] == b"\x89PNG"


def test_a_guest_gets_everything(network: Any, domain: int) -> None:
    """A reader that is no recorder of ours, named to the agents, gets every state, the last one too."""
    record = run_file(network.directory, 5)
    guest = python(GUEST)
    ros = ["--ros-args", "-p", f"run:={record}", "-p", "await:=[rosbag2_recorder]"]
    nodes = [network.start("switcher", *ros), network.start("agent", *ros, "-p", "agents:=[1, 2, 3, 4, 5]")]
    for node in nodes:
        network.ended(node)
    assert json.loads(network.ended(guest)[0]) == [[i, step] for i in range(1, 6) for step in range(301)]


GUEST = """
import json
import rclpy
from msg_agents_interfaces.msg import AgentState
from rclpy.qos import HistoryPolicy, QoSProfile
rclpy.init()
node = rclpy.create_node("rosbag2_recorder")
seen = set()
for i in range(1, 6):
    qos = QoSProfile(history=HistoryPolicy.KEEP_ALL)
    node.create_subscription(AgentState, f"agent_{i}/state", lambda m: seen.add((m.agent, m.step)), qos)
while not node.count_publishers("agent_1/state"):
    rclpy.spin_once(node, timeout_sec=0.2)
while len(seen) < 5 * 301 and node.count_publishers("agent_1/state"):
    rclpy.spin_once(node, timeout_sec=0.2)
quiet = 0  # what has arrived stays when its writer leaves, and each spin takes one message
while len(seen) < 5 * 301 and quiet < 20:
    before = len(seen)
    rclpy.spin_once(node, timeout_sec=0.05)
    quiet = 0 if len(seen) > before else quiet + 1
print(json.dumps(sorted(seen)))
"""
