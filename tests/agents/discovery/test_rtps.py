"""Discovery: messages against bytes put together by hand from DDSI-RTPS 2.3 and real ones; domains and their locks."""

import os
import re
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rclpy")

from msg_agents.discovery.rtps import (
    FIRST_RELAYED,
    GROUP,
    LOOPBACK_INTERFACES,
    MOST_RELAYED,
    PEERS_VARIABLE,
    PORT_BASE,
    PORTS_PER_DOMAIN,
    RELAYED_PROFILE,
    Announcement,
    announce_here,
    announcement_message,
    discovery_port,
    discovery_ports,
    disposal_message,
    domains_for,
    domains_with_ports_in_use,
    free_domain,
    held_domains,
    multicast_port,
    read_announcement,
    remove_participant,
)
from msg_agents.environment import LAST_DOMAIN, node_environment
from msg_analysis.errors import InputError

PREFIX = bytes(range(1, 13))
HEADER = bytes.fromhex("52545053 0203 010f 0102030405060708090a0b0c")
# DATA with inline QoS (key hash, status), writer 0x000100c2.
DISPOSAL = HEADER + bytes.fromhex(
    "15 03 3400"
    "0000 1000 00000000 000100c2 00000000 05000000"
    "7000 1000 0102030405060708090a0b0c 000001c1"
    "7100 0400 00000003"
    "0100 0000"
)
TIMESTAMP = bytes.fromhex("09 01 0800 0000000000000000")
TO_ONE = bytes.fromhex("0e 01 0c00 0102030405060708090a0b0d")
# Protocol version, two locators for discovery (ports 7474 and 7475, at 127.0.0.1), sentinel.
PARAMETERS = bytes.fromhex(
    "0003 0000"
    "1500 0400 02030000"
    "3200 1800 01000000 321d0000 000000000000000000000000 7f000001"
    "3200 1800 01000000 331d0000 000000000000000000000000 7f000001"
    "0100 0000"
)
DATA = bytes.fromhex("0000 1000 00000000 000100c2 00000000 01000000")
INLINE_QOS = bytes.fromhex("7000 1000 0102030405060708090a0b0c 000001c1 0100 0000")
ANNOUNCER = """
import time, rclpy
rclpy.init()
node = rclpy.create_node("announcer")
time.sleep(60)
"""

ANSWERER = """
import time, rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("answerer")
publisher = node.create_publisher(String, "here", 1)
(own,) = node.get_publishers_info_by_topic("here")
time.sleep(1)  # the first announcements are over
print(bytes(own.endpoint_gid[:12]).hex(), flush=True)
time.sleep(1)
print(node.get_node_names(), flush=True)
time.sleep(60)
"""

READER = bytes(range(100, 112))


def submessage(flags: int, body: bytes, *, kind: int = 0x15, size: int | None = None) -> bytes:
    return bytes([kind, flags]) + (len(body) if size is None else size).to_bytes(2, "little") + body


@pytest.mark.parametrize(
    "datagram",
    [
        HEADER + submessage(5, DATA + PARAMETERS),
        HEADER + TIMESTAMP + submessage(5, DATA + PARAMETERS),
        HEADER + TIMESTAMP + submessage(5, DATA + PARAMETERS, size=0),
        HEADER + TIMESTAMP + submessage(7, DATA + INLINE_QOS + PARAMETERS),
    ],
    ids=["alone", "with its time", "to the end", "with inline QoS"],
)
def test_announcements(datagram: bytes) -> None:
    assert read_announcement(datagram) == Announcement(PREFIX, 7474, datagram)


def test_what_is_addressed_to_the_reader_is_made_an_announcement_to_all() -> None:
    """As Cyclone DDS answers, once to a participant of its own, once to none in particular (a prefix of zeros)."""
    rest = TIMESTAMP + submessage(5, DATA + PARAMETERS)
    own = HEADER + submessage(1, READER, kind=0x0E) + rest
    to_all = HEADER + submessage(1, bytes(12), kind=0x0E) + rest
    assert read_announcement(own) is None
    assert read_announcement(own, PREFIX) is None
    assert read_announcement(own, READER) == Announcement(PREFIX, 7474, to_all)
    assert read_announcement(to_all) == Announcement(PREFIX, 7474, to_all)


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"RTPS",
        HEADER,
        HEADER + TO_ONE + TIMESTAMP + submessage(5, DATA + PARAMETERS),
        HEADER + submessage(5, DATA.replace(b"\x01\x00\xc2", b"\x04\x03\x03") + PARAMETERS),
        HEADER + submessage(5, DATA + PARAMETERS.replace(b"\x32\x1d", b"\x00\x00", 1)),
        HEADER + submessage(5, DATA + PARAMETERS.replace(b"\x32\x00\x18", b"\x31\x00\x18")),
        HEADER + submessage(5, DATA + b"\0\1" + PARAMETERS[2:]),
        b"XTPS" + HEADER[4:] + submessage(5, DATA + PARAMETERS),
    ],
    ids=["empty", "cut off", "nothing", "to one", "other writer", "port 0", "no port", "other encoding", "other magic"],
)
def test_other_datagrams(datagram: bytes) -> None:
    assert read_announcement(datagram) is None


