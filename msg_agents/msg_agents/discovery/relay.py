# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The discovery relay forwards announcements of the processes of a run on one machine to their partners.

By default every process announces itself to every other, again with every process that it discovers, and then sends it
each endpoint as it is made: messages grow with the third power of the processes. So the profile relayed.xml makes them
announce themselves only at the first participant numbers, one of which is taken here. Joining participants (the user's
tools, for example) are connected to all.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import threading
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Self

from msg_agents.discovery.rtps import (
    FAST_DDS,
    FIRST_RELAYED,
    LOOPBACK,
    PREFIX_SIZE,
    Announcement,
    announce_here,
    announcement_message,
    discovery_port,
    disposal_message,
    read_announcement,
)

REPEAT = 10.0  # s after which an announcement is forwarded again: it was lost, or its lease has ended
FRESH = 10.0  # s for which an announcement is valid; a participant repeats it every 3 s
JOINING_AFTER = 5.0  # s after which a participant with a number of the run that reported nothing counts as joining
PERIOD, LEASE = 3.0, 20  # s between announcements of this program itself, and for which others remember it
HOST = slice(0, 4)  # the part of a prefix that is the same for all participants of a vendor on a machine
MOST_KNOWN = 1000  # participants
LARGEST = 1 << 16  # bytes of a datagram


def report_ready(descriptor: int, name: str, prefix: bytes) -> None:
    """Report to the relay, once, that a process is ready: the name of its first node, and the prefix of its GUIDs."""
    with contextlib.suppress(OSError):  # it has gone, and so has the run
        if prefix:  # without one, it counts as a joining participant
            os.write(descriptor, f"{prefix.hex()} {name}\n".encode())
    os.close(descriptor)


def _pipe(opened: contextlib.ExitStack) -> tuple[int, int]:
    ends = os.pipe()
    for end in ends:
        opened.callback(os.close, end)
    return ends


@dataclass(slots=True)
class _Known:
    announcement: Announcement
    first: float  # when it was first received [s]
    last: float  # when it was last received [s]
    forwarded: float = float("-inf")  # when it was last forwarded [s]


