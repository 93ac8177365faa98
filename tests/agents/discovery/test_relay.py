"""The discovery relay, between sockets that stand for participants."""

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from waiting import wait_for

from msg_agents.discovery.relay import DiscoveryRelay, report_ready
from msg_agents.discovery.rtps import FIRST_RELAYED, discovery_port, disposal_message, free_domain, read_announcement

QUIET = 0.2  # s in which nothing comes
PARTNERS = {"agent_1": {"agent_2", "switcher"}, "agent_2": {"agent_1", "switcher"}, "agent_3": {"switcher"}}
ALL = {**PARTNERS, "switcher": set(PARTNERS)}


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

    def hears(self, *others: "Participant") -> None:
        """It hears the announcements of these, in any order, and then nothing."""
        self.socket.settimeout(10)
        heard = [self.socket.recv(1 << 16) for _ in others]
        assert sorted(heard) == sorted(other.announcement for other in others)
        self.socket.settimeout(QUIET)
        with pytest.raises(TimeoutError):
            self.socket.recv(1 << 16)


@pytest.fixture
def domain() -> Iterator[int]:
    """The second of two: processes of the first one announce their end to its ports, too (``discovery_ports``)."""
    with free_domain(2) as number:
        yield number + 1


@pytest.fixture
def relay(request: pytest.FixtureRequest, domain: int) -> Iterator[DiscoveryRelay]:
    with DiscoveryRelay(domain, **getattr(request, "param", {})) as relay:
        relay.connect(ALL)
        yield relay
    assert not any(thread.name == "discovery relay" for thread in threading.enumerate())


@pytest.fixture
def processes(domain: int, relay: DiscoveryRelay) -> Iterator[list[Participant]]:
    """Four processes of the run."""
    del relay  # which has the first port
    processes = [Participant(domain, FIRST_RELAYED + i) for i in range(4)]
    yield processes
    for each in processes:
        each.socket.close()


def report(relay: DiscoveryRelay, name: str, participant: Participant) -> None:
    report_ready(os.dup(relay.descriptor), name, participant.prefix)


def settle() -> None:
    time.sleep(QUIET)


def ready(relay: DiscoveryRelay, participants: list[Participant]) -> None:
    """Agents 1, 2, ... announce themselves, and are ready a little later."""
    for number, each in enumerate(participants, start=1):
        each.announce()
        settle()
        report(relay, f"agent_{number}", each)
    settle()


def test_those_who_have_to_do_with_each_other_meet(relay: DiscoveryRelay, processes: list[Participant]) -> None:
    """As soon as both are ready: the later one is announced to the earlier one, which answers by itself."""
    for each in processes:
        each.announce()
    settle()
    one, two, three, switcher = processes
    report(relay, "agent_1", one)
    report(relay, "agent_3", three)
    settle()
    report(relay, "agent_2", two)
    one.hears(two)
    report(relay, "switcher", switcher)
    for each in (one, two, three):
        each.hears(switcher)
    switcher.hears()


def test_a_report_may_be_faster_than_the_announcement(relay: DiscoveryRelay, processes: list[Participant]) -> None:
    one, two, *_ = processes
    one.announce()
    report(relay, "agent_1", one)
    report(relay, "agent_2", two)
    settle()
    two.announce()
    one.hears(two)


def test_who_comes_back_is_connected_again(relay: DiscoveryRelay, processes: list[Participant], domain: int) -> None:
    one, two, *_ = processes
    ready(relay, [one, two])
    one.hears(two)
    again = Participant(domain, FIRST_RELAYED + 7)
    again.announce()
    settle()
    report(relay, "agent_2", again)
    one.hears(again)
    two.hears()
    again.socket.close()


def test_joining_participants_are_connected_to_all(
    relay: DiscoveryRelay, processes: list[Participant], domain: int
) -> None:
    ready(relay, processes[:3])
    processes[0].hears(processes[1])
    joining = Participant(domain, 5)
    joining.announce()
    for each in processes[:3]:
        each.hears(joining)
    processes[3].hears()  # it is not ready
    joining.socket.close()