@given(st.binary(max_size=200), st.integers(0, 200))
def test_no_bytes_are_an_error(noise: bytes, place: int) -> None:
    whole = HEADER + TIMESTAMP + submessage(7, DATA + INLINE_QOS + PARAMETERS)
    for datagram in (noise, HEADER + noise, whole[:place], whole[:place] + noise, whole[:place] + whole[place + 1 :]):
        found = read_announcement(datagram)
        assert found is None or 0 <= found.port < 1 << 16


def test_the_announcement_of_a_real_participant() -> None:
    """Its prefix is that of all its messages; its port, by what the system knows, is one that it listens to."""
    with ExitStack() as stack:
        domain = stack.enter_context(free_domain())
        listener = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        listener.bind(("127.0.0.1", discovery_port(domain, 3)))
        listener.settimeout(30)
        environment = node_environment(domain, RELAYED_PROFILE)
        process = stack.enter_context(subprocess.Popen([sys.executable, "-P", "-c", ANNOUNCER], env=environment))
        stack.callback(process.kill)
        found = read_announcement(listener.recv(1 << 16))
        assert found.prefix == found.datagram[8:20]
        own = set()
        for entry in Path(f"/proc/{process.pid}/fd").iterdir():
            with suppress(FileNotFoundError):  # its node is still being made, which opens and closes files
                own.update(re.findall(r"socket:\[(\d+)\]", str(entry.readlink())))
        lines = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
        ports = {int(line[1].rpartition(":")[2], 16) for line in lines if line[9] in own}
        assert found.port in ports
        assert discovery_port(domain, FIRST_RELAYED) == found.port


def test_the_disposal_byte_for_byte() -> None:
    assert disposal_message(PREFIX, 5) == DISPOSAL
    assert read_announcement(DISPOSAL) == Announcement(PREFIX, 0, DISPOSAL)


def test_the_announcement_byte_for_byte() -> None:
    """Of a participant without endpoints, port 7474 of the loopback address, lease 20 s."""
    locator = "1800 01000000 321d0000 000000000000000000000000 7f000001"
    expected = HEADER + bytes.fromhex(
        "15 05 8c00"
        "0000 1000 00000000 000100c2 00000000 01000000"
        "0003 0000"
        "1500 0400 02030000"
        "1600 0400 010f0000"
        "5000 1000 0102030405060708090a0b0c 000001c1"
        "0200 0800 14000000 00000000"
        f"3200 {locator}"
        f"3100 {locator}"
        "5800 0400 03000000"
        "0100 0000"
    )
    message = announcement_message(PREFIX, 7474, 20)
    assert message == expected
    assert read_announcement(message) == Announcement(PREFIX, 7474, message)


@pytest.mark.parametrize("reach", ["SUBNET", "LOCALHOST", "our profile"])
def test_a_real_participant_answers_one_without_endpoints(reach: str) -> None:
    """By announcing itself where that listens, within less than its own period of 3 s, and it goes on working."""
    with free_domain() as domain, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener, ExitStack() as stack:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(10)
        own = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": reach}
        environment = node_environment(domain) if reach == "our profile" else os.environ | own
        participant_of_ros = stack.enter_context(
            subprocess.Popen([sys.executable, "-P", "-c", ANSWERER], stdout=subprocess.PIPE, text=True, env=environment)
        )
        stack.callback(participant_of_ros.kill)
        prefix = bytes.fromhex(participant_of_ros.stdout.readline())
        asking = announcement_message(prefix[:4] + bytes(range(8)), listener.getsockname()[1], 20)
        for participant in range(FIRST_RELAYED):
            listener.sendto(asking, ("127.0.0.1", discovery_port(domain, participant)))
        answer = None
        while answer is None:
            answer = read_announcement(listener.recv(1 << 16))
        assert answer.prefix == prefix
        assert participant_of_ros.stdout.readline() == "['answerer']\n"


def test_every_participant_of_the_domain_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """On this machine, and on the other hosts of the run."""
    monkeypatch.setenv(PEERS_VARIABLE, "127.0.0.1 127.0.0.2")
    places = [("127.0.0.1", 0), ("127.0.0.1", FIRST_RELAYED + MOST_RELAYED - 1), ("127.0.0.2", 3)]
    with free_domain(2) as domain:
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


