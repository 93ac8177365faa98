# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What is installed is what ROS 2 looks for. Run by ``colcon test`` in the workspace that has been built."""

from __future__ import annotations

import os
import subprocess
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix, get_package_share_directory

EXECUTABLES = ("msg-agents", "agent", "switcher", "recorder", "player", "live", "markers")
LIBEXEC = Path(get_package_prefix("msg_agents")) / "lib" / "msg_agents"


@pytest.mark.parametrize("name", EXECUTABLES)
def test_executable(name: str) -> None:
    """As ``ros2 run`` and ``ros2 launch`` find and start it."""
    file = LIBEXEC / name
    assert os.access(file, os.X_OK)
    process = subprocess.run([file, "--help"], capture_output=True, text=True, timeout=60)
    assert process.returncode == 0, process.stderr
    assert "Usage: msg-agents" in process.stdout or "Usage: " in process.stdout


def test_command_line_on_the_path() -> None:
    """In ``bin``, which ``setup.bash`` puts on the PATH; without the nodes, which are no commands of the user."""
    folder = LIBEXEC.parents[1] / "bin"
    process = subprocess.run([folder / "msg-agents", "--help"], capture_output=True, text=True, timeout=60)
    assert process.returncode == 0, process.stderr
    assert "Usage: msg-agents" in process.stdout
    assert not (folder / "agent").exists()


def test_verb() -> None:
    """All that ros2cli looks for to know ``ros2 msg-agents``."""
    (verb,) = entry_points(group="ros2cli.command", name="msg-agents")
    assert verb.value == "msg_agents.cli.entry_points:Verb"


def test_share() -> None:
    assert (Path(get_package_share_directory("msg_agents")) / "package.xml").is_file()


def test_a_node_is_an_ordinary_one(tmp_path: Path) -> None:
    """It takes what ``ros2 run`` hands on, and says what is wrong with it: exit code 2, no traceback."""
    command = [LIBEXEC / "agent", "--ros-args", "-r", "__ns:=/lab", "-p", f"run:={tmp_path}/no", "-p", "agents:=[1]"]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert process.returncode == 2
    assert "cannot be read" in process.stderr
    assert "Traceback" not in process.stderr
