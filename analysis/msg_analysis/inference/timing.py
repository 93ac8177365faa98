# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Timing of steps in real time, with exact quantiles."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.arithmetic.reproducible import StepClock
from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray, column
from msg_analysis.common.text import percent
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.statistics import binomial_interval
from msg_analysis.model.reception import MessagesUsed, ideal_uses, neighbour_tables
from msg_analysis.model.step_model import phases

AT_ONCE = 2**21  # numbers that are sorted together
QUANTILE_BINS = 2**14

Pieces = Callable[[], Iterable[AnyArray]]
"""Gives the numbers from the beginning, in pieces of any size; the same ones each time."""


def extent(pieces: Pieces) -> tuple[int, float, float]:
    """How many numbers there are, the smallest one and the largest one (infinite where there are none)."""
    count, low, high = 0, np.inf, -np.inf
    for piece in pieces():
        if piece.size:
            count, low, high = count + piece.size, min(low, float(piece.min())), max(high, float(piece.max()))
    return count, low, high


def quantiles(
    pieces: Pieces, shares: Sequence[float], *, at_once: int = AT_ONCE, bins: int = QUANTILE_BINS
) -> list[float]:
    """Quantiles of all numbers, between neighbours linearly: as ``numpy.quantile``; empty where there are none."""
    count, low, high = extent(pieces)
    if not count:
        return []
    place = np.array(shares) * (count - 1)
    below = np.floor(place).astype(np.int64)
    ranks = np.unique(np.concatenate([below, np.minimum(below + 1, count - 1)]))
    found = dict(zip(ranks.tolist(), _of_ranks(pieces, ranks, count, low, high, at_once, bins).tolist(), strict=True))
    values = []
    for rank, part in zip(below.tolist(), (place - below).tolist(), strict=True):
        one, next_one = found[rank], found[min(rank + 1, count - 1)]
        values.append(one + (next_one - one) * part if part < 0.5 else next_one - (next_one - one) * (1.0 - part))
    return values


def _of_ranks(
    pieces: Pieces, ranks: IntArray, count: int, low: float, high: float, at_once: int, bins: int
) -> FloatArray:
    """The numbers with these ranks, from 0, of ``count`` numbers from ``low`` to ``high``."""
    if low == high:
        return np.full(len(ranks), low)
    if count <= at_once:
        return np.sort(np.concatenate([np.ravel(piece) for piece in pieces()]).astype(np.float64))[ranks]

    def bin_of(piece: AnyArray) -> IntArray:
        return np.minimum((np.ravel(piece) - low) * (bins / (high - low)), bins - 1).astype(np.int64)

    counts = sum((np.bincount(bin_of(piece), minlength=bins) for piece in pieces()), np.zeros(bins, np.int64))
    ends = np.cumsum(counts)
    chosen = np.searchsorted(ends, ranks, side="right")
    found = np.empty(len(ranks))
    for one in np.unique(chosen).tolist():

        def inside(one: int = one) -> Iterable[AnyArray]:
            return (np.ravel(piece)[bin_of(piece) == one] for piece in pieces())

        wanted = chosen == one
        found[wanted] = _of_ranks(inside, ranks[wanted] - (ends[one] - counts[one]), *extent(inside), at_once, bins)
    return found


BINS = 60


def shown_quantiles(pieces: Pieces) -> dict[str, float | None]:
    """Some of all numbers; None where there are none."""
    names, shares = ("p50", "p95", "p99", "max"), (0.5, 0.95, 0.99, 1.0)
    found = quantiles(pieces, shares)
    return dict(zip(names, found, strict=True)) if found else dict.fromkeys(names)


