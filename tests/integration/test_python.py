"""The example of docs/python.md that starts a network, runs that are prepared, and `play --json`."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from msg_agents.discovery.rtps import free_domain
from msg_analysis import Experiment

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
LINE_RING = ROOT / "analysis/msg_analysis/experiment/bundled/line_ring.yaml"


def test_what_the_page_says(tmp_path: Path) -> None:
    """In a process of its own, as a reader's script is; the run agrees with probability 0.99, and its seed is fixed."""
    page = (ROOT / "docs/python.md").read_text(encoding="utf-8")
    _, code, *_ = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    text = LINE_RING.read_text()
    (tmp_path / "line_ring.yaml").write_text(re.sub(r"duration: \S+", "duration: 20", text))
    (tmp_path / "runs").mkdir()
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=100
    )
    assert process.returncode == 0, process.stderr
    assert "<Comparison, run of 'line_ring': agrees;" in process.stdout
    assert process.stdout.rstrip().endswith("[]")


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
    words = [sys.executable, "-P", "-c", SEVERAL]
    process = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=100)
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
    assert document["messages"] == 2 * 11 + 2  # states, one sojourn, the experiment
    assert document.keys() == {"messages", "seconds", "held_back"}
    assert "24 messages played" in process.stderr
