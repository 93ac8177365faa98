"""Introductions, between sockets that stand for participants."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from msg_agents.discovery import relay
from msg_agents.discovery.relay import DiscoveryRelay, report_ready
from msg_agents.discovery.rtps import FIRST_RELAYED, discovery_port, disposal_message, free_domain, read_announcement

QUIET = 0.2  # s in which nothing comes
PARTNERS = {"agent_1": {"agent_2", "switcher"}, "agent_2": {"agent_1", "switcher"}, "agent_3": {"switcher"}}


class Participant:
    """A socket at a participant's port, and what it says of itself."""

    def __init__(self, domain: int, number: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._to = ("127.0.0.1", discovery_port(domain, 0))
        port = discovery_port(domain, number)
        self.socket.bind(("127.0.0.1", port))
        self.prefix = bytes([number]) * 12
        locator = b"\x32\0\x18\0" + b"\1\0\0\0" + port.to_bytes(4, "little") + bytes(12) + b"\x7f\0\0\1"
        body = bytes.fromhex("0000100000000000 000100c2 0000000001000000 00030000") + locator + b"\1\0\0\0"
        self.announcement = b"RTPS\2\3\1\x0f" + self.prefix + b"\x15\5" + len(body).to_bytes(2, "little") + body

    def announce(self, datagram: bytes | None = None) -> None:
        self.socket.sendto(self.announcement if datagram is None else datagram, self._to)

    def hears(self, *others: Participant) -> None:
        """It hears the announcements of these, in any order, and then nothing."""
        self.socket.settimeout(10)
        heard = [self.socket.recv(1 << 16) for _ in others]
        assert sorted(heard) == sorted(other.announcement for other in others)
        self.socket.settimeout(QUIET)
        with pytest.raises(TimeoutError):
            self.socket.recv(1 << 16)


@pytest.fixture
def domain() -> Iterator[int]:
    """The second of two: processes of the first one say farewell to its ports, too (``discovery_ports``)."""
    with free_domain(2) as number:
        yield number + 1


@pytest.fixture
def meeting(domain: int) -> Iterator[DiscoveryRelay]:
    with DiscoveryRelay(domain) as meeting:
        meeting.introduce({**PARTNERS, "switcher": set(PARTNERS)})
        yield meeting
    assert not any(thread.name == "introducer" for thread in threading.enumerate())


@pytest.fixture
def crowd(domain: int, meeting: DiscoveryRelay) -> Iterator[list[Participant]]:
    """Four processes of the run."""
    del meeting  # which has the first port
    crowd = [Participant(domain, FIRST_RELAYED + i) for i in range(4)]
    yield crowd
    for each in crowd:
        each.socket.close()


def report(meeting: DiscoveryRelay, name: str, participant: Participant) -> None:
    report_ready(os.dup(meeting.descriptor), name, participant.prefix)


def settle() -> None:
    time.sleep(QUIET)


def test_those_who_have_to_do_with_each_other_meet(meeting: DiscoveryRelay, crowd: list[Participant]) -> None:
    """As soon as both are ready: the later one is announced to the earlier one, which answers by itself."""
    for each in crowd:
        each.announce()
    settle()
    one, two, three, switcher = crowd
    report(meeting, "agent_1", one)
    report(meeting, "agent_3", three)
    settle()
    report(meeting, "agent_2", two)
    one.hears(two)
    report(meeting, "switcher", switcher)
    one.hears(switcher)
    two.hears(switcher)
    three.hears(switcher)
    switcher.hears()


def test_a_report_may_be_faster_than_the_announcement(meeting: DiscoveryRelay, crowd: list[Participant]) -> None:
    one, two, *_ = crowd
    one.announce()
    report(meeting, "agent_1", one)
    report(meeting, "agent_2", two)
    settle()
    two.announce()
    one.hears(two)


def test_who_comes_back_is_introduced_again(meeting: DiscoveryRelay, crowd: list[Participant], domain: int) -> None:
    one, two, *_ = crowd
    for name, each in (("agent_1", one), ("agent_2", two)):
        each.announce()
        settle()
        report(meeting, name, each)
        settle()
    one.hears(two)
    again = Participant(domain, FIRST_RELAYED + 7)
    again.announce()
    settle()
    report(meeting, "agent_2", again)
    one.hears(again)
    two.hears()
    again.socket.close()


def test_visitors_are_introduced_to_all(meeting: DiscoveryRelay, crowd: list[Participant], domain: int) -> None:
    for name, each in zip(["agent_1", "agent_2", "agent_3"], crowd, strict=False):
        each.announce()
        settle()
        report(meeting, name, each)
    settle()
    crowd[0].hears(crowd[1])
    visitor = Participant(domain, 5)
    visitor.announce()
    for each in crowd[:3]:
        each.hears(visitor)
    crowd[3].hears()  # it is not ready
    visitor.socket.close()


def test_visitors_are_asked_to_announce_themselves(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Again and again, until the run ends, by a participant of the same machine that listens where processes do."""
    monkeypatch.setattr(relay, "PERIOD", 0.0)
    with ExitStack() as stack:
        with DiscoveryRelay(domain) as meeting:
            meeting.introduce(PARTNERS)
            visitor, process = Participant(domain, 5), Participant(domain, FIRST_RELAYED)
            for each in (visitor, process):
                stack.callback(each.socket.close)
            process.announce()
            visitor.socket.settimeout(10)
            asked = visitor.socket.recv(1 << 16)
            process.announce()
            assert visitor.socket.recv(1 << 16) == asked
        asking = read_announcement(asked)
        assert asking is not None
        assert asking.port == discovery_port(domain, 0)
        assert asking.prefix[:4] == process.prefix[:4]
        assert asking.prefix != process.prefix
        while (heard := visitor.socket.recv(1 << 16)) == asked:
            pass
        assert heard == disposal_message(asking.prefix)
        process.hears()


def test_who_becomes_ready_hears_of_the_visitors(
    meeting: DiscoveryRelay, crowd: list[Participant], domain: int
) -> None:
    one, two, *_ = crowd
    one.announce()
    visitor, gone = Participant(domain, 5), Participant(domain, 6)
    visitor.announce()
    gone.announce()
    gone.announce(disposal_message(gone.prefix))
    settle()
    report(meeting, "agent_1", one)
    one.hears(visitor)
    report(meeting, "agent_2", two)  # faster than the announcement
    settle()
    two.announce()
    two.hears(visitor)
    one.hears(two)
    visitor.socket.close()
    gone.socket.close()


def test_strangers_among_the_numbers_of_the_run(
    meeting: DiscoveryRelay, crowd: list[Participant], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They may be processes of the run that are not ready; later they are visitors."""
    one, stranger, *_ = crowd
    one.announce()
    report(meeting, "agent_1", one)
    stranger.announce()
    one.hears()
    monkeypatch.setattr(relay, "PATIENCE", 0.0)
    stranger.announce()
    one.hears(stranger)


def test_announcements_are_repeated(
    meeting: DiscoveryRelay, crowd: list[Participant], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Now and then only: most of them, the participants hear directly."""
    one, two, *_ = crowd
    for name, each in (("agent_1", one), ("agent_2", two)):
        each.announce()
        settle()
        report(meeting, name, each)
    one.hears(two)
    two.announce()
    one.hears()
    monkeypatch.setattr(relay, "REPEAT", 0.0)
    two.announce()
    one.hears(two)


def test_the_dead_are_not_introduced(
    meeting: DiscoveryRelay, crowd: list[Participant], domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who has said that it leaves, and who has not been heard for long."""
    one, two, three, _ = crowd
    visitor = Participant(domain, 5)
    for name, each in (("agent_1", one), ("agent_2", two), ("agent_3", three)):
        each.announce()
        report(meeting, name, each)
    settle()
    two.announce(disposal_message(two.prefix))
    settle()
    visitor.announce()
    three.hears(visitor)
    two.hears()
    monkeypatch.setattr(relay, "FRESH", 0.0)
    monkeypatch.setattr(relay, "REPEAT", 0.0)
    visitor.announce()
    three.hears()
    visitor.socket.close()


@pytest.mark.parametrize("noise", [b"", b"RTPS", bytes(3000), b"RTPS" + bytes(100)])
def test_noise_does_no_harm(meeting: DiscoveryRelay, crowd: list[Participant], noise: bytes) -> None:
    one, two, *_ = crowd
    one.announce(noise)
    os.write(meeting.descriptor, b"nonsense\nzz agent_1\n")
    for name, each in (("agent_1", one), ("agent_2", two)):
        each.announce()
        settle()
        report(meeting, name, each)
    one.hears(two)


def test_not_more_is_remembered_than_needed(
    meeting: DiscoveryRelay, crowd: list[Participant], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(relay, "MOST_KNOWN", 2)
    for each in crowd:
        each.announce()
    wanted, end = {each.prefix for each in crowd[2:]}, time.monotonic() + 10
    while set(meeting._known) != wanted and time.monotonic() < end:
        time.sleep(0.01)
    assert set(meeting._known) == wanted


def test_without_a_port_it_does_not_start(domain: int) -> None:
    with ExitStack() as stack:
        for number in range(FIRST_RELAYED):
            taken = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            taken.bind(("127.0.0.1", discovery_port(domain, number)))
        with pytest.raises(OSError, match="in use"), DiscoveryRelay(domain):
            pass
    with DiscoveryRelay(domain):
        pass


def test_with_few_descriptors_it_starts_or_does_not(domain: int) -> None:
    """In a process of its own: as many descriptors as it has, and one more each time."""
    code = f"""
import os, resource
from {DiscoveryRelay.__module__} import DiscoveryRelay
most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
used = len(os.listdir("/proc/self/fd")) - 1
for spare in range(20):
    resource.setrlimit(resource.RLIMIT_NOFILE, (used + spare, most))
    try:
        with DiscoveryRelay({domain}):
            print("started")
    except OSError as error:
        print(error.strerror)
    resource.setrlimit(resource.RLIMIT_NOFILE, (100, most))
    assert len(os.listdir("/proc/self/fd")) - 1 == used
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (result.stderr, result.returncode) == ("", 0)
    lines = result.stdout.splitlines()
    few = lines.count("Too many open files")
    assert 0 < few < 20
    assert lines == ["Too many open files"] * few + ["started"] * (20 - few)
