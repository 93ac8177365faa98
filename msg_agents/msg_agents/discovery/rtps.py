# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Discovery by RTPS: profiles of Fast DDS, domains and their ports, datagrams, loopback and multicast."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import socket
import struct
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from msg_analysis.common.resources import ros_distribution
from msg_analysis.errors import InputError


def has_fast_dds_3(distribution: str) -> bool:
    """Whether a ROS 2, by its name, comes with Fast DDS 3 or newer: from Kilted on; they are named alphabetically."""
    return distribution > "jazzy"


# Fast DDS 3 refuses a profile with an element that it has renamed, and Fast DDS 2 one with the new name.
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")  # old name, new name
_PLACE = Path(__file__).parent / ("fast_dds_3" if has_fast_dds_3(ros_distribution()) else "")
LOOPBACK_PROFILE = _PLACE / "loopback.xml"
MOST_PARTICIPANTS = 100  # that find each other in a domain on one machine: maxInitialPeersRange of loopback.xml
RELAYED_PROFILE = _PLACE / "relayed.xml"
FIRST_RELAYED = 32  # participantID of relayed.xml; the numbers below are left to all others
MOST_RELAYED = 206  # participants that the relay connects: they fill the ports of two domains
NUMBERS_OF_DOMAIN = 119  # of participants whose ports are those of their domain; from there on, of the next one
UDP_PROFILE = Path(__file__).with_name("udp.xml")

LEASE = 60.0  # s of silence after which a participant on another host, and what is on its way to it, counts as lost
_NAMESPACE = "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"
DOMAINS = range(1, 102)  # 0 is the default of every ROS program; above 101 are the ephemeral ports of Linux
PORT_BASE, PORTS_PER_DOMAIN = 7400, 250  # the RTPS rule for well-known ports
PREFIX_SIZE = 12  # bytes of a GUID that all endpoints of a participant share
PEERS_VARIABLE = "MSG_AGENTS_PEERS"  # addresses of the hosts, in a run on several
LOOPBACK = "127.0.0.1"
GROUP = "239.255.0.1"  # of announcements by multicast (9.6.1.4)
_MAGIC, _HEADER_SIZE = b"RTPS", 20
FAST_DDS = b"\x01\x0f"  # the vendor (8.3.3.1.3)
_HEADER = _MAGIC + b"\x02\x03" + FAST_DDS  # version 2.3
_DATA, _TO_ONE = 0x15, 0x0E  # submessages
_ANYBODY = bytes(PREFIX_SIZE)  # as the addressee: all that receive it (8.3.7.6)
_LITTLE_ENDIAN, _INLINE_QOS, _WITH_DATA = 0x01, 0x02, 0x04  # flags
_PARTICIPANT, _PARTICIPANT_WRITER = b"\x00\x00\x01\xc1", b"\x00\x01\x00\xc2"
_KEY_HASH, _STATUS_INFO, _SENTINEL, _DISCOVERY_LOCATOR = 0x70, 0x71, 0x01, 0x32
_PARAMETERS_LITTLE_ENDIAN = b"\x00\x03"
_DISPOSED_UNREGISTERED = b"\x00\x00\x00\x03"
_PROTOCOL_VERSION, _VENDOR, _LEASE, _GUID, _DEFAULT_LOCATOR, _BUILTIN_ENDPOINTS = 0x15, 0x16, 0x02, 0x50, 0x31, 0x58
_UDP_V4, _ANNOUNCER_AND_DETECTOR = 1, 0x03
_LATE = 1 << 30  # sequence number: higher than that of any announcement that the participant made itself
LOOPBACK_TIMEOUT = 1.0  # s; in the kernel, a message is there at once
WORD = b"msg_agents"
LOOPBACK_INTERFACES = ("lo", "lo0")  # on Linux, elsewhere