@dataclass(frozen=True, slots=True, eq=False)
class Timing:
    """Timing of a run in real time, in ms of the agents' clock: simulated time over the speed of the run."""

    period_ms: float  # nominal time between two steps of an agent
    lateness_ms: dict[str, float | None]  # of a step after it was due
    steps: int  # of all agents
    missed: int  # steps made more than a period after they were due
    jitter_ms: dict[str, float | None]  # |time between two successive steps of an agent - period|
    staleness_ms: dict[str, float | None]  # age of the values at the time of use
    staleness_steps: dict[str, float | None]  # step of the new state - step of the value; 0 or 1 with ideal timers
    uses: int  # neighbours' values that steps needed, those never received or lost included
    ideal_uses: int  # uses of the value that ideal timers would have used, the own one for a lost one included
    never_received: int  # uses in which nothing had been received yet of the neighbour
    lost_messages: LostMessages
    outdated_graphs: int  # steps made with another graph than the network's at that time
    histogram: tuple[FloatArray, AnyArray]  # of lateness: edges [ms] (BINS + 1,) and counts (BINS,); covers all values
    ages: tuple[FloatArray, AnyArray]  # the same of ``staleness_ms``

    @property
    def missed_share(self) -> float:
        """Of all steps."""
        return self.missed / max(self.steps, 1)

    @property
    def ideal_share(self) -> float:
        """Of all uses, those that ideal timers would have made; 1 where no agent receives another."""
        return self.ideal_uses / self.uses if self.uses else 1.0

    @property
    def outdated_share(self) -> float:
        """Of all steps, those with another graph than the network's."""
        return self.outdated_graphs / max(self.steps, 1)

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        (edges, counts), (age_edges, age_counts) = self.histogram, self.ages
        return {
            "period_ms": self.period_ms,
            "lateness_ms": self.lateness_ms,
            "deadlines": {"steps": self.steps, "missed": self.missed, "share": self.missed_share},
            "jitter_ms": self.jitter_ms,
            "staleness_ms": self.staleness_ms,
            "staleness_steps": self.staleness_steps,
            "ideal_uses": {"uses": self.uses, "ideal": self.ideal_uses, "share": self.ideal_share},
            "never_received": self.never_received,
            "lost_messages": self.lost_messages,
            "outdated_graph": {"steps": self.outdated_graphs, "share": self.outdated_share},
            "histogram": {"lateness_ms": edges, "steps": counts, "staleness_ms": age_edges, "uses": age_counts},
        }


def measure_timing(observation: Observation) -> Timing:
    """Measure the timing of a run in real time, in passes over blocks of steps."""
    log = _TimingLog(observation)
    counts = np.zeros(5, dtype=np.int64)
    for first, last in log.blocks():
        counts += log.counts(first, last)
    missed, uses, ideal_uses, never_received, outdated = counts.tolist()
    steps, m = observation.steps, observation.step.agents
    return Timing(
        period_ms=log.period * log.milliseconds,
        lateness_ms=shown_quantiles(log.pieces(log.lateness)),
        steps=steps * m,
        missed=missed,
        jitter_ms=shown_quantiles(log.pieces(log.jitter)),
        staleness_ms=shown_quantiles(log.pieces(log.ages)),
        staleness_steps=shown_quantiles(log.pieces(log.ages_in_steps)),
        uses=uses,
        ideal_uses=ideal_uses,
        never_received=never_received,
        lost_messages=lost_messages(observation),
        outdated_graphs=outdated,
        histogram=_histogram(log.pieces(log.lateness)),
        ages=_histogram(log.pieces(log.ages)),
    )


