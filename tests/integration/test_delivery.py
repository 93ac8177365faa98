"""How agents in real time hear each other: with best effort, or reliably; all else is reliable in both."""

from __future__ import annotations

from typing import Any

import pytest
from visitor import assert_endpoints


@pytest.mark.parametrize("delivery", [None, "best_effort", "reliable"])
def test_readers_of_states(network: Any, domain: int, delivery: str | None) -> None:
    """Agents 2 and 5 hear agent 1. Its writer is reliable, as other readers may want it."""
    # Few steps, and large states, which are soon seen in the bag.
    file = network.file(run={"pace": "realtime", "duration": 1000, "replicas": 128})
    run = network.record(file, "--domain", str(domain), *(["--delivery", delivery] if delivery else []))
    network.wait_until_moving()
    heard = "RELIABLE" if delivery == "reliable" else "BEST_EFFORT"
    readers = {
        "/agent_1/state": [[f"agent_{i}", heard] for i in (2, 5)],
        "/states": [["recorder", "RELIABLE"]],
        "/graph": [*([f"agent_{i}", "RELIABLE"] for i in range(1, 6)), ["recorder", "RELIABLE"]],
    }
    assert_endpoints(readers, {"/agent_1/state": [["agent_1", "RELIABLE"]]}, domain)
    run.terminate()
    run.communicate(timeout=60)


def test_lockstep_refuses_best_effort(network: Any) -> None:
    run = network.start("run", network.file(), "--delivery", "best_effort")
    _, stderr = run.communicate(timeout=60)
    assert run.returncode == 2
    assert "--delivery: run.delivery: best_effort: in lockstep expected reliable, since every value is needed" in stderr
