"""What an installation gives to the user's shell and to ``ros2``, and what Ctrl-C does before a command has begun."""

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import setuptools

SETUP = Path(__file__).parents[2] / "msg_agents" / "setup.py"
NODES = {"agent", "external", "live", "markers", "player", "recorder", "switcher"}


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
    assert (("bin", ["bin/msg-agents"]) in given["data_files"]) == bool(nodes)  # where pip has put another one


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


def parsed(*words: str) -> str:
    """Program that parses words as ``ros2`` does, with a parser of each verb below its own, and calls the verb."""
    return f"""
from argparse import ArgumentParser
from msg_agents.cli.entry_points import Verb
parser = ArgumentParser(prog="ros2")
verb = Verb()
verb.add_arguments(parser.add_subparsers(dest="verb").add_parser("msg-agents"), "ros2 msg-agents")
verb.main(parser=parser, args=parser.parse_args(["msg-agents", *{words!r}]))
"""


def test_verb_hands_all_arguments_to_the_executable(tmp_path: Path) -> None:
    """Whose Python may be another: options and ``--`` too, to the first one in AMENT_PREFIX_PATH that there is."""
    for name in ("one", "two"):
        executable = tmp_path / name / "lib/msg_agents/msg-agents"
        executable.parent.mkdir(parents=True)
        executable.write_text(f'#!/bin/sh\nprintf "%s|" {name} "$@"\nexit 3\n')
        executable.chmod(0o755)
    words = ("--help", "-h", "run", "a b.yaml", "--json", "--ros-args", "-r", "__ns:=/lab", "--", "--out=x")
    environment = os.environ | {"AMENT_PREFIX_PATH": f"{tmp_path}/none:{tmp_path}/one:{tmp_path}/two"}
    code = [sys.executable, "-P", "-c", parsed(*words)]
    process = subprocess.run(code, capture_output=True, text=True, timeout=60, env=environment)
    assert (process.returncode, process.stderr) == (3, "")
    assert process.stdout == "|".join(["one", *words, ""])


def test_verb_without_an_executable(tmp_path: Path) -> None:
    """As with wheels: the module, in this Python."""
    code = [sys.executable, "-P", "-c", parsed("prepare", str(tmp_path / "missing.yaml"))]
    environment = os.environ | {"AMENT_PREFIX_PATH": str(tmp_path)}
    process = subprocess.run(code, capture_output=True, text=True, timeout=60, env=environment)
    assert (process.returncode, process.stdout) == (2, "")
    assert "missing.yaml" in process.stderr


@pytest.mark.skipif(not shutil.which("ros2"), reason="this machine: no ros2 command")
def test_verb_of_ros2(tmp_path: Path) -> None:
    """The real one: it lists the verb, whose help, output and exit code are those of the command line."""
    ros2 = [str(shutil.which("ros2"))]
    listed = subprocess.run([*ros2, "--help"], capture_output=True, text=True, timeout=60)
    assert "Networks of agents: the command line msg-agents" in listed.stdout
    helped = subprocess.run([*ros2, "msg-agents", "--help"], capture_output=True, text=True, timeout=60)
    assert "Usage: msg-agents" in helped.stdout
    wrong = subprocess.run([*ros2, "msg-agents", "run", tmp_path / "no"], capture_output=True, text=True, timeout=60)
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert f"{tmp_path}/no" in wrong.stderr
