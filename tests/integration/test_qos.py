"""Some cells of the matrix of quality of service, with real writers and readers, and what is left of them."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from waiting import state_of

from msg_agents.running.run_folder import PREFIX


@pytest.fixture
def plain_shell(network: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Any]:
    """The command's folder is one of the test's own, which must be empty at the end."""
    for name in ("ROS_DISCOVERY_SERVER", "ROS_LOCALHOST_ONLY", "RMW_IMPLEMENTATION", "CYCLONEDDS_URI"):
        monkeypatch.delenv(name, raising=False)
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    yield network
    assert list(folder.glob(f"{PREFIX}*")) == []


def measured(network: Any, only: str, tries: int) -> dict[tuple[str, str], dict[str, Any]]:
    """Cells by history and reader; none contradicts ROS 2."""
    process = network.start("doctor", "--qos", "--json", "--only", only, "--tries", str(tries))
    stdout, stderr = process.communicate(timeout=120)
    assert process.returncode == 0, stderr + stdout
    document = json.loads(stdout)
    assert (document["meets"], document["violating"], document["not_counted"]) == (True, 0, 0)
    return {(cell["history"], cell["reader"]): cell for cell in document["cells"]}


def test_reliable_and_latched(plain_shell: Any) -> None:
    """Of 40 messages: 30 before a late reader joins; 10, 20 and 10 around a stop or a death."""
    cells = measured(plain_shell, "reliable,transient_local,keep_last_10,one", 1)
    assert {reader: cell["tries"] for (_, reader), cell in cells.items()} == {
        **dict.fromkeys(("first", "killed", "slow", "stopped"), 1),
        "late": 10,
    }
    due = {reader: cell["due"] / cell["tries"] for (_, reader), cell in cells.items()}
    assert due == {"first": 40, "late": 10 + 10, "killed": 10 + 10 + 10, "slow": 40, "stopped": 40}
    for (_, reader), cell in cells.items():
        assert cell["sent"] == 40 * cell["tries"]
        assert cell["received"] == cell["due"] - cell["lost"]
        assert cell["latency"]["max"] > 0
        if reader in ("late", "killed", "stopped"):  # no more than the history has is ever on its way, or held
            assert cell["lost"] <= (10 if reader == "stopped" else 0)


def test_many_readers_without_guarantees(plain_shell: Any) -> None:
    """Best effort, and nothing is kept: of what was published before it came, a reader gets nothing."""
    cells = measured(plain_shell, "best_effort,volatile,keep_last_1,late,killed,many", 2)
    assert {reader: cell["due"] for (_, reader), cell in cells.items()} == {
        "late": 2 * 4 * 10,
        "killed": 2 * 4 * (10 + 10),
    }


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=str)
def test_the_command_is_ended_while_readers_are_stopped(
    network: Any, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No process is left, not even one that stands still."""
    monkeypatch.delenv("RMW_IMPLEMENTATION", raising=False)
    command = network.start("doctor", "--qos", "--only", "reliable,keep_all,stopped,many")

    def stopped() -> bool:
        states = []
        for process in network.processes():
            try:
                states.append(state_of(process.pid))
            except OSError:
                continue
        return "T" in states

    network.wait_for(stopped, 60, "a stopped reader")
    os.kill(command.pid, number)
    stdout, stderr = command.communicate(timeout=30)
    assert (stdout, "Traceback" in stderr) == ("", False)
    assert command.returncode == (130 if number == signal.SIGINT else -signal.SIGKILL)
    network.wait_for(lambda: not network.processes(), 20, "the end of all processes")
