"""The test of docs/python.md, several runs in one program, and `play --json`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from pages import ROOT, python

pytest.importorskip("rclpy")

from msg_agents.discovery.rtps import free_domain
from msg_analysis import Experiment

BIN = Path(sys.executable).parent


def in_python(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-P", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=100)


def test_the_pytest_recipe_of_the_page(tmp_path: Path) -> None:
    """It passes as it is; where the run does not follow its law, it fails with the reason."""
    (code,) = [code for code, _ in python(ROOT / "docs/python.md") if "msg_agents.testing" in code]
    (tmp_path / "test_good.py").write_text(code)
    wrong = code.replace("    assert_agrees", "    run.states[:] *= 2.0\n    assert_agrees")
    (tmp_path / "test_wrong.py").write_text(wrong)
    process = in_python("-m", "pytest", "-q", "-p", "no:cacheprovider", "--tb=short", str(tmp_path), folder=tmp_path)
    assert "1 failed, 1 passed" in process.stdout, process.stdout + process.stderr
    assert "disagrees" in process.stdout
    assert "test_wrong.py" in process.stdout


MISTAKES = """
from msg_agents import run_network
from msg_analysis import InputError
for given in ("line_rin", "nowhere.yaml"):
    try:
        run_network(given, "runs")
    except InputError as error:
        print(type(error).__name__, error)
"""


def test_mistakes_start_nothing(tmp_path: Path) -> None:
    process = in_python("-c", MISTAKES, folder=tmp_path)
    assert process.returncode == 0, process.stderr
    first, second = process.stdout.splitlines()
    assert "line_rin: no such file, and no example of this name" in first
    assert "nowhere.yaml: no such file" in second
    assert not (tmp_path / "runs").exists()


SEVERAL = """
import os, sys
from pathlib import Path
from msg_agents.run.runner import run_network
from msg_analysis import Experiment, read_bag
from msg_analysis.twin.check import check

def children():
    return Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()

pair = {"graphs": {"a": {"path": [1, 2]}}, "run": {"dt": 0.1, "start": "zero", "processes": "one_per_agent"}}
for duration in (2, 3):
    run = {**pair["run"], "duration": duration}
    result = run_network(Experiment.parse({**pair, "name": "pair", "run": run}), Path("runs"))
    outcome = check(read_bag(result.bag))
    print(duration, result.failures, outcome.difference, outcome.missing, children())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="this machine: not Linux")
def test_several_runs(tmp_path: Path) -> None:
    """Each is whole and equal to its twin, and leaves no process."""
    process = in_python("-c", SEVERAL, folder=tmp_path)
    assert process.returncode == 0, process.stderr
    assert process.stdout.splitlines() == ["2 [] None 0 []", "3 [] None 0 []"]


def test_play_json(tmp_path: Path) -> None:
    """One object on stdout, the notes on stderr."""
    pair = {"name": "pair", "graphs": {"a": {"path": [1, 2]}}, "run": {"dt": 0.1, "duration": 1, "start": "zero"}}
    Experiment.parse(pair).simulate().save(tmp_path / "bag")
    with free_domain() as domain:
        words = ["play", str(tmp_path / "bag"), "--rate", "max", "--domain", str(domain), "--json"]
        process = subprocess.run([BIN / "msg-agents", *words], capture_output=True, text=True, timeout=60)
    assert process.returncode == 0, process.stderr
    document = json.loads(process.stdout)
    assert document["messages"] == 2 * 11 + 2  # states, one holding period, the experiment
    assert document.keys() == {"messages", "seconds", "held_back"}
    assert "24 messages played" in process.stderr
