"""The right to run a node, and the removal of a killed process from the network."""

from __future__ import annotations

import multiprocessing
import os
import socket
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from msg_agents.processes.environment import PEERS_VARIABLE
from msg_agents.processes.ros_domain import PORT_BASE, PORTS_PER_DOMAIN, free_domain
from msg_agents.recovery import takeover
from msg_agents.recovery.takeover import disposal_message, remove_participant, take_over
from msg_analysis.errors import InputError

PREFIX = bytes(range(1, 13))
# Put together by hand from DDSI-RTPS 2.3: header, DATA with inline QoS (key hash, status), writer 0x000100c2.
DISPOSAL = bytes.fromhex(
    "52545053 0203 010f 0102030405060708090a0b0c"
    "15 03 3400"
    "0000 1000 00000000 000100c2 00000000 05000000"
    "7000 1000 0102030405060708090a0b0c 000001c1"
    "7100 0400 00000003"
    "0100 0000"
)


def test_the_message_byte_for_byte() -> None:
    assert disposal_message(PREFIX, 5) == DISPOSAL


def test_every_participant_of_the_domain_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """On this machine, and on the other hosts of the run."""
    monkeypatch.setenv(PEERS_VARIABLE, "127.0.0.1 127.0.0.2")
    places = [("127.0.0.1", 0), ("127.0.0.1", 99), ("127.0.0.2", 3)]
    with free_domain() as domain:
        sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in places]
        for listener, (address, participant) in zip(sockets, places, strict=True):
            listener.bind((address, PORT_BASE + PORTS_PER_DOMAIN * domain + 10 + 2 * participant))
            listener.settimeout(10)
        remove_participant(PREFIX, domain)
        for listener in sockets:
            heard = [listener.recv(1000) for _ in range(3)]
            assert len(set(heard)) == 3  # with numbers of their own: repetitions would be passed over
            assert all(message.startswith(DISPOSAL[:36]) and message[44:] == DISPOSAL[44:] for message in heard)
            listener.close()


def run_and_die(directory: Path) -> None:
    (own,) = take_over(directory, ["agent_1"])
    own.store_prefix(PREFIX)
    os.kill(os.getpid(), 9)


def test_a_takeover_removes_the_process_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    removed: list[tuple[bytes, int]] = []
    monkeypatch.setattr(takeover, "remove_participant", lambda prefix, domain: removed.append((prefix, domain)))
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
