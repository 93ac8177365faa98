"""What launch files do, without ``launch``; and the launch files as far as they can be looked at without it."""

from __future__ import annotations

import ast
import signal
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from msg_agents.processes.process_plan import plan_network
from msg_agents.running.launch_support import (
    NETWORK_ARGUMENTS,
    REPLAY_ARGUMENTS,
    LaunchedNetwork,
    LaunchFailedError,
    find_experiment,
    replay_commands,
)
from msg_agents.running.run_folder import PREFIX
from msg_analysis.errors import InputError
from msg_analysis.model.run.record import RunRecord

BRINGUP = Path(__file__).parents[3] / "ros_ws/src/msg_agents_bringup"
LAUNCH_FILES = sorted((BRINGUP / "launch").glob("*.launch.py"))
DEFAULTS = {name: default for name, (default, _) in NETWORK_ARGUMENTS.items()}
# What the launch files use of launch and launch_ros of Jazzy, with the arguments that these take by name.
API = {
    "ament_index_python.packages": {"get_package_share_directory": set()},
    "launch": {"LaunchDescription": set()},
    "launch.actions": {
        "DeclareLaunchArgument": {"default_value", "description", "choices"},
        "EmitEvent": {"event"},
        "ExecuteProcess": {"cmd", "output", "additional_env"},
        "LogInfo": {"msg"},
        "OpaqueFunction": {"function", "args", "kwargs"},
        "RegisterEventHandler": set(),
    },
    "launch.event_handlers": {"OnProcessExit": {"target_action", "on_exit"}, "OnShutdown": {"on_shutdown"}},
    "launch.events": {"Shutdown": {"reason", "due_to_sigint"}},
    "launch.substitutions": {"LaunchConfiguration": {"default"}},
    "launch_ros.actions": {
        "Node": {
            *("package", "executable", "name", "namespace", "exec_name", "parameters", "remappings"),
            *("ros_arguments", "arguments", "output", "additional_env"),
        }
    },
    "launch_ros.substitutions": {"ExecutableInPackage": {"executable", "package"}},
}


def launched(out: Path, **changes: str) -> LaunchedNetwork:
    return LaunchedNetwork(DEFAULTS | {"out": str(out), "duration": "1"} | changes, BRINGUP)


def workshops(network: LaunchedNetwork) -> Path:
    (folder,) = {
        Path(word).parent for plan in network.processes for word in plan.arguments if word.endswith("run.json")
    }
    assert folder.name.startswith(PREFIX)
    return folder


def test_the_plan_is_that_of_the_runner(tmp_path: Path) -> None:
    network = launched(tmp_path, processes="2", seed="5", namespace="/lab")
    try:
        run_file = workshops(network) / "run.json"
        record = RunRecord.from_json(run_file.read_text(), str(run_file))
        assert (record.experiment.run.seed, record.experiment.run.duration) == (5, 1.0)
        assert network.bag is not None
        assert network.processes == plan_network(record.experiment, run_file, network.bag)
        assert [plan.name for plan in network.processes] == ["recorder", "agents_1_to_2", "agents_3_to_5", "switcher"]
        assert network.namespace == "/lab"
    finally:
        network.close()


def test_complete(tmp_path: Path) -> None:
    """Only the last process to end completes the run; one that ended itself by an alarm has done its part."""
    network = launched(tmp_path, processes="1")
    folder = workshops(network)
    assert not network.ended("agents_1_to_5", 0)
    assert not network.ended("switcher", -signal.SIGALRM)
    assert network.ended("recorder", 0)
    assert network.analysis == ["compare", str(network.bag), "--report", f"{network.bag}/report.html"]
    network.analysed(0)
    network.close()
    network.close()
    assert not folder.exists()
    assert list(tmp_path.iterdir()) == []  # nothing came of it: no bag directory is left