class _TimingLog:
    """What blocks of steps say about timing, times in ms of the agents' clock."""

    def __init__(self, observation: Observation) -> None:
        self._observation, self._timers, self._step = observation, observation.timed, observation.step
        experiment = observation.prediction.experiment
        self.milliseconds = 1e-6 / experiment.run.speed  # of the agents' clock, in a nanosecond of simulated time
        self.period = observation.step.dt * 1e9
        phase = phases(experiment)
        self._clocks = [StepClock(observation.step.dt, phi) for phi in phase.tolist()]
        self._tables = neighbour_tables(observation.step)
        # Which messages are lost is in the seed; else steps from the step to what ideal timers use.
        self._messages = MessagesUsed(experiment, observation.step) if experiment.noise.on_messages else None
        self._ideal_uses = None if self._messages else ideal_uses(observation.step, phase)

    def blocks(self) -> Iterator[tuple[int, int]]:
        """Blocks of steps."""
        return self._observation.blocks(8 * self._timers.used[:1].size, "timing")

    def pieces(self, measure: Callable[[int, int], AnyArray]) -> Pieces:
        """A measure of all steps."""
        return lambda: (measure(first, last) for first, last in self.blocks())

    def lateness(self, first: int, last: int) -> FloatArray:
        """Of the steps first..last-1, (b, m)."""
        return np.asarray(self._late(first, last) * self.milliseconds)

    def jitter(self, first: int, last: int) -> FloatArray:
        """The same of the time since the step before."""
        made = self._timers.made[max(first, 1) : last + 1]
        return np.asarray(np.abs(np.diff(made, axis=0) - self.period) * self.milliseconds)

    def ages(self, first: int, last: int) -> FloatArray:
        """(uses,) of the values that were used."""
        received, senders, used = self._received(first, last)
        made = self._timers.made
        age = made[first + 1 : last + 1, :, None] - made[used, senders]
        return np.asarray(age[received] * self.milliseconds)

    def ages_in_steps(self, first: int, last: int) -> IntArray:
        """The same in steps."""
        received, _, used = self._received(first, last)
        return np.asarray((np.arange(first + 1, last + 1)[:, None, None] - used)[received])

    def counts(self, first: int, last: int) -> IntArray:
        """Missed deadlines, uses, those of ideal timers, of what never arrived, steps with an outdated graph."""
        used, graphs, modes = self._timers.used[first:last], self._timers.graphs[first:last], self._observation.modes
        there, ideal = self._there(graphs), self._ideal(first, last)
        never = there & (used < 0) & (ideal >= 0)
        outdated = graphs != modes[first:last, None]
        missed = self._late(first, last) > self.period
        return np.array([each.sum() for each in (missed, there, there & (used == ideal), never, outdated)])

    def _late(self, first: int, last: int) -> IntArray:
        steps = np.arange(first, last)
        due = np.stack([clock.times(steps) for clock in self._clocks], axis=1)
        return np.asarray(self._timers.made[first + 1 : last + 1] - due)

    def _there(self, graphs: IntArray) -> BoolArray:
        """(b, m, D): which neighbours there are."""
        count = self._tables.count[graphs, np.arange(self._step.agents)]
        return np.asarray(np.arange(self._step.most_neighbours) < count[:, :, None])

    def _received(self, first: int, last: int) -> tuple[BoolArray, IntArray, IntArray]:
        """(b, m, D) each: of which neighbours a value was used, the neighbours, and the steps of the values."""
        used, graphs = self._timers.used[first:last], self._timers.graphs[first:last]
        senders = self._tables.senders[graphs, np.arange(self._step.agents)]
        return self._there(graphs) & (used >= 0), senders, used

    def _ideal(self, first: int, last: int) -> IntArray:
        """(b, m, D) steps of the values that ideal timers would have used; -1: the own value, -2: not known."""
        graphs, modes = self._timers.graphs[first:last], self._observation.modes[first:last]
        if self._messages is None:
            assert self._ideal_uses is not None
            steps = np.arange(first, last)[:, None, None]
            return np.asarray(self._ideal_uses[graphs, np.arange(self._step.agents)] + steps)
        # Under another graph than the network's the neighbours are others.
        used = self._messages.used(first, modes)
        return np.where((graphs == modes[:, None])[:, :, None], used, -2)


def _histogram(values: Pieces) -> tuple[FloatArray, AnyArray]:
    _, low, high = extent(values)
    ends = min(0.0, low), max(high, 1e-3)
    counts = sum((np.histogram(piece, BINS, ends)[0] for piece in values()), np.zeros(BINS, np.int64))
    return np.histogram_bin_edges(np.empty(0), BINS, ends), counts


SHOWN_LINKS = 20
LEAST_EXCESS = 0.01  # smallest difference of shares that is put into words: a busy machine has a few late messages


