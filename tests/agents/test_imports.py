"""What importing a module brings with it, in an interpreter of its own. Who may import whom: tests/test_layers.py."""

import functools
import json
import subprocess
import sys
from pathlib import Path

import pytest

import msg_agents
import msg_analysis

ANALYSIS = Path(msg_analysis.__file__).parent
AGENTS = Path(msg_agents.__file__).parent
WITH_ROS = "nodes"
ROS = ("rclpy", "rosidl", "ament", "launch")


def modules(package: str, place: Path, folder: str = ".") -> list[str]:
    files = [file for file in sorted((place / folder).rglob("*.py")) if file.stem != "__main__"]
    return [
        ".".join((package, *file.relative_to(place).with_suffix("").parts)).removesuffix(".__init__") for file in files
    ]


def loaded_in_turn(lists: list[list[str]]) -> list[set[str]]:
    """Of each list, every module that importing it loads, whoever imports it, and that was not there before."""
    code = (
        "import importlib, json, sys\n"
        "found, known = [], set()\n"
        f"for names in {lists!r}:\n"
        "    for name in names:\n"
        "        importlib.import_module(name)\n"
        "    found.append(sorted(set(sys.modules) - known))\n"
        "    known.update(sys.modules)\n"
        "print(json.dumps(found))"
    )
    process = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60)
    assert process.returncode == 0, process.stderr
    return [set(names) for names in json.loads(process.stdout)]


@functools.cache
def loaded_without_ros() -> dict[str, set[str]]:
    """What msg_analysis loads, and what the folders without ROS load after it and after those before them."""
    lists = {"msg_analysis": modules("msg_analysis", ANALYSIS)}
    lists |= {folder: modules("msg_agents", AGENTS, folder) for folder in folders_without_ros()}
    return dict(zip(lists, loaded_in_turn(list(lists.values())), strict=True))


def is_ros(name: str) -> bool:
    top = name.split(".")[0]
    return top.startswith(ROS) or top.endswith(("_msgs", "_interfaces"))


def folders_without_ros() -> list[str]:
    return sorted(file.parent.name for file in AGENTS.glob("*/__init__.py") if file.parent.name != WITH_ROS)


def test_msg_analysis_brings_neither_ros_nor_msg_agents() -> None:
    """Also where a dependency would bring it."""
    names = modules("msg_analysis", ANALYSIS)
    assert len(names) > 100
    loaded = loaded_without_ros()["msg_analysis"]
    assert set(names) <= loaded
    assert not [name for name in loaded if is_ros(name) or name.startswith("msg_agents")]


@pytest.mark.parametrize("folder", folders_without_ros())
def test_what_needs_no_ros_does_without(folder: str) -> None:
    """These can be tested, the plan printed and a command line parsed on a machine without ROS."""
    names = modules("msg_agents", AGENTS, folder)
    assert names
    everything = loaded_without_ros()
    assert set(names) <= set().union(*everything.values())
    assert not [name for name in everything[folder] if is_ros(name)]


def test_the_folders_without_ros() -> None:
    assert set(folders_without_ros()) == {"stepping", "discovery", "channel", "watch", "run", "doctor", "cli"}


def test_the_verb_of_ros2_imports_no_other_package() -> None:
    """ros2 loads it with all its verbs, perhaps by a Python that has none of ours."""
    (loaded,) = loaded_in_turn([["msg_agents.cli.entry_points"]])
    assert "msg_agents" in loaded
    assert not {name for name in loaded if name.partition(".")[0] in ("msg_analysis", "numpy", "rclpy")}


PARSING = """
import sys
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.step_model import build_model
document = {'name': 'two', 'graphs': {'pair': {'path': [1, 2]}, 'grid': {'grid': [1, 2]}},
            'switching': {'generator': [[-1, 1], [1, -1]]}}
build_model(Experiment.parse(document))
print([name for name in ("scipy", "networkx", "matplotlib", "rich", "rosbags") if name in sys.modules])"""


def test_an_experiment_is_parsed_with_few_imports() -> None:
    """What --help imports: tests/commands/test_help.py."""
    process = subprocess.run([sys.executable, "-P", "-c", PARSING], capture_output=True, text=True, timeout=60)
    assert process.stdout.splitlines()[-1:] == ["[]"], process.stdout + process.stderr


def test_processes_of_a_run_import_little() -> None:
    """With these a network would take twice as long to start: every agent is a process that imports all it needs."""
    # What they import when they run: tests/integration/test_lockstep.py.
    pytest.importorskip("rclpy")
    nodes = [f"msg_agents.nodes.{name}" for name in ("agent_group", "recorder", "switcher", "process")]
    (loaded,) = loaded_in_turn([[*nodes, "msg_analysis.model.step_model"]])
    assert {"rclpy", "msg_agents.nodes.base", "msg_analysis.messages.messages"} <= loaded
    assert {name.split(".")[0] for name in loaded}.isdisjoint({"scipy", "networkx", "matplotlib", "rich", "rosbags"})
