"""Surroundings in which a run has the same result as anywhere else."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from networks import assert_equal_to_twin
from programs import without_progress

from msg_analysis.bags.reading import read_bag

RUN = {"processes": 2, "duration": 5}
READ_ONLY = 'mount --bind "$1" "$1" && mount -o remount,ro,bind / && shift && exec "$@"'
NO_ROOT = "this machine: cannot make a root that is read-only (needs root and unshare)"


def undisturbed(network: Any, run: subprocess.Popen[str]) -> None:
    stdout, stderr = run.communicate(timeout=90)
    assert (run.returncode, without_progress(stderr or "")) == (0, "")
    result = json.loads(stdout)
    assert (result["verdict"], result["failures"], result["restarts"]) == ("agrees", [], [])
    assert Path(result["report"]).stat().st_size > 100_000
    assert_equal_to_twin(read_bag(result["bag"]))
    assert sorted(path.name for path in (Path(result["bag"]) / "log").iterdir()) == [
        *("agents_1_to_2.log", "agents_3_to_5.log", "recorder.log", "run.json", "switcher.log")
    ]


def test_no_home_and_warnings_are_errors(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HOME")
    for name, value in {"PYTHONWARNINGS": "error", "PYTHONPATH": "/nowhere", "ROS_LOCALHOST_ONLY": "1"}.items():
        monkeypatch.setenv(name, value)
    run = network.execute("run", network.file(run=RUN), "--out", network.directory / "runs", "--json")
    undisturbed(network, run)


def test_a_full_stderr(network: Any) -> None:
    """Nothing that cannot be said there changes the result or the exit code."""
    program = Path(sys.executable).with_name("msg-agents")
    command = [program, "run", network.file(run=RUN), "--out", network.directory / "runs", "--json"]
    with Path("/dev/full").open("w") as full:
        run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=full, text=True)
        undisturbed(network, run)
        slow = {"pace": "realtime", "duration": 3, "processes": 1}
        command[2] = network.file("slow.yaml", run=slow)
        run = subprocess.run([*command, "--no-analyse"], stdout=subprocess.PIPE, stderr=full, text=True)
    assert run.returncode == 0
    assert json.loads(run.stdout)["failures"] == []


def read_only_root(writable: Path) -> list[str]:
    """Begin of a command on a root of which one folder can be written, as in a hardened container; none: impossible."""
    enter = ["unshare", "--mount", "sh", "-c", READ_ONLY, "sh", str(writable)]
    possible = shutil.which("unshare") and subprocess.run([*enter, "true"], capture_output=True).returncode == 0
    return enter if possible else []


def test_nothing_can_be_written(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the home nor the log of ROS, nor the root where that can be made; another variable is not used."""
    variables = {"HOME": "/dev/null/home", "ROS_LOG_DIR": "/dev/null/logs", "ROS_DISCOVERY_SERVER": "127.0.0.1:11811"}
    for name, value in {**variables, "TMPDIR": str(network.directory)}.items():
        monkeypatch.setenv(name, value)
    program = Path(sys.executable).with_name("msg-agents")
    command = [program, "run", network.file(run=RUN), "--out", network.directory / "runs", "--json"]
    root = read_only_root(network.directory)
    undisturbed(network, subprocess.Popen([*root, *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
    if not root:
        pytest.skip(NO_ROOT)


def test_no_place_for_temporary_files(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """One error, and no bag is left."""
    monkeypatch.delenv("TMPDIR", raising=False)
    program = Path(sys.executable).with_name("msg-agents")
    command = [program, "run", network.file(run=RUN), "--out", network.directory / "runs"]
    root = read_only_root(network.directory)
    if not root:
        pytest.skip(NO_ROOT)
    run = subprocess.run([*root, *command], cwd="/", capture_output=True, text=True)
    assert (run.returncode, run.stdout) == (2, "")
    assert re.fullmatch(r"error: TMPDIR: No usable temporary directory found in .*: set it to .*\n", run.stderr)
    assert not list((network.directory / "runs").glob("*"))