@pytest.mark.parametrize("domain", [1, LAST_DOMAIN])
def test_ports_are_ports(domain: int) -> None:
    """The last domain has no ports for so many participants."""
    ports = discovery_ports(domain)
    assert ports[0] == discovery_port(domain, 0)
    assert len(ports) == min(FIRST_RELAYED + MOST_RELAYED, (65535 - ports[0]) // 2 + 1)
    assert ports[-1] < 1 << 16
    remove_participant(PREFIX, domain)


@pytest.mark.parametrize(("participants", "domains"), [(1, 1), (87, 1), (88, 2), (MOST_RELAYED, 2), (207, 3)])
def test_ports_of_a_run_stay_in_its_domains(participants: int, domains: int) -> None:
    """Both ports of the last participant lie below the first of the next domain (9.6.1.1: offsets 10 and 11)."""
    assert domains_for(participants) == domains
    last = discovery_port(1, FIRST_RELAYED + participants - 1) + 1
    assert last < PORT_BASE + PORTS_PER_DOMAIN * (1 + domains)


HOLD = """
import codecs, os
from msg_agents.discovery.rtps import free_domain
codecs.lookup("ascii")  # the other user may not read the files of this Python
os.umask(0o077)
os.setuid({user})
with free_domain(domains=range({first}, {end})) as held:
    print(held, flush=True)
    input()
"""


@pytest.fixture
def reserved() -> range:
    """Three numbers in a row that no run takes: there are no such domains."""
    return range(3 * os.getpid() + 1000, 3 * os.getpid() + 1003)


@contextmanager
def holder(domains: range, user: int) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A process that holds a domain, of a user whose umask lets nobody else read its files."""
    code = HOLD.format(first=domains.start, end=domains.stop, user=user)
    command = [sys.executable, "-P", "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process, int(process.stdout.readline())
        finally:
            process.kill()


def test_holders_get_different_domains(reserved: range) -> None:
    """And give them back, also when what they do fails."""
    with ExitStack() as stack:
        assert {stack.enter_context(free_domain(domains=reserved)) for _ in reserved} == set(reserved)
        with pytest.raises(InputError, match="--domain"), free_domain(domains=reserved):
            pass
    for _ in range(2):
        with pytest.raises(RuntimeError, match="the run failed"), free_domain(domains=reserved[:1]):
            raise RuntimeError("the run failed")


ANOTHER_USER = pytest.param(65534, marks=pytest.mark.skipif(os.geteuid() != 0, reason="run as root: another user"))


@pytest.mark.parametrize("user", [os.geteuid(), ANOTHER_USER])
def test_a_killed_holder_gives_its_domain_back(reserved: range, user: int) -> None:
    domains = reserved[:1]
    with holder(domains, user) as (process, held):
        assert held == domains[0]
        with pytest.raises(InputError), free_domain(domains=domains):
            pass
        assert held_domains(domains) == [held]
        process.kill()
        process.wait()
        assert held_domains(domains) == []
        with free_domain(domains=domains) as mine:
            assert mine == held


@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
def test_a_domain_whose_ports_are_in_use_is_left_alone(family: socket.AddressFamily) -> None:
    domains = [domain for domain in range(102, LAST_DOMAIN) if domain not in domains_with_ports_in_use()][:2]
    with socket.socket(family, socket.SOCK_DGRAM) as somebody:
        try:
            somebody.bind(
                ("::1" if family == socket.AF_INET6 else "127.0.0.1", PORT_BASE + PORTS_PER_DOMAIN * domains[0] + 11)
            )
        except OSError as error:
            pytest.skip(f"this machine: cannot bind: {error}")
        for _ in range(4):  # the order is random
            with free_domain(domains=domains) as chosen:
                assert chosen == domains[1]


IP_RECVTTL = 12  # Linux


def interfaces() -> list[tuple[int, str]]:
    """Those that can have multicast and an address: the kernel lists the groups of each."""
    members = Path("/proc/net/igmp").read_text()
    flags = {n: int(Path(f"/sys/class/net/{n}/flags").read_text(), 16) for _, n in socket.if_nameindex()}
    return [(i, n) for i, n in socket.if_nameindex() if flags[n] & 0x1001 == 0x1001 and f"{n}" in members]


def test_it_is_heard_at_the_interface_and_leaves_no_machine() -> None:
    found = [(i, n) for i, n in interfaces() if n not in LOOPBACK_INTERFACES]
    if not found:
        pytest.skip("no interface of a network")
    with free_domain() as domain, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        receiver.setsockopt(socket.IPPROTO_IP, IP_RECVTTL, 1)
        receiver.bind(("", multicast_port(domain)))
        index, _ = found[0]
        membership = struct.pack("4s4si", socket.inet_aton(GROUP), b"", index)
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        receiver.settimeout(5)
        announce_here(b"here", domain)
        data, (control, *_), *_ = receiver.recvmsg(100, 100)
    assert data == b"here"
    assert struct.unpack("i", control[2]) == (0,)  # a router, and the interface itself, drop it
