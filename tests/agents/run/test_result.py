"""What the processes of a run report: events, refused messages, what they wait for."""

import json
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from full_disk import full_disk
from networks import experiment

from msg_agents.cli.run_result import finish
from msg_agents.run.result import EventLog, RunResult, StatusSummary, read_status_files, write_report
from msg_agents.terminal import Interruption
from msg_analysis.twin.simulate import simulate


def test_events() -> None:
    now = [0.0]
    events: list[dict[str, Any]] = []
    refused: Counter[tuple[str, str, str]] = Counter()
    looks = []

    def status() -> StatusSummary:
        looks.append(now[0])
        return StatusSummary(refused)

    log = EventLog(events, clock=lambda: now[0])
    log.look([], status)
    log.killed("agent_2", [1], 7, "agent_2: killed by SIGKILL after step 7, started again")
    log.look([9, 7], status)  # the other one goes on
    log.look([12, 8], status)
    assert [(one["kind"], one["step"], one["node"]) for one in events] == [
        ("killed", 7, "agent_2"),
        ("back", 12, "agent_2"),
    ]
    log.look([20, 20], status)
    log.killed("switcher", [], -1, "switcher: killed")
    assert (events[-1]["kind"], events[-1]["step"]) == ("killed", 20)

    refused["agent_1", "graph", "other run"] = 3
    log.look([21, 21], status)
    assert looks == [0.0]  # the files are read once a second
    now[0] = 1.5
    log.look([30, 31], status)
    refused["agent_1", "graph", "other run"] = 9
    refused["agent_2", "end", "not signed with the key of the run"] = 1
    log.look([40, 40], status, last=True)
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


def test_counts_add_up_and_the_latest_word_on_waiting_counts(tmp_path: Path) -> None:
    """A process that was killed, the one that took over from it, and others that have said nothing or nonsense."""
    paths = [tmp_path / f"{i}.json" for i in range(4)]
    once, waiting = [("agent_1", "graph", "other run", 2)], {"agent_1": "at step 3, waiting", "agent_2": "so"}
    again = [("agent_1", "graph", "other run", 3), ("agent_1", "end", "other run", 1)]
    write_report(paths[0], {"refused": once, "waiting": waiting})
    write_report(paths[1], {"refused": again, "waiting": {"agent_1": ""}})
    paths[2].write_text("{")
    found = read_status_files(paths)
    assert found.waiting == {"agent_2": "so"}
    assert found.rejected_messages() == [
        {"node": "agent_1", "topic": "end", "reason": "other run", "count": 1},
        {"node": "agent_1", "topic": "graph", "reason": "other run", "count": 5},
    ]


def test_a_full_disk_is_no_failure(tmp_path: Path) -> None:
    write_report(tmp_path / "no such folder" / "x.json", {})


@pytest.mark.parametrize(
    ("limit", "lost", "as_json"),
    [
        (100, ["report.html", "result.json"], True),
        (100, ["report.html", "result.json"], False),
        (50_000, ["report.html"], True),
        (None, ["result.json"], False),
    ],
)
def test_the_verdict_is_said_without_room_for_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], limit: int | None, lost: list[str], as_json: bool
) -> None:
    """Files longer than so many bytes cannot be written; None: something else is where result.json should be."""
    what = experiment(3, run={"duration": 100, "replicas": 8})
    result = RunResult(what, tmp_path, trajectory=simulate(what))
    if limit is None:
        (tmp_path / "result.json").mkdir()
    with nullcontext() if limit is None else full_disk(limit), pytest.raises(SystemExit) as ended:
        finish(result, as_json, interruption=Interruption())
    stdout, stderr = capsys.readouterr()
    verdict = result.comparison.verdict
    assert ended.value.code == {"agrees": 2, "disagrees": 1}[verdict]
    assert verdict in stdout.lower()
    assert (json.loads(stdout)["not_kept"] if as_json else result.not_kept) == result.not_kept
    said = [line for line in stderr.splitlines() if line.startswith("not kept: ")]
    assert [line.split(":")[1].strip() for line in said] == [str(tmp_path / name) for name in lost]
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_file()) == sorted(
        {"report.html", "result.json"} - set(lost)
    )