@pytest.mark.parametrize(("code", "words"), [(2, "exit code 2"), (-signal.SIGKILL, "killed by SIGKILL")])
def test_failed(tmp_path: Path, code: int, words: str) -> None:
    """Said once: the others end because of it."""
    network = launched(tmp_path, processes="1")
    try:
        with pytest.raises(LaunchFailedError, match=f"agents_1_to_5: {words}: the run is not complete"):
            network.ended("agents_1_to_5", code)
        assert not network.ended("switcher", 3)
        assert not network.ended("recorder", 0)
    finally:
        network.close()


@pytest.mark.parametrize(("code", "words"), [(1, "disagrees"), (3, "incomplete"), (2, "exit code 2")])
def test_verdict(tmp_path: Path, code: int, words: str) -> None:
    network = launched(tmp_path)
    network.close()
    with pytest.raises(LaunchFailedError, match=words):
        network.analysed(code)


def test_nothing_to_analyse(tmp_path: Path) -> None:
    for changes in ({"analyse": "false"}, {"record": "false"}):
        network = launched(tmp_path, **changes)
        network.close()
        assert network.analysis is None
        assert ("recorder" in {plan.name for plan in network.processes}) == ("record" not in changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"experiment": "lin_ring"}, "experiment: lin_ring: expected a file, or one of discrete, .*line_ring"),
        ({"experiment": "nowhere.yaml"}, "nowhere.yaml"),
        ({"record": "perhaps"}, "record: perhaps: expected true or false"),
        ({"seed": "1.5"}, "seed: 1.5: expected a whole number"),
        ({"duration": "long"}, "duration: long: expected a number"),
        ({"pace": "slow"}, 'run.pace: "slow"'),
        ({"processes": "0"}, "run.processes"),
        ({"pace": "realtime", "experiment": "nowhere.yaml"}, "nowhere"),
    ],
)
def test_wrong_arguments(tmp_path: Path, changes: dict[str, str], words: str) -> None:
    """Before anything is made."""
    with pytest.raises((InputError, OSError), match=words):
        launched(tmp_path / "runs", **changes)
    assert not (tmp_path / "runs").exists()


def test_examples_by_name() -> None:
    assert find_experiment("line_ring", BRINGUP) == BRINGUP / "experiments/line_ring.yaml"
    assert find_experiment(str(BRINGUP / "package.xml"), BRINGUP) == BRINGUP / "package.xml"


def test_replay(tmp_path: Path) -> None:
    defaults = {name: default for name, (default, _) in REPLAY_ARGUMENTS.items()}
    bag = str(tmp_path)
    assert replay_commands(defaults | {"bag": bag, "rate": "max"}) == [
        ("live", ["--reliable"]),
        ("player", [bag, "--rate", "max", "--await", "live"]),
    ]
    alone = replay_commands(defaults | {"bag": bag, "live": "false", "loop": "true", "clock": "50"})
    assert alone == [("player", [bag, "--rate", "1", "--loop", "--clock", "50"])]
    for changes, words in (
        ({}, "bag: not given"),
        ({"bag": "/nowhere"}, "bag: /nowhere"),
        ({"bag": bag, "loop": "yes"}, "loop: true"),
    ):
        with pytest.raises(InputError, match=words):
            replay_commands(defaults | changes)


def test_arguments_are_documented() -> None:
    text = (BRINGUP.parents[2] / "docs/ros.md").read_text(encoding="utf-8")
    assert [name for name in {**NETWORK_ARGUMENTS, **REPLAY_ARGUMENTS} if f"`{name}`" not in text] == []


@pytest.mark.parametrize("file", LAUNCH_FILES, ids=lambda file: file.name)
def test_launch_files_use_what_there_is(file: Path) -> None:
    """Every name that they import from launch, and every argument that they give by name, is one that Jazzy has."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    names: dict[str, set[str]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in API:
            for alias in node.names:
                names[alias.name] = API[node.module][alias.name]
        elif isinstance(node, ast.ImportFrom):
            assert node.module in {"pathlib", "msg_agents.running.launch_support"}
    assert "Node" in names
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in names:
            assert {keyword.arg for keyword in call.keywords} <= names[call.func.id], ast.unparse(call)
    functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert {"generate_launch_description", "start"} <= functions
