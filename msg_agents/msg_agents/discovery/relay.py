# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Introduces the processes of a run on one machine to each other: those that exchange messages, as soon as they can.

Left to itself, every process announces itself to every other, again with every process that it meets, and then tells
it of each endpoint as it makes them: messages grow with the third power of the processes. So they have a profile
(introduced.xml) by which they announce themselves only to the numbers of visitors, one of which is taken here. When a
process has all its endpoints, its announcement is passed on, as it is, to those that it has to do with, and no other
process of the run ever hears of it. Visitors, such as the user's tools, are introduced to all.
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
from types import TracebackType
from typing import Self

from msg_agents.discovery.profiles import FIRST_RELAYED
from msg_agents.discovery.rtps import (
    FAST_DDS,
    LOOPBACK,
    PREFIX_SIZE,
    Announcement,
    announce_here,
    announcement_message,
    discovery_port,
    disposal_message,
    read_announcement,
)

REPEAT = 10.0  # s after which an announcement is passed on again: it was lost, or a stopped process has been given up
FRESH = 10.0  # s for which an announcement is valid; a participant repeats it every 3 s
PATIENCE = 5.0  # s after which a participant that is not of the run, but has a number like those, is a visitor
PERIOD, LEASE = 3.0, 20  # s between announcements of this program itself, and for which others remember it
HOST = slice(0, 4)  # the part of a prefix that is the same for all participants of a vendor on a machine
MOST_KNOWN = 1000  # participants
LARGEST = 1 << 16  # bytes of a datagram


def report_ready(descriptor: int, name: str, prefix: bytes) -> None:
    """Tell the introducer, once, that a process is ready: the name of its first node, and the prefix of its GUIDs.

    Without a prefix it stays a stranger, who is introduced to all.
    """
    with contextlib.suppress(OSError):  # it has gone, and so has the run
        if prefix:
            os.write(descriptor, f"{prefix.hex()} {name}\n".encode())
    os.close(descriptor)


def _pipe(opened: contextlib.ExitStack) -> tuple[int, int]:
    """A new pipe, which is closed with the others."""
    ends = os.pipe()
    for end in ends:
        opened.callback(os.close, end)
    return ends


@dataclass(slots=True)
class _Known:
    announcement: Announcement
    first: float  # when it was first heard [s]
    heard: float  # when it was last heard [s]
    passed: float = float("-inf")  # when it was last passed on [s]


