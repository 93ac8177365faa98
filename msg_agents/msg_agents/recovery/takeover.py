"""Who runs a node now, and who did before: the next process takes the dead one off the network at once.

The middleware gives up a process that was killed only when it has been silent for 20 s (its lease). Until then
everybody keeps what it never acknowledged, and after 5,000 messages waits. A shorter lease would take a process for
dead that is only stopped or starved, and what is on its way to it would be lost. But whoever takes over *knows*: it
holds a lock that goes with the process that held it before. So it says on behalf of the dead what that would have said,
had it left in order: the RTPS message by which a participant disposes of itself (DDSI-RTPS 2.3, 8.5.3 and 9.6.3.9).
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
_HEADER = b"RTPS\x02\x03\x01\x0f"  # version 2.3, vendor eProsima: who speaks for a Fast DDS participant
_DATA, _LITTLE_ENDIAN, _INLINE_QOS = 0x15, 0x01, 0x02
_PARTICIPANT, _PARTICIPANT_WRITER = b"\x00\x00\x01\xc1", b"\x00\x01\x00\xc2"
_KEY_HASH, _STATUS_INFO, _SENTINEL = 0x70, 0x71, 0x01
_DISPOSED_UNREGISTERED = b"\x00\x00\x00\x03"
_LATE = 1 << 30  # sequence number: higher than that of any announcement that the participant made itself
_REPEATS = 3  # datagrams may be lost


class Succession:
    """The right to run a node, which one process has at a time.

    Parameters
    ----------
    path
        of a file that names the process; made if there is none

    Attributes
    ----------
    predecessor
        prefix of the GUIDs of the process before; empty if there was none

    Raises
    ------
    InputError
        another process is running the node
    """

    def __init__(self, path: Path) -> None:
        # Open, and locked, for as long as this process lives.
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"--checkpoint: another process is running {path.stem}: end it, or give another directory"
            ) from None
        self.predecessor = os.read(self._descriptor, PREFIX_SIZE)

    def enter(self, prefix: bytes) -> None:
        """Note whom the next process will follow.

        Parameters
        ----------
        prefix
            of the identifiers of this process's endpoints
        """
        os.pwrite(self._descriptor, prefix, 0)


def succeed(directory: Path | None, names: Iterable[str]) -> list[Succession]:
    """The right to run these nodes; processes that ran them before are taken off the network.

    Parameters
    ----------
    directory
        where every node has a file of its name; None: nobody will follow
    names
        of the nodes

    Raises
    ------
    InputError
        another process is running one of the nodes
    """
    if directory is None:
        return []
    successions = [Succession(directory / f"{name}.participant") for name in names]
    domain = int(os.environ.get("ROS_DOMAIN_ID") or 0)
    for prefix in {s.predecessor for s in successions if len(s.predecessor) == PREFIX_SIZE}:
        bury(prefix, domain)
    return successions


def farewell(prefix: bytes, number: int = _LATE) -> bytes:
    """The message by which a participant takes itself off the network.

    Parameters
    ----------
    prefix
        of its GUIDs, 12 bytes
    number
        sequence number of the message
    """
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


def bury(prefix: bytes, domain: int) -> None:
    """Tell every participant of the hosts of the run that one is gone. Other machines wait for its lease to end.

    Parameters
    ----------
    prefix
        of its GUIDs, 12 bytes
    domain
        ROS_DOMAIN_ID
    """
    base = PORT_BASE + PORTS_PER_DOMAIN * domain + 10  # the RTPS rule for the ports of discovery
    addresses = {"127.0.0.1", *os.environ.get(PEERS_VARIABLE, "").split()}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for repeat in range(_REPEATS):
            message = farewell(prefix, _LATE + repeat)
            for address, participant in product(addresses, range(MOST_PARTICIPANTS)):
                with contextlib.suppress(OSError):  # nobody there
                    sender.sendto(message, (address, base + 2 * participant))
