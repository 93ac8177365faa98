"""The right to run a node, and the removal of a killed process from the network."""

from __future__ import annotations

import multiprocessing
import os
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from msg_agents import recovery
from msg_agents.recovery import take_over
from msg_analysis.errors import InputError

PREFIX = bytes(range(1, 13))


def run_and_die(directory: Path) -> None:
    (own,) = take_over(directory, ["agent_1"])
    own.store_prefix(PREFIX)
    os.kill(os.getpid(), 9)


def test_a_takeover_removes_the_process_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    removed: list[tuple[bytes, int]] = []
    monkeypatch.setattr(recovery, "remove_participant", lambda prefix, domain: removed.append((prefix, domain)))
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    before = multiprocessing.get_context("fork").Process(target=run_and_die, args=(tmp_path,))
    before.start()
    before.join()
    assert removed == []  # there was no process before
    takeovers = take_over(tmp_path, ["agent_1", "agent_2"])
    assert removed == [(PREFIX, 7)]
    with pytest.raises(InputError, match="another process is running agent_2"):
        take_over(tmp_path, ["agent_2"])
    assert [t.predecessor for t in takeovers] == [PREFIX, b""]


def test_without_a_directory_there_is_no_takeover() -> None:
    assert take_over(None, ["agent_1"]) == []
