"""When processes were killed and back, and messages refused, as the runner sees it."""

from __future__ import annotations

from collections import Counter
from typing import Any

from msg_agents.run.result import EventLog, StatusSummary


def test_events() -> None:
    now = [0.0]
    events: list[dict[str, Any]] = []
    refused: Counter[tuple[str, str, str]] = Counter()
    looks = []

    def account() -> StatusSummary:
        looks.append(now[0])
        return StatusSummary(refused)

    log = EventLog(events, clock=lambda: now[0])
    log.look([], account)
    log.killed("agent_2", [1], 7, "agent_2: killed by SIGKILL after step 7, started again")
    log.look([9, 7], account)  # the other one goes on
    log.look([12, 8], account)
    assert [(one["kind"], one["step"], one["node"]) for one in events] == [
        ("killed", 7, "agent_2"),
        ("back", 12, "agent_2"),
    ]
    log.look([20, 20], account)
    log.killed("switcher", [], -1, "switcher: killed")
    assert (events[-1]["kind"], events[-1]["step"]) == ("killed", 20)

    refused["agent_1", "graph", "other run"] = 3
    log.look([21, 21], account)
    assert looks == [0.0]  # the files are read once a second
    now[0] = 1.5
    log.look([30, 31], account)
    refused["agent_1", "graph", "other run"] = 9
    refused["agent_2", "end", "not signed with the key of the run"] = 1
    log.look([40, 40], account, last=True)
    assert [(one["kind"], one["step"], one["node"]) for one in events[3:]] == [
        ("refused", 31, "agent_1"),
        ("refused", 40, "agent_2"),
    ]
    assert "graph: other run" in events[3]["words"]


def test_killed_before_the_first_step() -> None:
    events: list[dict[str, Any]] = []
    log = EventLog(events)
    log.killed("agents_1-3", [0, 1, 2], -1, "killed")
    log.look([4, 0, -1], StatusSummary)
    log.look([4, 0, 0], StatusSummary)
    assert [(one["kind"], one["step"]) for one in events] == [("killed", 0), ("back", 4)]