class DiscoveryRelay:
    """A thread that forwards announcements; a context, which takes a port of the joining participants.

    OSError: no port is left, or no descriptor. The options are as the constants of this module.
    """

    def __init__(
        self,
        domain: int,
        *,
        period: float = PERIOD,
        repeat: float = REPEAT,
        fresh: float = FRESH,
        joining_after: float = JOINING_AFTER,
        most_known: int = MOST_KNOWN,
    ) -> None:
        self._domain, self._period, self._repeat, self._fresh = domain, period, repeat, fresh
        self._joining_after, self._most_known = joining_after, most_known
        self._partners: Mapping[str, Collection[str]] = {}
        self._prefixes: dict[str, bytes] = {}  # of processes that are ready, by name
        self._known: dict[bytes, _Known] = {}  # by prefix
        self._own_prefix: bytes | None = None  # once the machine is known
        self._announced = float("-inf")  # when this program last announced itself [s]
        self._thread = threading.Thread(target=self._serve, daemon=True, name="discovery relay")
        self._opened = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as opened:
            self._socket = opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
            self._bind()
            self._reports, self.descriptor = _pipe(opened)  # the latter for ``report_ready``
            self._stop, self._stopped = _pipe(opened)
            self._selector = opened.enter_context(selectors.DefaultSelector())
            for source in (self._socket, self._reports, self._stop):
                self._selector.register(source, selectors.EVENT_READ)
            self._opened = opened.pop_all()
        self._thread.start()
        return self

    def _bind(self) -> None:
        for participant in range(FIRST_RELAYED - 1):
            with contextlib.suppress(OSError):
                self._socket.bind((LOOPBACK, discovery_port(self._domain, participant)))
                return
        self._socket.bind((LOOPBACK, discovery_port(self._domain, FIRST_RELAYED - 1)))

    def connect(self, partners: Mapping[str, Collection[str]]) -> None:
        """From now on, connect these: the names of those that a process exchanges messages with, by its name."""
        self._partners = partners

    def __exit__(self, *_: object) -> None:
        os.write(self._stopped, b".")
        self._thread.join()
        self._opened.close()

    def _serve(self) -> None:
        rest = b""
        while True:
            ready = [key.fileobj for key, _ in self._selector.select(timeout=self._period)]
            if self._stop in ready:
                if self._own_prefix is not None:
                    self._send_to_joining(disposal_message(self._own_prefix))
                return
            if self._socket in ready:
                with contextlib.suppress(OSError):
                    self._receive(self._socket.recv(LARGEST))
            if self._reports in ready:
                *lines, rest = (rest + os.read(self._reports, LARGEST)).split(b"\n")
                for line in lines:
                    self._read_report(line.decode(errors="replace"))
            if time.monotonic() >= self._announced + self._period:
                self._announce()

    def _announce(self) -> None:
        """Make joining participants announce themselves to this program."""
        # A joining participant answers the first announcement of a process, once, and a process that has just been made
        # may not receive it: it would not know the other for 3 s, which is longer than many runs. So they are made to
        # answer this program, a participant without endpoints, which forwards their announcements to every process as
        # soon as that is ready.
        if self._own_prefix is not None:
            self._announced = time.monotonic()
            port = self._socket.getsockname()[1]
            self._send_to_joining(announcement_message(self._own_prefix, port, LEASE))

    def _send_to_joining(self, datagram: bytes) -> None:
        announce_here(datagram, self._domain)
        for participant in range(FIRST_RELAYED):
            with contextlib.suppress(OSError):  # nobody has that number
                self._socket.sendto(datagram, (LOOPBACK, discovery_port(self._domain, participant)))

    def _read_report(self, line: str) -> None:
        prefix, _, name = line.partition(" ")
        with contextlib.suppress(ValueError):
            self._prefixes[name] = bytes.fromhex(prefix)
            if self._prefixes[name] in self._known:
                self._forward(self._known[self._prefixes[name]])

    def _receive(self, datagram: bytes) -> None:
        found = read_announcement(datagram, self._own_prefix)
        if found is None or found.prefix == self._own_prefix:
            return
        if not found.port:
            self._known.pop(found.prefix, None)
            return
        if self._own_prefix is None and self._has_number_of_run(found):
            self._own_prefix = found.prefix[HOST] + os.urandom(PREFIX_SIZE - HOST.stop)
        now = time.monotonic()
        known = self._known.setdefault(found.prefix, _Known(found, now, now))
        known.announcement, known.last = found, now
        if len(self._known) > self._most_known:
            del self._known[min(self._known, key=lambda prefix: self._known[prefix].last)]
        if now >= known.forwarded + self._repeat:
            self._forward(known)

    def _has_number_of_run(self, announcement: Announcement) -> bool:
        """Whether it comes from a Fast DDS participant with a number like those of the run."""
        numbered = announcement.port >= discovery_port(self._domain, FIRST_RELAYED)
        return numbered and announcement.vendor == FAST_DDS

    def _is_joining(self, known: _Known) -> bool:
        """Whether a participant is not of the run: has another number, or is not ready for long."""
        if self._has_number_of_run(known.announcement) and time.monotonic() <= known.first + self._joining_after:
            return False
        return known.announcement.prefix not in self._prefixes.values()

    def _forward(self, known: _Known) -> None:
        """Forward an announcement to its partners, and to a process of the run those of the joining participants."""
        # A participant that receives one announces itself to its sender.
        names = [name for name, prefix in self._prefixes.items() if prefix == known.announcement.prefix]
        if names:
            others = {partner for name in names for partner in self._partners.get(name, ())}
            for joining in self._known.values():
                if self._is_joining(joining) and time.monotonic() < joining.last + self._fresh:
                    self._send(joining, names[0])
        elif self._is_joining(known):
            others = set(self._prefixes)
        else:  # a process of the run that is not ready yet
            return
        known.forwarded = time.monotonic()
        for name in others:
            self._send(known, name)

    def _send(self, known: _Known, name: str) -> None:
        """Send an announcement to the process of this name, if that is there."""
        other = self._known.get(self._prefixes.get(name, b""))
        if other and other is not known and time.monotonic() < other.last + self._fresh:
            with contextlib.suppress(OSError):  # it has just gone
                self._socket.sendto(known.announcement.datagram, (LOOPBACK, other.announcement.port))
