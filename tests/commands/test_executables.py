"""What an installation puts into the user's PATH, and what Ctrl-C does before a command has begun."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import setuptools

SETUP = Path(__file__).parents[2] / "msg_agents" / "setup.py"
NODES = {"agent", "live", "markers", "player", "recorder", "switcher"}


@pytest.mark.parametrize(
    ("command", "nodes"), [("bdist_wheel", set()), ("editable_wheel", set()), ("dist_info", set()), ("install", NODES)]
)
def test_nodes_are_no_commands_of_the_user(command: str, nodes: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """pip builds a wheel, whose executables are in ``bin``; colcon installs them where `ros2 run` looks."""
    given: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, "setup", given.update)
    monkeypatch.setattr(sys, "argv", ["setup.py", command])
    monkeypatch.chdir(SETUP.parent)
    runpy.run_path(str(SETUP))
    assert {line.split(" = ")[0] for line in given["entry_points"]["console_scripts"]} == {"msg-agents"} | nodes


@pytest.mark.parametrize(
    "entry_point",
    [
        "from msg_agents.cli.entry_points import msg_agents as start",
        "from msg_analysis.cli.entry_point import msg_analysis as start",
    ],
)
def test_interrupted_while_the_program_is_loaded(entry_point: str) -> None:
    """Ctrl-C in the first quarter of a second: no traceback. The modules of the executables themselves load nothing."""
    code = f"""
import sys
class Interrupt:
    def find_spec(self, name, *others):
        if name in ("click", "importlib.metadata"):
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupt())
{entry_point}
sys.argv = ["program", "--help"]
start()
"""
    process = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60)
    assert (process.returncode, process.stdout, process.stderr) == (130, "", "")
