# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The periods of a run in real time as linear maps between the states known at its sampling times.

The state of the network at the sampling time K dt is a stack: the newest state of every agent; older ones that a later
step still uses; in place of these, with reception noise, the values as they were published, or received if they arrive
once and are used again; and, if process noise is correlated between agents, that of a step that some agents have made
and others not yet. A period maps one stack to the next by a matrix and noise, which depend on the log alone: matrices
are computed once for each pattern.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray, release
from msg_analysis.inference.event_order import OWN, Entries, EventOrder, period_tables
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.received_values import neighbour_weights
from msg_analysis.model.reception import neighbour_tables

CACHED_BLOCKS = 10  # blocks of numbers in cached matrices: 160 MB

NULL = 1e-12  # eigenvalues of second moments this small, relative to the largest, are rounding: some are 0 exactly


@dataclass(frozen=True, slots=True, eq=False)
class Period:
    """z(K) = matrix @ z(K-1) + noise, in deviations from the reference; the size S of the stack may change to S'."""

    matrix: FloatArray  # (S', S)
    noise: FloatArray  # (S', S') covariance


class _Law(NamedTuple):
    """How an agent steps under a graph, as plain numbers."""

    own: float  # weight of its own value
    inputs: list[tuple[int, float]]  # its neighbours and their weights
    shared: list[tuple[int, float]]  # the sources of noise that others feel too, and their gains
    variance: float  # of the rest of its noise


