"""Killed agents and switchers are started again, rejoin, and change nothing. That is the default."""

from __future__ import annotations

import html
import random
import re
import time
from pathlib import Path
from typing import Any

import pytest

RUN = {"duration": 200, "replicas": 16, "processes": 3}  # long enough to be killed in the middle
KILLED = r"(agents?_\w+|switcher): killed by SIGKILL.*, started again$"


@pytest.mark.parametrize("kinds", [["agent"], ["agent"] * 3, ["switcher"], ["agent", "switcher"]], ids=" ".join)
def test_killed_and_back(network: Any, kinds: list[str], repetition: int, rng: random.Random) -> None:
    """At any moment from the birth of the processes on: all at once, or also who has just come back."""
    run = network.start("run", network.file(run=RUN), "--out", network.directory / "runs", "--json")
    network.wait_for(lambda: len(network.nodes()) == RUN["processes"] + 2, 60, "all processes")
    early, again = repetition > 0 and rng.random() < 0.3, rng.random() < 0.5
    if not early:
        network.wait_until_moving()
    time.sleep(rng.uniform(0.0, 0.3))
    for kind in kinds:
        victim = rng.choice(network.wait_for(lambda kind=kind: network.processes(kind), 30, f"a living {kind}"))
        print("killed", "early" if early else "in the middle", victim.command[2:])
        victim.kill()
        if again:
            time.sleep(rng.uniform(0.0, 1.0))
    result = network.completed(run)
    # Who has done its part when it is killed need not come back.
    assert 1 <= len(result["restarts"]) <= len(kinds)
    assert all(re.match(KILLED, line) for line in result["restarts"])
    report = html.unescape(Path(result["report"]).read_text())
    assert all(line in report for line in result["restarts"])


def test_a_killed_fork_server(network: Any) -> None:
    """What it has forked goes on; killed agents are started without it."""
    run = network.record(network.file(run=RUN), "--json")
    network.wait_until_moving()
    (server,) = network.processes("node_server")
    server.kill()
    victim = network.processes("agent")[0]
    victim.kill()

    def back() -> Any:
        return [p for p in network.processes("agent") if p.agent == victim.agent and p != victim]

    (again,) = network.wait_for(back, 30, "the agent again")
    assert "msg_agents" in again.command  # python -m msg_agents agent ...
    assert len(network.completed(run)["restarts"]) == 1


def test_budget(network: Any) -> None:
    """One kill more than allowed: a clear end that names who and how often."""
    file = network.file(run={"duration": 10_000, "processes": 2})
    run = network.record(file, "--restarts", "1")
    network.wait_until_moving()
    first = network.processes("agent")
    first[0].kill()
    network.wait_for(lambda: {p.pid for p in network.processes("agent")} - {p.pid for p in first}, 30, "the next one")
    network.processes("switcher")[0].kill()
    _, stderr = run.communicate(timeout=60)
    assert run.returncode == 3
    (line,) = re.findall(r"^note: (agents_\w+): killed by SIGKILL.*, started again$", stderr, re.MULTILINE)
    assert re.search(
        rf"^failed: switcher: killed by SIGKILL.*all restarts are used up \(--restarts 1\): {line} once$",
        stderr,
        re.MULTILINE,
    ), stderr
