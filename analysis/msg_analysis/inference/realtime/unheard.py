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

"""Messages of a run in real time that their receivers did not hear in time, link by link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.common.large_arrays import column
from msg_analysis.common.text.number_words import percent
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.inference.statistics.distributions import binomial_interval
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.types import FloatArray, IntArray

SHOWN_LINKS = 20
LEAST_EXCESS = 0.01  # smallest difference of shares that is put into words: a busy machine has a few late messages


@dataclass(frozen=True, slots=True)
class UnheardMessages:
    """By directed link.

    A message is judged at the first step of its receiver after it was published and at the next one, if the link is
    active in both and no newer message was published before the first: it was heard in time if one of them used it.
    With timers that keep their periods, and messages faster than a period, those that were not are the lost ones.
    """

    links: IntArray  # (L, 2) receiver and sender
    messages: IntArray  # (L,) that could be judged
    unheard: IntArray  # (L,) of these
    probability: FloatArray  # (L,) that the experiment loses a message
    inflation: float  # variance of the number of losses over that of independent ones (bursts)

    @property
    def expected(self) -> FloatArray:
        """(L,): messages that the experiment loses."""
        return self.messages * self.probability

    def share(self, which: Any = slice(None)) -> tuple[float, tuple[float, float], float]:
        """Share of some links' messages, its 95 % interval, and what the experiment loses; 0 where there was none."""
        messages, unheard = int(self.messages[which].sum()), int(self.unheard[which].sum())
        if not messages:
            return 0.0, (0.0, 1.0), 0.0
        interval = binomial_interval(round(unheard / self.inflation), max(round(messages / self.inflation), 1))
        return unheard / messages, interval, float(self.expected[which].sum()) / messages

    def words(self) -> str | None:
        """What differs from the experiment, without a full stop; None where nothing does."""
        share, (low, high), expected = self.share()
        if low <= expected <= high or abs(share - expected) < LEAST_EXCESS:
            return None
        text = (
            f"{percent(share)} ({100 * low:.3g} to {100 * high:.3g} %) of the messages between agents were not heard "
            f"in time, while the experiment loses {percent(expected)}: "
        )
        text += "the network lost them or was late" if share > expected else "the experiment's losses were not made"
        place = int(self._order[0])
        worst = self.share(place)[0]
        receiver, sender = (self.links[place] + 1).tolist()
        return f"{text}; most different: {percent(worst)} of those from agent {sender} to agent {receiver}"

    def to_json(self) -> dict[str, Any]:
        """The JSON document: all links together, and those that differ most from the experiment."""
        share, interval, expected = self.share()
        rows = []
        for place in self._order[:SHOWN_LINKS].tolist():
            found, around, should = self.share(place)
            receiver, sender = self.links[place].tolist()
            row = {"sender": sender + 1, "receiver": receiver + 1, "messages": int(self.messages[place])}
            row |= {"unheard": int(self.unheard[place]), "share": found, "interval": list(around), "expected": should}
            rows.append(row)
        return {
            "messages": int(self.messages.sum()),
            "unheard": int(self.unheard.sum()),
            "share": share,
            "interval": list(interval),
            "expected": expected,
            "words": self.words(),
            "links": rows,
        }

    @property
    def _order(self) -> IntArray:
        """(L,): places of the links, those first that differ most, in standard errors."""
        spread = np.sqrt(np.maximum(self.expected * (1.0 - self.probability), 1.0))
        return np.argsort(-np.abs(self.unheard - self.expected) / spread, kind="stable")


def unheard_messages(observation: Observation) -> UnheardMessages:
    """Judge the messages of a run in real time, see ``UnheardMessages``; with a delay, so many steps later."""
    timers, step = observation.timers, observation.step
    assert timers is not None
    tables = neighbour_tables(step)
    links = np.argwhere(step.listens())
    messages, unheard = np.zeros(len(links), np.int64), np.zeros(len(links), np.int64)
    late = step.delay
    steps = len(timers.graphs) - 1 - late  # that can be the first one after a message was published
    for receiver in np.unique(links[:, 0]).tolist() if steps >= 1 else ():
        graphs, made = column(timers.graphs, receiver), column(timers.made, receiver)
        there = np.arange(step.most_neighbours) < tables.count[graphs, receiver][:, None]
        senders, heard = tables.senders[graphs, receiver], column(timers.used, receiver)
        for number in np.flatnonzero(links[:, 0] == receiver).tolist():
            sender = int(links[number, 1])
            chosen = there & (senders == sender)  # (N, D): at most one of a step
            active = chosen.any(axis=1)
            used = np.where(chosen, heard, -1).max(axis=1, initial=-1)
            first, second = used[late : late + steps], used[late + 1 : late + 1 + steps]
            newest = np.searchsorted(column(timers.made, sender), made[1 : steps + 1], side="left") - 1
            newest = np.maximum(newest, first)  # of equal times, a value comes before the steps that use it
            judged = active[late : late + steps] & active[late + 1 : late + 1 + steps]
            judged &= np.diff(newest, prepend=newest[0]) > 0
            judged[: observation.sure_messages] = False
            messages[number] = judged.sum()
            unheard[number] = (judged & (first != newest) & (second != newest)).sum()
    probability = step.losses[links[:, 0], links[:, 1]] if step.loss else np.zeros(len(links))
    persistence = 0.0
    if step.burst is not None and probability.any():
        chance = float(probability.max())
        persistence = 1.0 - 1.0 / step.burst - chance / (step.burst * (1.0 - chance))
    inflation = (1.0 + persistence) / (1.0 - persistence)
    return UnheardMessages(links, messages, unheard, np.asarray(probability), inflation)