class Periods:
    """The periods K = 1..N-1 of a run, from sampling time K-1 to K; a stack begins with the m newest states."""

    def __init__(self, observation: Observation, order: EventOrder) -> None:
        self._step = step = observation.step
        self._observation, self._newest = observation, order.newest
        self._events, self._extras = period_tables(observation, order)
        self._numbers = Entries(step)
        self._shared = self._numbers.shared
        self._laws: dict[tuple[int, int], _Law] = {}  # by graph and agent
        self._cache: dict[bytes, Period] = {}
        self._cached, self._most_cached = 0, CACHED_BLOCKS * observation.block_numbers
        self.steps, self.agents = observation.steps, step.agents
        self.largest = step.agents + int(np.diff(self._extras.ends).max(initial=0))  # entries of the largest stack

    def entries(self, number: int) -> int:
        """Entries of the stack at sampling time ``number``, from 0."""
        return self._step.agents + len(self._extras[number])

    def start(self, moment: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(S, S) each, of the stack at the start: without noise, from that of the states (m, m); of noise."""
        m = self._step.agents
        entries = np.concatenate([np.arange(m), self._extras[0][:, 0]])
        owners = self._numbers.owners[entries]
        noise = np.diag(np.where(entries >= 2 * m, self._step.broadcast**2, 0.0))
        return moment[np.ix_(owners, owners)], noise

    def stack(self, number: int, moment: FloatArray) -> FloatArray | None:
        """(S, S): mean of z z^T over replicas at sampling time ``number``, given the log; None with process noise."""
        # What was received is not logged, but follows, but for its noise, from the rest: by regression, with the second
        # ``moment`` (S, S) of the law.
        if self._shared.any():
            return None
        step, m, observation = self._step, self._step.agents, self._observation
        extra = self._extras[number]
        entries = np.concatenate([np.arange(m), extra[:, 0]])
        steps = self._newest[number, self._numbers.owners[entries]]
        steps[m:] += extra[:, 1]
        known = entries < 3 * m
        entries, steps = entries[known], steps[known]
        states, published = observation.states, observation.published
        found = states[steps, self._numbers.owners[entries]]
        if published is not None:
            aired = entries >= 2 * m
            found[aired] = published[steps[aired], entries[aired] - 2 * m]
        found = found - step.reference
        # In consensus the common part does not count, and can be large.
        consensus = observation.prediction.experiment.problem == "consensus"
        if consensus:
            found = found - found.mean(axis=0)
        seen = np.asarray(found @ found.T / found.shape[1])
        return seen if known.all() else _completed(seen, known, moment, centred=consensus)

    def __getitem__(self, number: int) -> Period:
        """The period that ends at sampling time ``number`` (1..N-1)."""
        events = self._events[number]
        before, after = self._extras[number - 1], self._extras[number]
        key = b"|".join((events.tobytes(), before.tobytes(), after.tobytes()))
        if key not in self._cache:
            found = self._compile(events, before, after)
            if self._cached > self._most_cached:
                self._cache.clear()
                self._cached = 0
            self._cached += found.matrix.size + found.noise.size
            self._cache[key] = found
        return self._cache[key]

    def release(self) -> None:
        """Give the memory of a long run back to the system: after every block of periods."""
        for array in (self._events.rows, self._extras.rows, self._newest):
            release(array)
        self._observation.release()

    def _law(self, graph: int, agent: int) -> _Law:
        if (graph, agent) in self._laws:
            return self._laws[graph, agent]
        tables, gain = neighbour_tables(self._step), self._step.noise_gain[graph, agent]
        senders = tables.senders[graph, agent, : tables.count[graph, agent]].tolist()
        weights = neighbour_weights(self._step)[graph, agent].tolist()
        shared = np.flatnonzero(self._shared & (gain != 0.0)).tolist()
        self._laws[graph, agent] = found = _Law(
            float(self._step.nominal[graph, agent, agent]),
            list(zip(senders, weights, strict=False)),
            [(which, float(gain[which])) for which in shared],
            float((gain[~self._shared] ** 2).sum()),
        )
        return found

    def _compile(self, events: IntArray, before: IntArray, after: IntArray) -> Period:
        """Event by event; values are kept as long as they are used."""
        step, m = self._step, self._step.agents
        most = neighbour_tables(step).senders.shape[2]
        sources = range(m, 2 * m)
        owners = self._numbers.owners.tolist()
        # Values by agent and step from the newest one at the beginning; noise by source and step from the end.
        known = [(j, 0) for j in range(m)]
        known += [(entry, offset - 1 if entry in sources else offset) for entry, offset in before.tolist()]
        live = _Live(known, m)
        made = [0] * m
        rows: list[tuple[_Key, dict[_Key, float], float]] = []
        published = 2 * m if step.broadcast else 0
        for agent, graph, lag, own, *received in events.tolist():
            mine, law = (agent, own), self._law(graph, agent)
            terms = {mine: law.own}
            variance = 0.0
            for d, (sender, weight) in enumerate(law.inputs):
                key, again = mine, 0
                if received[d] != OWN:
                    key, again = (published + sender, received[d]), received[most + d]
                    if again:
                        arrived = int(self._numbers.links[agent, sender]), received[d]
                        if again == 1:
                            rows.append((arrived, {key: 1.0}, step.link**2))
                        key = arrived
                    else:
                        variance += (weight * step.link) ** 2
                terms[key] = terms.get(key, 0.0) + weight
            for which, gain in law.shared:
                terms[m + which, lag] = gain
            made[agent] = own + 1
            rows.append(((agent, own + 1), terms, variance + law.variance))
            if published:
                rows.append(((published + agent, own + 1), {(agent, own + 1): 1.0}, step.broadcast**2))
        stacked = [(j, made[j]) for j in range(m)]
        stacked += [(e, offset if e in sources else made[owners[e]] + offset) for e, offset in after.tolist()]
        wanted = set(stacked).union(*(terms for _, terms, _ in rows))
        rows = [row for row in rows if row[0] in wanted]
        last_use = {key: number for number, (_, terms, _) in enumerate(rows) for key in terms}
        last_use |= dict.fromkeys(stacked, len(rows))
        for number, (key, terms, variance) in enumerate(rows):
            live.add(key, terms, variance)
            live.drop([used for used in (*terms, key) if last_use.get(used, -1) <= number])
        return live.take(stacked)


_Key = tuple[int, int]  # entry and step; sources of noise are numbers of variance 1, new where not known yet


class _Live:
    """Values as combinations of the stack at the beginning of a period, and the covariance of the noise added since."""

    def __init__(self, stack: list[_Key], agents: int) -> None:
        self._agents, self._entries = agents, len(stack)
        entries = self._entries
        # Of every value its combination of the stack, and after it the covariance of its noise with that of the others.
        self._rows = np.eye(2 * entries, 3 * entries)
        self._rows[entries:] = 0.0
        self._noise = self._rows[:, entries:]
        self._place = {key: place for place, key in enumerate(stack)}
        self._free = list(range(entries, 2 * entries))[::-1]

    def add(self, key: _Key, terms: dict[_Key, float], variance: float) -> None:
        """Add a combination of others, plus noise of its own."""
        rows = [self._find(used) for used in terms]
        if len(rows) == 1:  # what is sent or received, as often as not
            (row,), (weight,) = rows, terms.values()
            found = weight * self._rows[row]
            own = weight * found[self._entries + row]
        else:
            weights = np.array(list(terms.values()))
            found = weights @ self._rows[rows]
            own = found[self._entries :][rows] @ weights
        place = self._new(key)  # may make the arrays larger
        noise = found[self._entries :]
        self._rows[place, : len(found)] = found
        self._noise[: len(noise), place] = noise
        self._noise[place, place] = own + variance

    def drop(self, keys: list[_Key]) -> None:
        """Drop values that are no longer used."""
        for key in keys:
            if key in self._place:
                self._free.append(self._place.pop(key))

    def take(self, keys: list[_Key]) -> Period:
        """The period that ends with this stack."""
        rows = [self._find(key) for key in keys]
        found = self._rows[rows]
        return Period(found[:, : self._entries].copy(), found[:, self._entries :][:, rows].copy())

    def _find(self, key: _Key) -> int:
        if key not in self._place and self._agents <= key[0] < 2 * self._agents:
            place = self._new(key)
            self._rows[place] = self._noise[:, place] = 0.0
            self._noise[place, place] = 1.0
        return self._place[key]

    def _new(self, key: _Key) -> int:
        if not self._free:
            size = len(self._rows)
            self._rows = np.pad(self._rows, ((0, size), (0, size)))
            self._noise = self._rows[:, self._entries :]
            self._free = list(range(2 * size))[: size - 1 : -1]
        self._place[key] = self._free.pop()
        return self._place[key]


def _completed(seen: FloatArray, known: BoolArray, moment: FloatArray, *, centred: bool) -> FloatArray:
    """E[z z^T] given the mean ``seen`` over the replicas for the ``known`` entries, by linear regression."""
    if centred:
        centre = np.eye(len(known)) - np.outer(np.ones(len(known)), known / known.sum())
        moment = centre @ moment @ centre.T
    gain = moment[:, known] @ np.linalg.pinv(moment[np.ix_(known, known)], rcond=NULL, hermitian=True)
    rest = moment[np.ix_(~known, ~known)] - gain[~known] @ moment[np.ix_(known, ~known)]
    found = gain @ seen @ gain.T
    found[np.ix_(known, known)] = seen
    found[np.ix_(~known, ~known)] += rest
    return found
