# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The little of RTPS messages that is read and written here, and its ports (DDSI-RTPS 2.3, 8.3, 8.5.3, 9.4 to 9.6)."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

from msg_agents.discovery.profiles import FIRST_INTRODUCED, MOST_INTRODUCED
from msg_agents.discovery.ros_domain import PORT_BASE, PORTS_PER_DOMAIN

PREFIX_SIZE = 12  # bytes of a GUID that all endpoints of a participant share
PEERS_VARIABLE = "MSG_AGENTS_PEERS"  # addresses of the hosts, in a run on several
LOOPBACK = "127.0.0.1"
GROUP = "239.255.0.1"  # of announcements by multicast (9.6.1.4)
_MAGIC, _HEADER_SIZE = b"RTPS", 20
FAST_DDS = b"\x01\x0f"  # the vendor (8.3.3.1.3)
_HEADER = _MAGIC + b"\x02\x03" + FAST_DDS  # version 2.3
_DATA, _TO_ONE = 0x15, 0x0E  # submessages
_ANYBODY = bytes(PREFIX_SIZE)  # as the addressee: all that hear it (8.3.7.6)
_LITTLE_ENDIAN, _INLINE_QOS, _WITH_DATA = 0x01, 0x02, 0x04  # flags
_PARTICIPANT, _PARTICIPANT_WRITER = b"\x00\x00\x01\xc1", b"\x00\x01\x00\xc2"
_KEY_HASH, _STATUS_INFO, _SENTINEL, _DISCOVERY_LOCATOR = 0x70, 0x71, 0x01, 0x32
_PARAMETERS_LITTLE_ENDIAN = b"\x00\x03"
_DISPOSED_UNREGISTERED = b"\x00\x00\x00\x03"
_PROTOCOL_VERSION, _VENDOR, _LEASE, _GUID, _DEFAULT_LOCATOR, _BUILTIN_ENDPOINTS = 0x15, 0x16, 0x02, 0x50, 0x31, 0x58
_UDP_V4, _ANNOUNCER_AND_DETECTOR = 1, 0x03
_LATE = 1 << 30  # sequence number: higher than that of any announcement that the participant made itself


def discovery_port(domain: int, participant: int) -> int:
    """Port at which a participant of this number hears announcements (9.6.1.1)."""
    return PORT_BASE + PORTS_PER_DOMAIN * domain + 10 + 2 * participant


def multicast_port(domain: int) -> int:
    """Port of the group at which all participants of a domain hear announcements (9.6.1.1)."""
    return PORT_BASE + PORTS_PER_DOMAIN * domain


def discovery_ports(domain: int) -> range:
    """Those of all participants that there can be; the last domain has fewer."""
    first, end = discovery_port(domain, 0), discovery_port(domain, FIRST_INTRODUCED + MOST_INTRODUCED)
    return range(first, min(end, 1 << 16), 2)


@dataclass(frozen=True, slots=True)
class Announcement:
    """What a participant says of itself to those that do not know it yet."""

    prefix: bytes  # of its GUID
    port: int  # at which it hears announcements; 0: it leaves
    datagram: bytes

    @property
    def vendor(self) -> bytes:
        """The number of who made the middleware."""
        return self.datagram[6:8]


def read_announcement(datagram: bytes, reader: bytes | None = None) -> Announcement | None:
    """The announcement in a datagram; None if there is none, or it is addressed to another one than the reader.

    ``reader``: prefix of its GUID; what is addressed to it becomes an announcement to everybody.
    """
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
    """The message by which a participant without endpoints announces itself.

    ``prefix``: of its GUID, 12 bytes. ``port``: of the loopback address, at which it hears others. ``lease``: time [s]
    without a message after which others forget it.
    """
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
    body = (
        struct.pack("<HH4s4siI", 0, 16, bytes(4), _PARTICIPANT_WRITER, number >> 32, number & 0xFFFFFFFF) + parameters
    )
    return _HEADER + prefix + struct.pack("<BBH", _DATA, _LITTLE_ENDIAN | _INLINE_QOS, len(body)) + body


def remove_participant(prefix: bytes, domain: int, *, repeats: int = 3) -> None:
    """Tell every participant on the hosts of the run that one has gone; on other machines its lease has to end.

    ``repeats``: how often, since datagrams may be lost.
    """
    addresses = {LOOPBACK, *os.environ.get(PEERS_VARIABLE, "").split()}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for repeat in range(repeats):
            message = disposal_message(prefix, _LATE + repeat)
            for place in product(addresses, discovery_ports(domain)):
                with contextlib.suppress(OSError):  # no participant there
                    sender.sendto(message, place)
