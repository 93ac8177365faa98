# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What a channel does to packets: loss, rate with a finite queue and delay of each direction, and the forwarder."""

from __future__ import annotations

import heapq
import os
import select
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from enum import Enum, auto
from math import inf
from typing import Any

from msg_analysis.arithmetic.reproducible import Stream, generator, link_number


@dataclass(slots=True)
class PairCounts:
    """Packets from one host to another."""

    sent: int = 0  # packets that the sender gave to the channel
    bytes: int = 0  # of these
    lost: int = 0  # at random
    queued: int = 0  # that waited while others were sent
    dropped: int = 0  # because the queue was full
    cut: int = 0  # because no active link joined the hosts


BLOCK = 256  # packets whose numbers are drawn at once; another value gives other numbers
BITS = 8 / 1e6  # Mbit of a byte


@dataclass(frozen=True, slots=True)
class LossModel:
    """Gilbert-Elliott: two states, each with a probability of loss; they may change after every packet."""

    good: float  # probability that a packet is lost in the good state
    bad: float
    to_bad: float  # probability that the state is bad at the next packet, if it is good now
    to_good: float

    @classmethod
    def bursts(cls, loss: float, length: float) -> LossModel:
        """Gilbert: all packets of the bad state are lost, ``length`` in a row on average, and none of the good one."""
        return cls(0.0, 1.0, loss / (length * (1 - loss)), 1 / length)

    @property
    def stationary_bad(self) -> float:
        """Fraction of the packets in the bad state."""
        return self.to_bad / (self.to_bad + self.to_good)

    @property
    def mean(self) -> float:
        """Fraction of the packets that is lost."""
        return self.good + self.stationary_bad * (self.bad - self.good)

    @property
    def inflation(self) -> float:
        """Variance of the number of losses over that of independent ones, of many packets."""
        if self.good == self.bad or not 0.0 < self.mean < 1.0:
            return 1.0
        bad, persistence = self.stationary_bad, 1.0 - self.to_bad - self.to_good
        covariance = bad * (1.0 - bad) * (self.bad - self.good) ** 2  # of successive packets, over persistence
        return 1.0 + 2.0 * covariance / (self.mean * (1.0 - self.mean)) * persistence / (1.0 - persistence)


NO_LOSS = LossModel(0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Of one direction."""

    loss: LossModel = NO_LOSS
    delay: float = 0.0  # s
    jitter: float = 0.0  # s; the delay is uniform between delay - jitter and delay + jitter
    rate: float = inf  # Mbit/s
    queue: int = 100  # packets that wait for the one that is being sent; those that find it full are dropped


class PacketOutcome(Enum):
    """What became of a packet."""

    PASSED = auto()
    LOST = auto()
    DROPPED = auto()  # the queue was full


class Link:
    """One direction between two hosts. Packets keep their order, as on one radio link."""

    # Every random number is a function of seed, pair of hosts and number of the packet: the same seed loses the same
    # packets of a pair, whatever their times are.
    def __init__(self, settings: LinkSettings, seed: int, sender: int, receiver: int) -> None:
        self._settings, self._seed, self._pair = settings, seed, link_number(receiver, sender)
        self._number = 0  # of the next packet
        self._loss_numbers: list[float] = []  # uniform, of the packets of the block
        self._state_numbers: list[float] = []
        self._jitter_numbers: list[float] = []
        first = generator(seed, Stream.CHANNEL, self._pair, -1).random()
        self._bad = bool(first < settings.loss.stationary_bad)
        self._departures: deque[float] = deque()  # times at which packets have been sent, or will be; ascending
        self._latest = -inf  # when the newest packet arrives
        self.waited = 0  # packets that found another one being sent

    def carry(self, size: int, now: float) -> tuple[PacketOutcome, float]:
        """Take a packet of so many bytes at time ``now`` [s]: what becomes of it, and when it arrives [s]."""
        lost, jitter = self._draw()
        sent = self._send(size, now)
        if sent is None:
            return PacketOutcome.DROPPED, now
        if lost:
            return PacketOutcome.LOST, now
        settings = self._settings
        self._latest = max(self._latest, sent + settings.delay + settings.jitter * (2 * jitter - 1))
        return PacketOutcome.PASSED, self._latest

    def skip(self) -> None:
        """Leave out a packet, which has a number like all others."""
        self._draw()

    def _draw(self) -> tuple[bool, float]:
        """Whether the next packet is lost, and its uniform number for the delay."""
        place = self._number % BLOCK
        if not place:
            numbers = generator(self._seed, Stream.CHANNEL, self._pair, self._number // BLOCK).random((3, BLOCK))
            self._loss_numbers, self._state_numbers, self._jitter_numbers = numbers.tolist()
        self._number += 1
        loss = self._settings.loss
        lost = self._loss_numbers[place] < (loss.bad if self._bad else loss.good)
        change = self._state_numbers[place] < (loss.to_good if self._bad else loss.to_bad)
        self._bad ^= change
        return lost, self._jitter_numbers[place]

    def _send(self, size: int, now: float) -> float | None:
        """When a packet has been sent; None if the queue is full."""
        if self._settings.rate == inf:
            return now
        departures = self._departures
        while departures and departures[0] <= now:
            departures.popleft()
        if len(departures) > self._settings.queue:  # one is being sent, the others wait
            return None
        self.waited += bool(departures)
        sent = (departures[-1] if departures else now) + size * BITS / self._settings.rate
        departures.append(sent)
        return sent


DEVICE = "channel"  # of each host
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
    """The hosts that a packet is for; ``places``: hosts by address. Multicast datagrams are for all others."""
    if len(packet) < 20 or packet[0] >> 4 != 4:  # IPv6, which no process of a run uses
        return ()
    if _FIRST_GROUP <= packet[16] <= _LAST_GROUP:  # else than UDP: group memberships, which the kernel says itself
        return [place for place in places.values() if place != sender] if packet[9] == _UDP else ()
    place = places.get(packet[16:20])
    return () if place is None or place == sender else (place,)


def device_overflow(statistics: int) -> int:
    """Packets that a host's device has dropped, since the channel did not take them in time."""
    os.lseek(statistics, 0, os.SEEK_SET)
    for line in os.read(statistics, 1 << 16).decode().splitlines():
        name, _, numbers = line.partition(":")
        if name.strip() == DEVICE:
            return int(numbers.split()[11])  # of the fields of transmission: bytes, packets, errs, drop
    return 0


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

    def run(self, stop: int, report: Callable[[dict[str, Any]], None]) -> None:
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
        outcome, due = link.carry(len(packet), now)
        counts.queued = link.waited
        if outcome is PacketOutcome.LOST:
            counts.lost += 1
        elif outcome is PacketOutcome.DROPPED:
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

    def counts(self) -> dict[str, Any]:
        """What was done so far, as in the result of a run."""
        names = [port.name for port in self._ports]
        return {
            "pairs": [
                {"sender": names[sender], "receiver": names[receiver]} | asdict(counts)
                for (sender, receiver), counts in self._pairs.items()
            ],
            "overflowed": sum(device_overflow(port.statistics) for port in self._ports),
            "late_ms": {"mean": 1e3 * self._late_sum / max(self._passed, 1), "max": 1e3 * self._late_most},
        }
