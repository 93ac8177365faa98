"""A child that is killed and cannot come back: the run ends soon, says who it was and how far everybody came, and keeps
its bag. The recorder never comes back, the others do unless they are not allowed to.
"""

from __future__ import annotations

import random
import re
import subprocess
import time
from typing import Any

import pytest

from msg_analysis.bags.reading import read_bag
from msg_analysis.twin.check import check

# 20,000 steps: no test waits for them; of states that are soon seen in the bag
LONG = {"duration": 1000, "replicas": 16, "processes": 2}


@pytest.mark.parametrize("kind", ["agent", "switcher"])
def test_killed_child_that_may_not_come_back(network: Any, kind: str, rng: random.Random) -> None:
    run = network.record(network.file(run=LONG), "--restarts", "0")
    network.wait_until_moving()
    kill_and_see(network, run, rng.choice(network.processes(kind)))


def test_killed_recorder(network: Any, repetition: int, rng: random.Random) -> None:
    """Every other time between its birth and, likely, the first state; else while states are recorded."""
    run = network.record(network.file(run=LONG))
    network.wait_for(lambda: len(network.nodes()) == 4, 60, "four children")
    early = repetition % 2 == 1
    if not early:
        network.wait_until_moving()
    time.sleep(rng.uniform(0.0, 1.0))
    kill_and_see(network, run, network.processes("recorder")[0], early=early)


def kill_and_see(network: Any, run: subprocess.Popen[str], victim: Any, *, early: bool = False) -> None:
    """The whole run ends, and says why."""
    assert network.shared_memory() == set()  # nothing that the victim could leave behind
    kind = victim.kind
    victim.kill()
    _, stderr = run.communicate(timeout=60)
    assert run.returncode == 3, stderr
    assert "Traceback" not in stderr
    assert network.processes() == []
    first = {1: "agents_1_to_2", 3: "agents_3_to_5"}[victim.agent] if kind == "agent" else kind
    assert re.search(rf"^failed: {first}: killed by SIGKILL", stderr, re.MULTILINE), stderr
    blamed = re.findall(r"^failed: (agents?_\w+|switcher|recorder): ", stderr, re.MULTILINE)
    assert blamed == [first], stderr
    (bag,) = (network.directory / "runs").iterdir()
    assert (bag / "log" / f"{first}.log").exists()
    if early and not list(bag.glob("*.mcap")):
        assert "nothing was recorded" in stderr
        return
    assert re.search(r"last recorded step: agent 1: (\d+|none), .*agent 5: (\d+|none)$", stderr, re.MULTILINE), stderr
    assert (bag / "metadata.yaml").exists()
    assert ("the bag was salvaged" in stderr) == (kind == "recorder")
    trajectory = read_bag(bag)
    assert not trajectory.completeness.complete
    assert early or trajectory.completeness.received > 0
    assert check(trajectory).difference is None
