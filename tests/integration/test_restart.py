"""Killed agents and switchers are started again, rejoin, and change nothing."""

from __future__ import annotations

import json
import random
import re
import signal
import time
from typing import Any

import pytest

from msg_agents.check import check
from msg_analysis.bags.reader import read_bag

# Long enough to be killed in the middle; short enough for nobody to be 5,000 steps ahead of what a dead process never
# acknowledged, for which the middleware would wait until it gives that process up (20 s).
MIDDLING = {"duration": 250, "replicas": 64, "processes": 3}


@pytest.mark.parametrize("kinds", [["agent"], ["switcher"], ["agent", "switcher", "agent"]], ids=" ".join)
def test_killed_children_come_back(network: Any, kinds: list[str], repetition: int) -> None:
    rng = random.Random(f"{kinds} {repetition}")
    run = network.start(
        "run", network.file(run=MIDDLING), "--out", network.directory / "runs", "--restarts", "5", "--json"
    )
    network.wait_until_moving()
    time.sleep(rng.uniform(0.0, 0.5))
    for kind in kinds:
        victims = network.wait_for(lambda kind=kind: network.processes(kind), 30, f"a living {kind}")
        rng.choice(victims).kill(signal.SIGKILL)
    stdout, stderr = run.communicate(timeout=120)
    assert run.returncode in (0, 1), stderr  # by chance one run in a hundred disagrees
    assert "Traceback" not in stderr
    result = json.loads(stdout)
    assert len(result["restarts"]) == len(kinds)
    assert all(
        re.match(r"(agents?_\w+|switcher): killed by SIGKILL.*, started again$", line) for line in result["restarts"]
    )
    assert result["failures"] == []
    trajectory = read_bag(result["bag"])
    assert trajectory.completeness.complete
    assert trajectory.completeness.duplicates == 0
    outcome = check(trajectory)
    assert (outcome.difference, outcome.missing) == (None, 0)
    assert network.processes() == []


def test_budget(network: Any) -> None:
    """One kill more than allowed: a clear end."""
    run = network.start(
        "run",
        network.file(run={"duration": 10_000, "processes": 2}),
        "--out",
        network.directory / "runs",
        "--restarts",
        "1",
    )
    network.wait_until_moving()
    first = network.processes("agent")
    first[0].kill()
    network.wait_for(lambda: {p.pid for p in network.processes("agent")} - {p.pid for p in first}, 30, "the next one")
    network.processes("switcher")[0].kill()
    _, stderr = run.communicate(timeout=60)
    assert run.returncode == 3
    assert re.search(r"^note: agents_\w+: killed by SIGKILL.*, started again$", stderr, re.MULTILINE), stderr
    assert re.search(r"^failed: switcher: killed by SIGKILL", stderr, re.MULTILINE), stderr
    assert network.processes() == []
