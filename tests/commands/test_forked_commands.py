"""What has the commands of tests executed instead of forked: variables that are read at the start of a process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
import forked_commands

from msg_agents.discovery.profiles import INTRODUCED_PROFILE, LOOPBACK_PROFILE, PROFILE_VARIABLES
from msg_agents.processes.environment import node_environment
from msg_analysis.common.blas_threads import SINGLE_THREAD

LIBRARIES = (*forked_commands.PREPARED, "dask", "distributed", "matplotlib.pyplot", "mcap_ros2", "threadpoolctl")


def test_libraries_set_no_variable_that_is_read_at_a_start() -> None:
    """Else each command after their import would be executed, at several times the cost.

    What forks the commands has imported most of them, and would have ended if they did; the others are imported here.
    """
    code = f"""
import importlib, json, os
for name in {LIBRARIES}:
    importlib.import_module(name)
print(json.dumps(dict(os.environ)))
"""
    command = [sys.executable, "-P", "-c", code]
    with forked_commands.installed():
        process = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    after = json.loads(process.stdout.splitlines()[-1])
    assert forked_commands.read_at_start(after) == forked_commands.read_at_start(os.environ)


@pytest.mark.parametrize("profile", [INTRODUCED_PROFILE, LOOPBACK_PROFILE])
def test_nodes_have_no_other_such_variables(profile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PYTHONUNBUFFERED", *SINGLE_THREAD, *PROFILE_VARIABLES):
        monkeypatch.delenv(name, raising=False)
    before = forked_commands.read_at_start(os.environ)
    assert forked_commands.read_at_start(node_environment(7, profile)) == before


@pytest.mark.parametrize("name", ["LANG", "LD_PRELOAD", "OPENBLAS_CORETYPE", "PYTHONPATH", "PYTHONWARNINGS"])
def test_what_is_read_at_a_start(name: str) -> None:
    assert forked_commands.read_at_start({name: "x", "ROS_DOMAIN_ID": "7"}) == {name: "x"}


def test_packages_that_can_be_found_later(tmp_path: Path) -> None:
    """Not those that hide what has been imported, and not what Python imports at its start."""
    (tmp_path / "laws_of_a_test.py").touch()
    variables = {"PYTHONPATH": os.pathsep.join([str(tmp_path), "/nowhere"])}
    assert forked_commands.packages_of({}, sys.path) == []
    assert forked_commands.packages_of(variables, sys.path) == [str(tmp_path), "/nowhere"]
    for name in ("rclpy", "numpy.py", "sys.py", "sitecustomize.py"):
        (tmp_path / name).touch()
        assert forked_commands.packages_of(variables, sys.path) == [], name
        (tmp_path / name).unlink()
