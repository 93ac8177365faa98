"""What processes tell the one that started them."""

from __future__ import annotations

from pathlib import Path

from msg_agents.run.result import read_status_files, write_status


def test_counts_add_up_and_the_latest_word_on_waiting_counts(tmp_path: Path) -> None:
    """A process that was killed, the one that took over from it, and others that have said nothing or nonsense."""
    paths = [tmp_path / f"{i}.json" for i in range(4)]
    write_status(paths[0], [("agent_1", "graph", "other run", 2)], {"agent_1": "at step 3, waiting", "agent_2": "so"})
    write_status(paths[1], [("agent_1", "graph", "other run", 3), ("agent_1", "end", "other run", 1)], {"agent_1": ""})
    paths[2].write_text("{")
    account = read_status_files(paths)
    assert account.waiting == {"agent_2": "so"}
    assert account.strangers() == [
        {"node": "agent_1", "topic": "end", "reason": "other run", "count": 1},
        {"node": "agent_1", "topic": "graph", "reason": "other run", "count": 5},
    ]


def test_a_full_disk_is_no_failure(tmp_path: Path) -> None:
    write_status(tmp_path / "no such folder" / "x.json", [], {})