def test_joining_participants_are_asked_to_announce_themselves(domain: int) -> None:
    """Again and again, until the run ends, by a participant of the same machine that listens where processes do."""
    with ExitStack() as stack:
        with DiscoveryRelay(domain, period=0.0) as relay:
            relay.connect(PARTNERS)
            joining, process = Participant(domain, 5), Participant(domain, FIRST_RELAYED)
            for each in (joining, process):
                stack.callback(each.socket.close)
            process.announce()
            joining.socket.settimeout(10)
            asked = joining.socket.recv(1 << 16)
            process.announce()
            assert joining.socket.recv(1 << 16) == asked
        asking = read_announcement(asked)
        assert asking.port == discovery_port(domain, 0)
        assert asking.prefix[:4] == process.prefix[:4]
        assert asking.prefix != process.prefix
        while (heard := joining.socket.recv(1 << 16)) == asked:
            pass
        assert heard == disposal_message(asking.prefix)
        process.hears()


def test_who_becomes_ready_hears_of_the_joining_participants(
    relay: DiscoveryRelay, processes: list[Participant], domain: int
) -> None:
    one, two, *_ = processes
    one.announce()
    joining, gone = Participant(domain, 5), Participant(domain, 6)
    joining.announce()
    gone.announce()
    gone.announce(disposal_message(gone.prefix))
    settle()
    report(relay, "agent_1", one)
    one.hears(joining)
    report(relay, "agent_2", two)  # faster than the announcement
    settle()
    two.announce()
    two.hears(joining)
    one.hears(two)
    joining.socket.close()
    gone.socket.close()


@pytest.mark.parametrize(("relay", "joins"), [({}, False), ({"joining_after": 0.0}, True)], indirect=["relay"])
def test_foreign_nodes_among_the_numbers_of_the_run(
    relay: DiscoveryRelay, processes: list[Participant], joins: bool
) -> None:
    """They may be processes of the run that are not ready; later they are joining participants."""
    one, foreign, *_ = processes
    one.announce()
    report(relay, "agent_1", one)
    settle()
    foreign.announce()
    one.hears(*([foreign] if joins else []))


@pytest.mark.parametrize(("relay", "again"), [({}, False), ({"repeat": 0.0}, True)], indirect=["relay"])
def test_announcements_are_repeated(relay: DiscoveryRelay, processes: list[Participant], again: bool) -> None:
    """Now and then only: most of them, the participants hear directly."""
    one, two, *_ = processes
    ready(relay, [one, two])
    one.hears(two)
    two.announce()
    one.hears(*([two] if again else []))


def test_who_has_left_is_not_connected(relay: DiscoveryRelay, processes: list[Participant], domain: int) -> None:
    _, two, three, _ = processes
    joining = Participant(domain, 5)
    for name, each in (("agent_2", two), ("agent_3", three)):
        each.announce()
        report(relay, name, each)
    settle()
    two.announce(disposal_message(two.prefix))
    settle()
    joining.announce()
    three.hears(joining)
    two.hears()
    joining.socket.close()


@pytest.mark.parametrize("relay", [{"fresh": 0.0}], indirect=True)
def test_who_has_not_been_heard_for_long_is_not_connected(relay: DiscoveryRelay, processes: list[Participant]) -> None:
    ready(relay, processes[:2])
    processes[0].hears()


@pytest.mark.parametrize("noise", [b"", b"RTPS", bytes(3000), b"RTPS" + bytes(100)])
def test_noise_does_no_harm(relay: DiscoveryRelay, processes: list[Participant], noise: bytes) -> None:
    one, two, *_ = processes
    one.announce(noise)
    os.write(relay.descriptor, b"nonsense\nzz agent_1\n")
    ready(relay, [one, two])
    one.hears(two)


@pytest.mark.parametrize("relay", [{"most_known": 2}], indirect=True)
def test_not_more_is_remembered_than_needed(relay: DiscoveryRelay, processes: list[Participant]) -> None:
    for each in processes:
        each.announce()
    wait_for(lambda: set(relay._known) == {each.prefix for each in processes[2:]}, 10)


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
