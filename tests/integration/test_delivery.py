"""How agents in real time hear each other: with best effort, or reliably; all else is reliable in both."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

from msg_agents.processes.environment import node_environment

READERS = """
import json, sys, time, rclpy
wanted, found, end = json.loads(sys.argv[1]), {}, time.monotonic() + 20
rclpy.init()
node = rclpy.create_node("visitor")
readers = node.get_subscriptions_info_by_topic
while found != wanted and time.monotonic() < end:
    time.sleep(0.1)
    found = {
        topic: sorted([r.node_name, r.qos_profile.reliability.name] for r in readers(topic))
        for topic in wanted
    }
    writers = node.get_publishers_info_by_topic("/agent_1/state")
    found["writers"] = [w.qos_profile.reliability.name for w in writers]
print(json.dumps(found))
"""


@pytest.mark.parametrize("delivery", [None, "best_effort", "reliable"])
def test_readers_of_states(network: Any, domain: int, delivery: str | None) -> None:
    """Agents 2 and 5 hear agent 1. Its writer is reliable, as other readers may want it."""
    wanted = {
        "/agent_1/state": [[f"agent_{i}", "RELIABLE" if delivery == "reliable" else "BEST_EFFORT"] for i in (2, 5)],
        "/states": [["recorder", "RELIABLE"]],
        "/graph": [*([f"agent_{i}", "RELIABLE"] for i in range(1, 6)), ["recorder", "RELIABLE"]],
        "writers": ["RELIABLE"],
    }
    file = network.file(run={"pace": "realtime", "speed": 10, "duration": 10_000})
    run = network.record(file, "--domain", str(domain), *(["--delivery", delivery] if delivery else []))
    network.wait_until_moving()
    command = [sys.executable, "-P", "-c", READERS, json.dumps(wanted)]
    visitor = subprocess.run(
        command, env=node_environment(domain), capture_output=True, text=True, timeout=60, check=False
    )
    run.terminate()
    run.communicate(timeout=60)
    assert json.loads(visitor.stdout) == wanted, visitor.stderr


def test_lockstep_refuses_best_effort(network: Any) -> None:
    run = network.start("run", network.file(), "--delivery", "best_effort")
    _, stderr = run.communicate(timeout=60)
    assert run.returncode == 2
    assert "--delivery: run.delivery: best_effort: in lockstep expected reliable, since every value is needed" in stderr
