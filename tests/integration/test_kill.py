"""A child that is killed: the run ends soon, says who it was and how far everybody came, and keeps its bag."""

from __future__ import annotations

import logging
import random
import re
import time
from typing import Any

import pytest

from msg_agents.check import check
from msg_analysis.bags.reader import read_bag

LONG = {"duration": 10_000, "replicas": 1, "processes": 2}
LOG = logging.getLogger(__name__)


@pytest.mark.parametrize("when", ["early", "middle"])
@pytest.mark.parametrize("kind", ["agent", "switcher", "recorder"])
def test_killed_child(
    network: Any, kind: str, when: str, repetition: int, record_property: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Early: between the birth of the child and, likely, the first state. Middle: while states are recorded."""
    caplog.set_level(logging.INFO)
    rng = random.Random(f"{kind} {when} {repetition}")
    run = network.start("run", network.file(run=LONG), "--out", network.directory / "runs")
    network.wait_for(lambda: len(network.nodes()) == 4, 60, "four children")
    if when == "middle":
        network.wait_until_moving()
    time.sleep(rng.uniform(0.0, 1.0))
    victim = rng.choice(network.processes(kind))
    others = [process for process in network.nodes() if process != victim]
    assert network.shared_memory() == set()  # nothing that the victim could leave behind
    victim.kill()
    killed = time.monotonic()
    network.wait_for(lambda: not all(other.alive for other in others), 30, "the end of another child")
    noticed = time.monotonic() - killed
    _, stderr = run.communicate(timeout=60)
    ended = time.monotonic() - killed
    LOG.info(
        "%s killed (%s): first other child gone after %.2f s, run ended after %.2f s",
        kind,
        when,
        noticed,
        ended,
    )
    record_property("noticed", noticed)
    record_property("ended", ended)

    assert run.returncode == 3, stderr
    assert "Traceback" not in stderr
    assert network.processes() == []
    first = {1: "agents_1_to_2", 3: "agents_3_to_5"}[victim.agent] if kind == "agent" else kind
    assert re.search(rf"^failed: {first}: killed by SIGKILL", stderr, re.MULTILINE), stderr
    blamed = re.findall(r"^failed: (agents?_\w+|switcher|recorder): ", stderr, re.MULTILINE)
    assert blamed == [first], stderr
    (bag,) = (network.directory / "runs").iterdir()
    assert (bag / "log" / f"{first}.log").exists()
    if when == "early" and not list(bag.glob("*.mcap")):
        assert "nothing was recorded" in stderr
        return
    assert re.search(r"last recorded step: agent 1: (\d+|none), .*agent 5: (\d+|none)$", stderr, re.MULTILINE), stderr
    assert (bag / "metadata.yaml").exists()
    assert ("the bag was salvaged" in stderr) == (kind == "recorder")
    trajectory = read_bag(bag)
    assert not trajectory.completeness.complete
    if when == "middle":
        assert trajectory.completeness.received > 0
    assert check(trajectory).difference is None
