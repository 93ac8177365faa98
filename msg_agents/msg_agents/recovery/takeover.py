"""Takeover of a node: the new process removes its killed predecessor from the network at once.

The middleware drops a killed process only after 20 s of silence (its lease); until then writers keep what it never
acknowledged, and block after 5,000 messages. A shorter lease would also drop processes that are only stopped or
starved, and lose messages to them. The successor knows that the process is gone: it holds a lock that ends with the
process that held it. So it sends, in the name of the dead process, the RTPS message by which a participant disposes of
itself (DDSI-RTPS 2.3, 8.5.3 and 9.6.3.9).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
from collections.abc import Iterable
from itertools import product
from pathlib import Path

from msg_agents.processes.environment import MOST_PARTICIPANTS, PEERS_VARIABLE
from msg_agents.processes.ros_domain import PORT_BASE, PORTS_PER_DOMAIN
from msg_analysis.errors import InputError

PREFIX_SIZE = 12  # bytes of a GUID that all endpoints of a participant share
_HEADER = b"RTPS\x02\x03\x01\x0f"  # version 2.3, vendor eProsima, as of a Fast DDS participant
_DATA, _LITTLE_ENDIAN, _INLINE_QOS = 0x15, 0x01, 0x02
_PARTICIPANT, _PARTICIPANT_WRITER = b"\x00\x00\x01\xc1", b"\x00\x01\x00\xc2"
_KEY_HASH, _STATUS_INFO, _SENTINEL = 0x70, 0x71, 0x01
_DISPOSED_UNREGISTERED = b"\x00\x00\x00\x03"
_LATE = 1 << 30  # sequence number: higher than that of any announcement that the participant made itself
_REPEATS = 3  # datagrams may be lost


class Takeover:
    """The right to run a node, which one process has at a time: a lock on the file ``path``, created if missing.

    ``predecessor``: GUID prefix of the last process; empty if there was none. InputError: another process has the lock.
    """

    def __init__(self, path: Path) -> None:
        # Open, and locked, for as long as this process lives.
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"--checkpoint: another process is running {path.stem}: end that process, or give another directory"
            ) from None
        self.predecessor = os.read(self._descriptor, PREFIX_SIZE)

    def store_prefix(self, prefix: bytes) -> None:
        """Store the GUID prefix of this process for its successor."""
        os.pwrite(self._descriptor, prefix, 0)


def take_over(directory: Path | None, names: Iterable[str]) -> list[Takeover]:
    """Get the right to run these nodes, and remove the processes that ran them before from the network.

    ``directory`` has a file per node; None: no takeover. InputError: another process is running one of the nodes.
    """
    if directory is None:
        return []
    takeovers = [Takeover(directory / f"{name}.participant") for name in names]
    domain = int(os.environ.get("ROS_DOMAIN_ID") or 0)
    for prefix in {t.predecessor for t in takeovers if len(t.predecessor) == PREFIX_SIZE}:
        remove_participant(prefix, domain)
    return takeovers


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


def remove_participant(prefix: bytes, domain: int) -> None:
    """Tell every participant on the hosts of the run that one has gone; on other machines its lease has to end."""
    base = PORT_BASE + PORTS_PER_DOMAIN * domain + 10  # the RTPS rule for the ports of discovery
    addresses = {"127.0.0.1", *os.environ.get(PEERS_VARIABLE, "").split()}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for repeat in range(_REPEATS):
            message = disposal_message(prefix, _LATE + repeat)
            for address, participant in product(addresses, range(MOST_PARTICIPANTS)):
                with contextlib.suppress(OSError):  # no participant there
                    sender.sendto(message, (address, base + 2 * participant))
