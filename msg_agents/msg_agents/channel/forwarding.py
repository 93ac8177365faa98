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

"""The loop of the channel: takes packets from the devices of the hosts, and passes each on when its time has come."""

from __future__ import annotations

import heapq
import os
import select
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from msg_agents.channel.counts import ChannelCounts, PairCounts
from msg_agents.channel.link import Fate, Link
from msg_agents.channel.namespaces import device_overflow

LONGEST_PACKET = 1 << 16
AT_ONCE = 32  # packets of one host before the next one has its turn
REPORT_PERIOD = 0.5  # s between two reports
_UDP, _FIRST_GROUP, _LAST_GROUP = 17, 224, 239  # protocol; first bytes of multicast addresses


@dataclass(frozen=True, slots=True)
class Port:
    """A host as the channel sees it."""

    name: str
    address: bytes  # IPv4, 4 bytes
    device: int
    statistics: int


def destinations(packet: bytes, sender: int, places: dict[bytes, int]) -> Sequence[int]:
    """The hosts that a packet is for; ``places``: hosts by address.

    Multicast datagrams are for all others. Not passed on are IPv6, which no process of a run uses, and what the kernel
    itself says on a link: group memberships.
    """
    if len(packet) < 20 or packet[0] >> 4 != 4:
        return ()
    if _FIRST_GROUP <= packet[16] <= _LAST_GROUP:
        return [place for place in places.values() if place != sender] if packet[9] == _UDP else ()
    place = places.get(packet[16:20])
    return () if place is None or place == sender else (place,)


class Forwarder:
    """Carries the packets of all pairs of hosts."""

    def __init__(
        self,
        ports: Sequence[Port],
        links: dict[tuple[int, int], Link],  # by sender and receiver
        is_open: Callable[[int, int], bool],  # whether a link of the active graph joins two hosts
    ) -> None:
        self._ports, self._links, self._is_open = ports, links, is_open
        self._places = {port.address: place for place, port in enumerate(ports)}
        self._pairs = {pair: PairCounts() for pair in links}
        self._waiting: list[tuple[float, int, int, bytes]] = []  # heap: when due, order, receiver, packet
        self._order = 0
        self._late_sum, self._late_most, self._passed = 0.0, 0.0, 0

    def run(self, stop: int, report: Callable[[ChannelCounts], None]) -> None:
        """Forward until a descriptor can be read; ``report`` is called now and then, and at the end."""
        devices = {port.device: place for place, port in enumerate(self._ports)}
        next_report = 0.0
        while True:
            now = time.monotonic()
            if now >= next_report:
                report(self.counts())
                next_report = now + REPORT_PERIOD
            until = min(next_report, self._waiting[0][0] if self._waiting else next_report)
            ready, _, _ = select.select([stop, *devices], [], [], max(0.0, until - now))
            if stop in ready:
                report(self.counts())
                return
            self._pass_due()
            for device in ready:
                self._take(device, devices[device])
                self._pass_due()

    def _take(self, device: int, sender: int) -> None:
        """Take what a host has sent."""
        for _ in range(AT_ONCE):
            try:
                packet = os.read(device, LONGEST_PACKET)
            except BlockingIOError:
                return
            now = time.monotonic()
            for receiver in destinations(packet, sender, self._places):
                self._carry(packet, sender, receiver, now)

    def _carry(self, packet: bytes, sender: int, receiver: int, now: float) -> None:
        counts = self._pairs[sender, receiver]
        counts.sent += 1
        counts.bytes += len(packet)
        link = self._links[sender, receiver]
        if not self._is_open(sender, receiver):
            link.skip()
            counts.cut += 1
            return
        fate, due = link.carry(len(packet), now)
        counts.queued = link.waited
        if fate is Fate.LOST:
            counts.lost += 1
        elif fate is Fate.DROPPED:
            counts.dropped += 1
        elif due <= now and not self._waiting:
            self._pass(receiver, packet, due)
        else:
            self._order += 1
            heapq.heappush(self._waiting, (due, self._order, receiver, packet))

    def _pass_due(self) -> None:
        while self._waiting and self._waiting[0][0] <= time.monotonic():
            due, _, receiver, packet = heapq.heappop(self._waiting)
            self._pass(receiver, packet, due)

    def _pass(self, receiver: int, packet: bytes, due: float) -> None:
        os.write(self._ports[receiver].device, packet)
        late = time.monotonic() - due
        self._late_sum += late
        self._late_most = max(self._late_most, late)
        self._passed += 1

    def counts(self) -> ChannelCounts:
        """What was done so far."""
        names = [port.name for port in self._ports]
        return ChannelCounts(
            {(names[sender], names[receiver]): counts for (sender, receiver), counts in self._pairs.items()},
            sum(device_overflow(port.statistics) for port in self._ports),
            1e3 * self._late_sum / max(self._passed, 1),
            1e3 * self._late_most,
        )