class DiscoveryRelay:
    """A thread that introduces processes to each other; to be used with ``with``, which takes a port for visitors.

    ``descriptor``: where processes write their introductions (``report_ready``). OSError: no port is left, or no
    descriptor.
    """

    def __init__(self, domain: int) -> None:
        self._domain = domain
        self._partners: Mapping[str, Collection[str]] = {}
        self._prefixes: dict[str, bytes] = {}  # of processes that are ready, by name
        self._known: dict[bytes, _Known] = {}  # by prefix
        self._own_prefix: bytes | None = None  # once the machine is known
        self._announced = float("-inf")  # when this program last announced itself [s]
        self._thread = threading.Thread(target=self._serve, daemon=True, name="introducer")
        self._opened = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as opened:
            self._socket = opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
            self._bind()
            self._reports, self.descriptor = _pipe(opened)
            self._stop, self._stopped = _pipe(opened)
            self._selector = opened.enter_context(selectors.DefaultSelector())
            for source in (self._socket, self._reports, self._stop):
                self._selector.register(source, selectors.EVENT_READ)
            self._opened = opened.pop_all()
        self._thread.start()
        return self

    def _bind(self) -> None:
        for participant in range(FIRST_RELAYED):
            try:
                self._socket.bind((LOOPBACK, discovery_port(self._domain, participant)))
            except OSError:
                if participant == FIRST_RELAYED - 1:
                    raise
            else:
                return

    def introduce(self, partners: Mapping[str, Collection[str]]) -> None:
        """From now on, introduce these: the names of those that a process exchanges messages with, by its name."""
        self._partners = partners

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.write(self._stopped, b".")
        self._thread.join()
        self._opened.close()

    def _serve(self) -> None:
        rest = b""
        while True:
            ready = [key.fileobj for key, _ in self._selector.select(timeout=PERIOD)]
            if self._stop in ready:
                self._leave()
                return
            if self._socket in ready:
                with contextlib.suppress(OSError):
                    self._hear(self._socket.recv(LARGEST))
            if self._reports in ready:
                *lines, rest = (rest + os.read(self._reports, LARGEST)).split(b"\n")
                for line in lines:
                    self._read_report(line.decode(errors="replace"))
            if time.monotonic() >= self._announced + PERIOD:
                self._announce()

    def _announce(self) -> None:
        """Make visitors announce themselves to this program."""
        # A visitor answers the first announcement of a process, once, and a process that has just been made may not
        # hear it: it would not know the visitor for 3 s, which is longer than many runs. So they are made to answer
        # this program, a participant without endpoints, which tells every process of them as soon as that is ready.
        if self._own_prefix is not None:
            self._announced = time.monotonic()
            port = self._socket.getsockname()[1]
            message = announcement_message(self._own_prefix, port, LEASE)
            self._tell_visitors(message)
            announce_here(message, self._domain)

    def _leave(self) -> None:
        if self._own_prefix is not None:
            message = disposal_message(self._own_prefix)
            self._tell_visitors(message)
            announce_here(message, self._domain)

    def _tell_visitors(self, datagram: bytes) -> None:
        for participant in range(FIRST_RELAYED):
            with contextlib.suppress(OSError):  # nobody has that number
                self._socket.sendto(datagram, (LOOPBACK, discovery_port(self._domain, participant)))

    def _read_report(self, line: str) -> None:
        prefix, _, name = line.partition(" ")
        with contextlib.suppress(ValueError):
            self._prefixes[name] = bytes.fromhex(prefix)
            if self._prefixes[name] in self._known:
                self._pass_on(self._known[self._prefixes[name]])

    def _hear(self, datagram: bytes) -> None:
        heard = read_announcement(datagram, self._own_prefix)
        if heard is None:
            return
        if not heard.port:
            self._known.pop(heard.prefix, None)
            return
        if heard.prefix == self._own_prefix:
            return
        if self._own_prefix is None and self._has_number_of_run(heard):
            self._own_prefix = heard.prefix[HOST] + os.urandom(PREFIX_SIZE - HOST.stop)
        now = time.monotonic()
        known = self._known.setdefault(heard.prefix, _Known(heard, now, now))
        known.announcement, known.heard = heard, now
        if len(self._known) > MOST_KNOWN:
            del self._known[min(self._known, key=lambda prefix: self._known[prefix].heard)]
        if now >= known.passed + REPEAT:
            self._pass_on(known)

    def _has_number_of_run(self, announcement: Announcement) -> bool:
        """Whether it comes from a Fast DDS participant with a number like those of the run."""
        numbered = announcement.port >= discovery_port(self._domain, FIRST_RELAYED)
        return numbered and announcement.vendor == FAST_DDS

    def _visits(self, known: _Known) -> bool:
        """Whether a participant is not of the run: has another number, or is not ready for long."""
        if self._has_number_of_run(known.announcement) and time.monotonic() <= known.first + PATIENCE:
            return False
        return known.announcement.prefix not in self._prefixes.values()

    def _pass_on(self, known: _Known) -> None:
        """Pass an announcement on to those that should know it, and to a process of the run those of the visitors.

        Whoever hears one announces itself to its sender.
        """
        names = [name for name, prefix in self._prefixes.items() if prefix == known.announcement.prefix]
        if names:
            others = {partner for name in names for partner in self._partners.get(name, ())}
            for visitor in self._known.values():
                if self._visits(visitor) and time.monotonic() < visitor.heard + FRESH:
                    self._send(visitor, names[0])
        elif self._visits(known):
            others = set(self._prefixes)
        else:  # a process of the run that is not ready yet
            return
        known.passed = time.monotonic()
        for name in others:
            self._send(known, name)

    def _send(self, known: _Known, name: str) -> None:
        """Send an announcement to the process of this name, if that is there."""
        other = self._known.get(self._prefixes.get(name, b""))
        if other and other is not known and time.monotonic() < other.heard + FRESH:
            with contextlib.suppress(OSError):  # it has just gone
                self._socket.sendto(known.announcement.datagram, (LOOPBACK, other.announcement.port))
