"""How agents in real time hear each other: with best effort, or reliably; all else is reliable in both."""

from __future__ import annotations

from typing import Any

import pytest
from visitor import assert_delivery


@pytest.mark.parametrize("delivery", ["best_effort", "reliable"])
def test_readers_of_states(network: Any, domain: int, delivery: str) -> None:
    """Agents 2 and 5 hear agent 1. What holds if nothing is said: test_introductions."""
    # Few steps, and large states, which are soon seen in the bag.
    file = network.file(run={"pace": "realtime", "duration": 1000, "replicas": 128})
    run = network.record(file, "--domain", str(domain), "--delivery", delivery)
    network.wait_until_moving()
    assert_delivery(delivery.upper(), [2, 5], domain)
    run.terminate()
    run.communicate(timeout=60)


def test_lockstep_refuses_best_effort(network: Any) -> None:
    run = network.start("run", network.file(), "--delivery", "best_effort")
    _, stderr = run.communicate(timeout=60)
    assert run.returncode == 2
    assert "--delivery: run.delivery: best_effort: in lockstep expected reliable, since every value is needed" in stderr