@dataclass(frozen=True, slots=True)
class LostMessages:
    """By directed link.

    A message counts at the first step of its receiver after it was published and at the next one, if the link is
    active in both and no newer message was published before the first: it was received in time if one of them used it.
    With timers that keep their periods, and messages faster than a period, those that were not are the lost ones.
    """

    links: IntArray  # (L, 2) receiver and sender
    messages: IntArray  # (L,) that could be decided
    lost: IntArray  # (L,) of these
    probability: FloatArray  # (L,) that the experiment loses a message
    inflation: float  # variance of the number of losses over that of independent ones (bursts)

    @property
    def expected(self) -> FloatArray:
        """(L,): messages that the experiment loses."""
        return self.messages * self.probability

    def share(self, which: Any = slice(None)) -> tuple[float, tuple[float, float], float]:
        """Share of some links' messages, its 95 % interval, and what the experiment loses; 0 where there was none."""
        messages, lost = int(self.messages[which].sum()), int(self.lost[which].sum())
        if not messages:
            return 0.0, (0.0, 1.0), 0.0
        interval = binomial_interval(round(lost / self.inflation), max(round(messages / self.inflation), 1))
        return lost / messages, interval, float(self.expected[which].sum()) / messages

    def words(self) -> str | None:
        """What differs from the experiment, without a full stop; None where nothing does."""
        share, (low, high), expected = self.share()
        if low <= expected <= high or abs(share - expected) < LEAST_EXCESS:
            return None
        text = (
            f"{percent(share)} ({100 * low:.3g} to {100 * high:.3g} %) of the messages between agents did not arrive "
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
            row |= {"lost": int(self.lost[place]), "share": found, "interval": list(around), "expected": should}
            rows.append(row)
        return {
            "messages": int(self.messages.sum()),
            "lost": int(self.lost.sum()),
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
        return np.argsort(-np.abs(self.lost - self.expected) / spread, kind="stable")


def lost_messages(observation: Observation) -> LostMessages:
    """The messages of a run in real time, see ``LostMessages``; with a delay, so many steps later."""
    timers, step = observation.timed, observation.step
    tables = neighbour_tables(step)
    links = np.argwhere(step.listens())
    messages, lost = np.zeros(len(links), np.int64), np.zeros(len(links), np.int64)
    late = step.delay
    steps = len(timers.graphs) - 1 - late  # that can be the first one after a message was published
    for receiver in np.unique(links[:, 0]).tolist() if steps >= 1 else ():
        graphs, made = column(timers.graphs, receiver), column(timers.made, receiver)
        there = np.arange(step.most_neighbours) < tables.count[graphs, receiver][:, None]
        senders, received = tables.senders[graphs, receiver], column(timers.used, receiver)
        for number in np.flatnonzero(links[:, 0] == receiver).tolist():
            sender = int(links[number, 1])
            chosen = there & (senders == sender)  # (N, D): at most one of a step
            active = chosen.any(axis=1)
            used = np.where(chosen, received, -1).max(axis=1, initial=-1)
            first, second = used[late : late + steps], used[late + 1 : late + 1 + steps]
            newest = np.searchsorted(column(timers.made, sender), made[1 : steps + 1], side="left") - 1
            newest = np.maximum(newest, first)  # of equal times, a value comes before the steps that use it
            decided = active[late : late + steps] & active[late + 1 : late + 1 + steps]
            decided &= np.diff(newest, prepend=newest[0]) > 0
            decided[: observation.sure_messages] = False
            messages[number] = decided.sum()
            lost[number] = (decided & (first != newest) & (second != newest)).sum()
    probability = step.losses[links[:, 0], links[:, 1]] if step.loss else np.zeros(len(links))
    persistence = 0.0
    if step.burst is not None and probability.any():
        chance = float(probability.max())
        persistence = 1.0 - 1.0 / step.burst - chance / (step.burst * (1.0 - chance))
    inflation = (1.0 + persistence) / (1.0 - persistence)
    return LostMessages(links, messages, lost, np.asarray(probability), inflation)
