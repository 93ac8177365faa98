"""The house rules: no ROS below, and rooms that import only earlier rooms."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import msg_agents
import msg_analysis

ANALYSIS = Path(msg_analysis.__file__).parent
AGENTS = Path(msg_agents.__file__).parent
ROOMS = ["base", "model", "theory", "twin", "bags", "inference", "sweep", "report", "cli"]
BASE = {"__init__", "errors", "types", "console", "files"}  # what every room may use
ROS = ("rclpy", "msg_agents", "rosidl", "ament", "launch")


def modules() -> dict[str, Path]:
    return {
        ".".join(("msg_analysis", *file.relative_to(ANALYSIS).with_suffix("").parts)): file
        for file in sorted(ANALYSIS.rglob("*.py"))
    }


MODULES = modules()


def is_ros(name: str) -> bool:
    top = name.split(".")[0]
    return top.startswith(ROS) or top.endswith(("_msgs", "_interfaces"))


def imported(file: Path) -> Iterator[str]:
    """Absolute names of everything that a module imports, at the top, in functions, or for type checkers only."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: a relative import"
            assert node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room(name: str) -> str:
    parts = name.split(".")[1:] or ["__init__"]
    if "twin" in parts[:2]:  # the twin needs the theory for its start
        return "twin"
    top = parts[0].partition("_")[0]  # cli_theory is part of the command line
    if top == "protocol":  # the public half of model.protocols
        return "model"
    return top if top in ROOMS else "base"


def test_there_is_something_to_look_at() -> None:
    assert len(MODULES) > 30
    assert {room(name) for name in MODULES} == set(ROOMS)


@pytest.mark.parametrize("name", MODULES)
def test_no_ros(name: str) -> None:
    assert not [other for other in imported(MODULES[name]) if is_ros(other)]


@pytest.mark.parametrize("name", MODULES)
def test_rooms_import_only_earlier_rooms(name: str) -> None:
    order = {kind: number for number, kind in enumerate(ROOMS)}
    later = [
        other
        for other in imported(MODULES[name])
        if other.split(".")[0] == "msg_analysis"
        and other != "msg_analysis.__version__"
        and order[room(other)] > order[room(name)]
    ]
    assert not later


def test_importing_everything_brings_no_ros() -> None:
    """Also where a dependency would bring it."""
    code = (
        "import importlib, json, sys\n"
        f"for name in {[name.removesuffix('.__init__') for name in MODULES]!r}:\n"
        "    importlib.import_module(name)\n"
        "print(json.dumps(sorted(sys.modules)))"
    )
    process = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60)
    assert process.returncode == 0, process.stderr
    loaded = json.loads(process.stdout)
    assert "msg_analysis.bags.reader" in loaded
    assert not [name for name in loaded if is_ros(name)]


def test_help_needs_no_ros() -> None:
    code = "import sys\nfrom msg_agents.cli import main\nmain(['--help'], standalone_mode=False)\n"
    code += "print([name for name in ('rclpy', 'numpy', 'scipy', 'matplotlib', 'rich') if name in sys.modules])"
    process = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60)
    assert process.stdout.splitlines()[-1] == "[]", process.stderr


@pytest.mark.parametrize("file", ["synchronizer.py", "network.py", "domain.py", "supervisor.py", "check.py"])
def test_what_needs_no_ros_does_without(file: str) -> None:
    """These can be tested, and the plan be printed, on a machine without ROS."""
    needed = {name.split(".")[0] for name in imported(AGENTS / file)}
    assert "rclpy" not in needed
    assert "msg_agents_interfaces" not in needed


def test_processes_of_a_run_import_little() -> None:
    """With these a network would take twice as long to start: every agent is a process that imports all it needs."""
    code = (
        "import sys\n"
        "import msg_agents.agent, msg_agents.group, msg_agents.process, msg_agents.recorder, msg_agents.switcher\n"
        "from msg_analysis.model.experiment import Experiment\n"
        "from msg_analysis.model.step import build_model\n"
        "document = {'name': 'two', 'graphs': {'pair': {'path': [1, 2]}, 'grid': {'grid': [1, 2]}},\n"
        "            'switching': {'generator': [[-1, 1], [1, -1]]}}\n"
        "build_model(Experiment.parse(document))\n"
        "print([name for name in ('scipy', 'networkx', 'matplotlib', 'rich', 'rosbags') if name in sys.modules])"
    )
    process = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60)
    assert process.stdout.splitlines()[-1:] == ["[]"], process.stdout + process.stderr
