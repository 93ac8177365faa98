"""Options of the nodes as ROS parameters: in processes of their own, as `ros2 run` starts them."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import many_commands
import pytest
import yaml
from networks import record_of_two

pytest.importorskip("rclpy")


from msg_agents.cli.main import main
from msg_agents.cli.ros_command import RosCommand, split_arguments
from msg_agents.discovery.rtps import free_domain
from msg_agents.nodes.parameters import describe, name_of, options_of

NODES = {name: command for name, command in main.commands.items() if isinstance(command, RosCommand)}


@pytest.fixture
def run_file(tmp_path: Path) -> Path:
    return record_of_two(tmp_path)


def start(executable: str, *arguments: Any) -> subprocess.CompletedProcess[str]:
    words = [executable, *(str(argument) for argument in arguments)]
    with free_domain() as domain:
        environment = {"NO_COLOR": "1", "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        ((code, stdout, stderr),) = many_commands.outcomes([("msg-agents", words, "pipe")], Path.cwd(), **environment)
    return subprocess.CompletedProcess(words, code, stdout, stderr)


def test_split_arguments() -> None:
    assert split_arguments(["run.json", "--agent", "1"]) == (["run.json", "--agent", "1"], [])
    words = ["a", "--ros-args", "-r", "x:=y", "--", "b", "--ros-args", "-p", "c:=1"]
    assert split_arguments(words) == (["a", "b"], ["--ros-args", "-r", "x:=y", "--", "--ros-args", "-p", "c:=1"])


@pytest.mark.parametrize("name", NODES)
def test_every_option_is_a_parameter(name: str) -> None:
    """With a name that ROS 2 takes, a type, a description; read-only."""
    options = options_of(NODES[name])
    assert options
    for option in options:
        descriptor = describe(option)
        assert descriptor.name == name_of(option)
        assert descriptor.name.isidentifier() or descriptor.name == "await"
        assert descriptor.type > 0
        assert descriptor.read_only
        assert descriptor.description
        assert not descriptor.description.endswith("None")


@pytest.mark.parametrize("name", NODES)
def test_every_parameter_is_documented(name: str) -> None:
    text = (Path(__file__).parents[3] / "docs/ros.md").read_text(encoding="utf-8")
    assert [name_of(option) for option in options_of(NODES[name]) if f"`{name_of(option)}`" not in text] == []


def test_parameters_are_found_by_the_name_of_the_executable() -> None:
    names = {"agent", "switcher", "recorder", "player", "live", "markers", "external"}
    assert {command.node_name for command in NODES.values()} == names


def test_ranges_are_those_of_the_options() -> None:
    (split,) = [option for option in options_of(NODES["recorder"]) if option.name == "split_size"]
    (bounds,) = describe(split).floating_point_range
    assert (bounds.from_value, bounds.step) == (split.type.min, 0.0)


@pytest.mark.parametrize(
    ("executable", "parameters", "words"),
    [
        ("agent", ["agnets:=[1]"], ["parameter agnets", "did you mean agents?"]),
        ("agent", ["agents:=1"], ["parameter agents: 1 is of type integer: expected integer_array"]),
        ("agent", ["agents:=[1, 3]"], ["--agent: 3: expected a number from 1 to 2"]),
        ("agent", ["agents:=[]"], ["empty list"]),
        ("agent", ["agents:=[1]", "discovery_timeout:=3"], ["discovery_timeout: 3", "expected double, such as 3.0"]),
        ("agent", [], ["Missing option '--agent'", "parameter 'agents'"]),
        ("agent", ["agents:=[1"], ["--ros-args: Couldn't parse parameter override rule"]),
        ("recorder", ["out:=bag", "compression:=zip"], ["parameter compression: 'zip' is not one of 'none'"]),
        ("recorder", ["out:=bag", "split_size:=0.01"], ["parameter split_size: 0.01 is not in the range"]),
        ("recorder", ["out:=bag", "qos_overrides./graph.subscription.history:=keep_last"], ["history: keep_last"]),
    ],
    ids=["name", "type", "value", "empty", "double", "missing", "syntax", "choice", "range", "qos"],
)
def test_wrong_parameters(
    run_file: Path, executable: str, parameters: list[str], words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 2 and the reason, no traceback, and nothing written."""
    monkeypatch.chdir(run_file.parent)
    given = [word for parameter in (f"run:={run_file}", *parameters) for word in ("-p", parameter)]
    process = start(executable, "--ros-args", *given)
    assert process.returncode == 2, process.stderr
    assert process.stdout == ""
    assert "Traceback" not in process.stderr
    for word in words:
        assert word in process.stderr
    assert list(run_file.parent.iterdir()) == [run_file]


