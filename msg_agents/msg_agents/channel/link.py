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

"""What one direction between two hosts does to a packet: loss, rate with a finite queue, delay.

Every random number is a function of (seed, pair of hosts, number of the packet): the same seed loses the same packets
of a pair, whatever their times are.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum, auto
from math import inf

from msg_analysis.model.arithmetic.random_streams import Stream, generator, link_number

BLOCK = 256  # packets whose numbers are drawn at once; another value gives other numbers
BITS = 8 / 1e6  # Mbit of a byte


@dataclass(frozen=True, slots=True)
class LossModel:
    """Gilbert-Elliott: two states, good and bad, each with its probability of loss; with equal ones it is independent.

    The state changes after every packet, and begins with its stationary law.
    """

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
        """Share of the packets in the bad state."""
        return self.to_bad / (self.to_bad + self.to_good)

    @property
    def mean(self) -> float:
        """Share of the packets that is lost."""
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


class Fate(Enum):
    """What became of a packet."""

    PASSED = auto()
    LOST = auto()
    DROPPED = auto()  # the queue was full


class Link:
    """One direction between two hosts. Packets keep their order, as on one radio link."""

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

    def carry(self, size: int, now: float) -> tuple[Fate, float]:
        """Take a packet of so many bytes at time ``now`` [s]: what becomes of it, and when it arrives [s]."""
        lost, jitter = self._draw()
        sent = self._send(size, now)
        if sent is None:
            return Fate.DROPPED, now
        if lost:
            return Fate.LOST, now
        settings = self._settings
        self._latest = max(self._latest, sent + settings.delay + settings.jitter * (2 * jitter - 1))
        return Fate.PASSED, self._latest

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