def has_profile_for(topic: str) -> bool:
    """Whether the profile of this process, if there is one, says something of a topic, by its resolved name."""
    for variable in PROFILE_VARIABLES:
        with contextlib.suppress(OSError, ET.ParseError):
            tree = ET.parse(os.environ.get(variable, ""))
            return tree.find(f".//{{*}}data_writer[@profile_name='{topic}']") is not None
    return False


def domains_for(participants: int) -> int:
    """How many domains in a row have the ports of so many participants that the relay connects."""
    return -(-(FIRST_RELAYED + participants) // NUMBERS_OF_DOMAIN)


def profile_for_hosts(
    addresses: Sequence[str] = (),  # of all hosts, at which participants are looked for; empty: by multicast
    participants: int = MOST_PARTICIPANTS,  # to look for at each address
    *,
    lease: float = LEASE,  # s
) -> str:
    """A profile, as XML, for participants on several hosts: UDP at all their interfaces."""
    ET.register_namespace("", _NAMESPACE)
    tree = ET.parse(LOOPBACK_PROFILE)  # drops its comments, which are about another profile

    def find(path: str) -> ET.Element:
        found = tree.find(f".//{{*}}{path.replace('/', '/{*}')}")
        assert found is not None, path
        return found

    find("maxInitialPeersRange").text = str(participants)
    find("transport_descriptor").remove(find("interfaceWhiteList"))  # messages go to other hosts
    for each in find("profiles").findall("./*"):
        if each.get("profile_name", "").startswith("/"):  # batches stay small: a link that loses parts loses the whole
            find("profiles").remove(each)
    find("leaseDuration/sec").text = f"{lease:.0f}"
    peers = find("initialPeersList")
    peers.clear()
    for address in addresses:
        locator = ET.SubElement(ET.SubElement(peers, _tag("locator")), _tag("udpv4"))
        ET.SubElement(locator, _tag("address")).text = address
    if not addresses:
        find("builtin").remove(peers)
    ET.indent(tree, "  ")
    return ET.tostring(tree.getroot(), encoding="unicode", xml_declaration=True) + "\n"


def _tag(name: str) -> str:
    return f"{{{_NAMESPACE}}}{name}"


def domains_with_ports_in_use() -> set[int]:
    """Domains of which somebody has bound a UDP port on this machine."""
    ports: set[int] = set()
    for table in ("/proc/net/udp", "/proc/net/udp6"):
        try:
            lines = Path(table).read_text(encoding="ascii").splitlines()[1:]
        except OSError:
            continue
        ports.update(int(line.split()[1].rpartition(":")[2], 16) for line in lines)
    return {(port - PORT_BASE) // PORTS_PER_DOMAIN for port in ports}


@contextmanager
def free_domain(count: int = 1, domains: Sequence[int] = DOMAINS) -> Iterator[int]:
    """Hold a ROS_DOMAIN_ID, the first of ``count`` that no other run holds and whose ports are unused."""
    busy = domains_with_ports_in_use()
    free = [domain for domain in domains if domain not in busy]
    candidates = [first for first in free if set(range(first, first + count)) <= set(free)]
    random.shuffle(candidates)
    for first in candidates:
        with ExitStack() as holders:
            if all(_hold(domain, holders) for domain in range(first, first + count)):
                yield first
                return
    raise InputError(f"no free ROS domain among {domains[0]}..{domains[-1]}: end some runs or give --domain")


def held_domains(domains: Sequence[int] = DOMAINS) -> list[int]:
    """The domains that runs on this machine hold."""
    return list(filter(is_held, domains))


def is_held(domain: int) -> bool:
    """Whether a run holds a domain."""
    with ExitStack() as holders:
        return not _hold(domain, holders)


def _hold(domain: int, holders: ExitStack) -> bool:
    """Hold a domain until the end of ``holders``; whether that was possible."""
    # By a name of Linux for sockets that is no file. Users share these names as they share the ports, within a network
    # namespace, and need no permission for them; the system takes one back when its process ends, however it ends.
    holder = holders.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
    try:
        holder.bind(f"\0msg_agents_domain_{domain}")
    except OSError as error:
        return error.errno != errno.EADDRINUSE  # other systems: the ports alone tell who is there
    return True


def discovery_port(domain: int, participant: int) -> int:
    """Port at which a participant of this number receives announcements (9.6.1.1)."""
    return PORT_BASE + PORTS_PER_DOMAIN * domain + 10 + 2 * participant


def multicast_port(domain: int) -> int:
    """Port of the group at which all participants of a domain receive announcements (9.6.1.1)."""
    return PORT_BASE + PORTS_PER_DOMAIN * domain


def discovery_ports(domain: int) -> range:
    """Those of all participants that there can be; the last domain has fewer."""
    first, end = discovery_port(domain, 0), discovery_port(domain, FIRST_RELAYED + MOST_RELAYED)
    return range(first, min(end, 1 << 16), 2)


@dataclass(frozen=True, slots=True)
class Announcement:
    """What a participant says of itself to those that do not know it yet."""

    prefix: bytes  # of its GUID
    port: int  # at which it receives announcements; 0: it leaves
    datagram: bytes

    @property
    def vendor(self) -> bytes:
        """The number of who made the middleware."""
        return self.datagram[6:8]


def read_announcement(datagram: bytes, reader: bytes | None = None) -> Announcement | None:
    """The announcement in a datagram, made one to everybody; None if there is none, or it is for another ``reader``."""
    if datagram[:4] != _MAGIC:
        return None
    with contextlib.suppress(struct.error):  # it is cut off
        for kind, flags, begin, body in _submessages(datagram):
            if kind == _TO_ONE:
                if body[:PREFIX_SIZE] not in (_ANYBODY, reader):
                    return None
                datagram = datagram[:begin] + _ANYBODY + datagram[begin + PREFIX_SIZE :]
            if kind == _DATA and body[8:12] == _PARTICIPANT_WRITER and flags & _LITTLE_ENDIAN:
                port = _port(flags, body) if flags & _WITH_DATA else 0
                return None if port is None else Announcement(datagram[8:_HEADER_SIZE], port, datagram)
    return None


def _submessages(datagram: bytes) -> Iterator[tuple[int, int, int, bytes]]:
    """Kind, flags, place of the body, and the body of every submessage."""
    position = _HEADER_SIZE
    while position < len(datagram):
        kind, flags = struct.unpack_from("BB", datagram, position)
        (size,) = struct.unpack_from("<H" if flags & _LITTLE_ENDIAN else ">H", datagram, position + 2)
        size = size or len(datagram) - position - 4  # 0: to the end
        yield kind, flags, position + 4, datagram[position + 4 : position + 4 + size]
        position += 4 + size


def _port(flags: int, body: bytes) -> int | None:
    """Of a DATA submessage of discovery."""
    (offset,) = struct.unpack_from("<H", body, 2)
    position = 4 + offset
    if flags & _INLINE_QOS:
        *_, (_, position, size) = _parameters(body, position)
        position += size
    if body[position : position + 2] != _PARAMETERS_LITTLE_ENDIAN:
        return None
    for key, begin, _ in _parameters(body, position + 4):
        if key == _DISCOVERY_LOCATOR:
            port: int = struct.unpack_from("<I", body, begin + 4)[0]
            return port if 0 < port < 1 << 16 else None
    return None


def _parameters(body: bytes, position: int) -> Iterator[tuple[int, int, int]]:
    """Key, place and size of every value, up to the sentinel, which is the last."""
    key = None
    while key != _SENTINEL:
        key, size = struct.unpack_from("<HH", body, position)
        yield key, position + 4, size if key != _SENTINEL else 0
        position += 4 + size


def announcement_message(prefix: bytes, port: int, lease: int) -> bytes:
    """The message by which a participant without endpoints announces itself, with its port of the loopback address."""
    locator = struct.pack("<iI12x4s", _UDP_V4, port, socket.inet_aton(LOOPBACK))
    values = {
        _PROTOCOL_VERSION: _HEADER[4:6] + bytes(2),
        _VENDOR: _HEADER[6:8] + bytes(2),
        _GUID: prefix + _PARTICIPANT,
        _LEASE: struct.pack("<iI", lease, 0),
        _DISCOVERY_LOCATOR: locator,
        _DEFAULT_LOCATOR: locator,
        _BUILTIN_ENDPOINTS: struct.pack("<I", _ANNOUNCER_AND_DETECTOR),
        _SENTINEL: b"",
    }
    parameters = b"".join(struct.pack("<HH", key, len(value)) + value for key, value in values.items())
    body = struct.pack("<HH4s4siI", 0, 16, bytes(4), _PARTICIPANT_WRITER, 0, 1) + _PARAMETERS_LITTLE_ENDIAN
    body += bytes(2) + parameters
    return _HEADER + prefix + struct.pack("<BBH", _DATA, _LITTLE_ENDIAN | _WITH_DATA, len(body)) + body


def disposal_message(prefix: bytes, number: int = _LATE) -> bytes:
    """The message by which the participant with this GUID prefix (12 bytes) removes itself from the network."""
    parameters = (
        struct.pack("<HH", _KEY_HASH, 16)
        + prefix
        + _PARTICIPANT
        + struct.pack("<HH", _STATUS_INFO, 4)
        + _DISPOSED_UNREGISTERED
        + struct.pack("<HH", _SENTINEL, 0)
    )
    # Extra flags, octets to the inline QoS, any reader, the writer, its sequence number (high, low).
    body = struct.pack("<HH4s4siI", 0, 16, bytes(4), _PARTICIPANT_WRITER, 0, number) + parameters
    return _HEADER + prefix + struct.pack("<BBH", _DATA, _LITTLE_ENDIAN | _INLINE_QOS, len(body)) + body


def remove_participant(prefix: bytes, domain: int, *, repeats: int = 3) -> None:
    """Tell every participant on the hosts of the run that one has gone; on other machines its lease has to end."""
    addresses = {LOOPBACK, *os.environ.get(PEERS_VARIABLE, "").split()}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for repeat in range(repeats):  # datagrams may be lost
            message = disposal_message(prefix, _LATE + repeat)
            for place in product(addresses, discovery_ports(domain)):
                with contextlib.suppress(OSError):  # no participant there
                    sender.sendto(message, place)


def require_loopback() -> None:
    """InputError unless messages over UDP arrive: the processes of a run exchange all theirs so."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        try:
            receiver.bind((LOOPBACK, 0))
            _exchange(receiver, LOOPBACK)
        except OSError as error:
            raise InputError(
                f"{LOOPBACK}: no message arrives ({error.strerror or error}): processes cannot find each other: set "
                "the interface up (`ip link set lo up`), or let UDP pass the firewall"
            ) from error


def loopback_has_multicast() -> bool:
    """Whether multicast messages arrive at processes of this machine over its loopback interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        try:
            receiver.bind(("", 0))
            membership = socket.inet_aton(GROUP) + socket.inet_aton(LOOPBACK)
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            _exchange(receiver, GROUP)
        except OSError:
            return False
    return True


def _exchange(receiver: socket.socket, address: str) -> None:
    """Send a message over loopback, and receive it; OSError: that was not possible."""
    receiver.settimeout(LOOPBACK_TIMEOUT)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LOOPBACK))
        sender.sendto(WORD, (address, receiver.getsockname()[1]))
        while receiver.recv(len(WORD) + 1) != WORD:  # of somebody else
            pass


def announce_here(datagram: bytes, domain: int) -> None:
    """Send an announcement to the participants on this machine that receive a domain's group at an interface."""
    # One of Cyclone DDS has no number by default, and discovers others only there.
    for index, name in socket.if_nameindex():
        if name in LOOPBACK_INTERFACES:  # the processes of the run receive the group there, and would all answer
            continue
        with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, struct.pack("4s4si", b"", b"", index))
            sender.sendto(datagram, (GROUP, multicast_port(domain)))  # an interface without address has no route