def test_the_command_line_wins_over_a_file_for_all_nodes(run_file: Path, tmp_path: Path) -> None:
    """A file may hold what other nodes need. The agent of the command line is the one that waits for its peer."""
    file = tmp_path / "nodes.yaml"
    sections = {
        "/**": {"ros__parameters": {"run": str(run_file), "out": "nowhere", "discovery_timeout": 30.0}},
        "/**/agent": {"ros__parameters": {"agents": [1], "discovery_timeout": 1.0}},
    }
    file.write_text(yaml.safe_dump(sections))
    by_file = start("agent", "--ros-args", "--params-file", file)
    assert "after 1 s agent_1 did not discover: agent_2" in by_file.stderr
    by_command = start("agent", "--agent", "2", "--ros-args", "--params-file", file)
    assert "after 1 s agent_2 did not discover: agent_1" in by_command.stderr
    assert (by_file.returncode, by_command.returncode) == (2, 2)


def test_nodes_keep_their_names(run_file: Path, tmp_path: Path) -> None:
    process = start("recorder", run_file, "--out", tmp_path / "bag", "--ros-args", "-r", "__node:=other")
    assert process.returncode == 2
    assert "the nodes of a run find each other by name" in process.stderr
    assert not (tmp_path / "bag").exists()


QOS = """
import sys
import rclpy
from msg_agents.nodes.parameters import PROCESS
from msg_agents.nodes.ros import ros_profile
from msg_agents.nodes.ros import LeanNode
from msg_analysis.errors import InputError
from msg_analysis.messages import topics
from std_msgs.msg import String
rclpy.init(args=sys.argv)
PROCESS.qos_overrides = True
node = LeanNode("one")
STREAM = ros_profile(topics.STREAM)
for name, profile in (("state", STREAM), ("graph", ros_profile(topics.LATCHED)), ("free", 10)):
    for create in (
        lambda: node.create_publisher(String, name, profile),
        lambda: node.create_subscription(String, name, print, profile),
    ):
        try:
            made = create()
        except InputError as error:
            print("refused", error)
        else:
            qos = made.qos_profile if hasattr(made, "qos_profile") else profile
            print(name, type(made).__name__, qos.history.name, qos.depth, qos.reliability.name, qos.durability.name)
print("unchanged", STREAM.durability.name)
"""


def test_quality_of_service() -> None:
    """Stronger: taken. Weaker where something would be lost: refused. Elsewhere: as the user likes."""
    overrides = {
        "/state.publisher.durability": "transient_local",
        "/state.subscription.reliability": "best_effort",
        "/graph.publisher.durability": "volatile",
        "/graph.publisher.lifespan": "5",
        "/free.publisher.depth": "3",
        "/free.subscription.reliability": "best_effort",
    }
    words = [part for name, value in overrides.items() for part in ("-p", f"qos_overrides.{name}:={value}")]
    with free_domain() as domain:
        process = subprocess.run(
            [sys.executable, "-P", "-c", QOS, "--ros-args", *words],
            env=os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
            capture_output=True,
            text=True,
            timeout=60,
        )
    assert process.returncode == 0, process.stderr
    state, heard, graph, graph_heard, free, free_heard, stream = process.stdout.splitlines()
    assert state.split() == ["state", "Publisher", "KEEP_ALL", "0", "RELIABLE", "TRANSIENT_LOCAL"]
    assert heard.startswith("refused parameter qos_overrides./state.subscription: reliability: best_effort")
    assert graph.startswith("refused parameter qos_overrides./graph.publisher: durability: volatile")
    assert graph_heard.split()[:2] == ["graph", "Subscription"]
    assert free.split()[2:5] == ["KEEP_LAST", "3", "RELIABLE"]
    assert free_heard.split()[4] == "BEST_EFFORT"
    assert stream == "unchanged VOLATILE"
