# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The start of a run, and its first steps with a delay, which use the messages with x(0) again.

With a delay d the steps 0, ..., d use the messages with x(0), each with one noise and one loss. The equations of a
``JumpSystem``, in which every message is used once, hold from step d + 1 on. Until then an agent depends on the
messages with x(0), on its own noise and, if its own value takes the place of a lost one, on which of these messages it
has lost: one copy of its state for every pattern of losses, of which two agents have independent ones. So with
c_(i,p)(l,q) the moments of the copies p of agent i and q of agent l, and with the probabilities w of the patterns,

    E[x_i x_l] = sum_pq w_p w_q c_(i,p)(l,q) for i != l,    E[x_i^2] = sum_p w_p c_(i,p)(i,p).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.model.step_model import StepModel
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.message_steps import burst_channels, gilbert

MOST_NUMBERS = 2000  # that are followed together; with more, losses of messages with x(0), then their noise, are new


@dataclass(frozen=True, slots=True, eq=False)
class MomentsAt:
    """The paper's pi, nu and c at one time, in reduced coordinates."""

    law: FloatArray  # (n,) pi_i = P(g = i)
    means: FloatArray  # (n, d) E[y; mode i]
    moments: FloatArray  # (n, d, d) C_i = E[y y^T; mode i]


Start = Sequence[MomentsAt]
"""The moments of the steps 0, 1, ...: from the last of them on, the equations of the system hold."""


def known_start(system: JumpSystem, deviations: FloatArray, law: FloatArray) -> Start:
    """Of agents at known places, x(0) (R, m) less the reference, each with probability 1 / R; law (n,) of g(0)."""
    if system.unreduced is not None:  # what is common to all agents has no effect, and is not to be squared
        deviations = deviations - deviations.mean(axis=1, keepdims=True)
    means = np.multiply.outer(law, deviations.mean(axis=0))
    moment = deviations.T @ deviations / len(deviations)
    return _start(system, law, means, law[:, None, None] * moment)


def steady_start(system: JumpSystem, agents: FloatArray, law: FloatArray) -> Start:
    """Of agents with their steady second moments (n, m, m) given the mode; law (n,) of g(0)."""
    moments = (law / system.stationary)[:, None, None] * agents
    step = system.step
    if step is not None and step.burst is not None and system.messages is not None and not step.holds:
        # A channel that decides on the message of step -d or 1 - d is to decide on that with x(0).
        channels, ahead = burst_channels(step), _ahead(step)
        for k in range(step.delay):
            frozen = [k >= step.delay - int(ahead[link]) for link in channels]
            moments = _mixed(moments, np.eye(step.modes), step, channels, frozen)
    return _start(system, law, np.zeros((system.modes, moments.shape[1])), moments)


def _start(system: JumpSystem, law: FloatArray, means: FloatArray, moments: FloatArray) -> Start:
    """From the law (n,), means (n, m) and second moments (n, m, m) of x(0)."""
    step = system.step
    if step is None or (not step.delay and system.messages is None):
        return [MomentsAt(law, means @ system.lift, system.lift.T @ moments @ system.lift)]
    first = _FirstSteps(system, step, law, means, moments)
    return [first.now(0), *(first.after(k) for k in range(first.count))]


class _FirstSteps:
    """Second moments of all that the first steps use and leave, with the number 1 among it, for every mode."""

    def __init__(
        self, system: JumpSystem, step: StepModel, law: FloatArray, means: FloatArray, moments: FloatArray
    ) -> None:
        m, d = step.agents, step.delay
        self._system, self._step = system, step
        listens = step.listens()
        lossy: BoolArray = listens & (step.losses > 0.0)
        self._held = [(i, j) for i, j in np.argwhere(lossy if step.holds else lossy & False).tolist()]
        links = [(i, j) for i, j in np.argwhere(listens).tolist()]
        self._ahead = _ahead(step)
        self._channels = burst_channels(step) if system.messages is not None else []
        again = step.broadcast or step.link or (step.loss and not step.holds)
        self.count = d + 1 if d and again else 0
        each = (1 + bool(step.broadcast)) * m + len(self._held)
        if self.count and 1 + m + len(links) + (self.count + 1) * (each + m) > MOST_NUMBERS:
            self.count = 0
        self._links = links if self.count else self._held
        self._air = self._links if step.link else []
        size = 1 + m + len(self._air) + (self.count + 1) * each
        # Of agents with few links that may lose, every pattern of losses: which links lose, and its probability.
        self._patterns: list[tuple[int, dict[tuple[int, int], float], float]] = []
        split = self.count and step.burst is None and not step.holds
        room = (MOST_NUMBERS - size) // (self.count + 1) - m if split else 0
        for i in range(m):
            links = [(i, j) for j in np.flatnonzero(lossy[i]).tolist()] if room >= 2 ** min(60, lossy[i].sum()) else []
            losses = [float(step.losses[link]) for link in links]
            for lost in product([0.0, 1.0], repeat=len(links)):
                share = float(np.prod([p if gone else 1.0 - p for p, gone in zip(losses, lost, strict=True)]))
                self._patterns.append((i, dict(zip(links, lost, strict=True)), share))
            room -= 2 ** len(links) - 1
        self._agent = np.array([i for i, _, _ in self._patterns])
        self._own = np.eye(m, dtype=np.bool_)[:, self._agent]  # (m, copies)
        self._collapse = self._own * np.array([share for _, _, share in self._patterns])
        size += self.count * len(self._patterns) if len(self._patterns) > m else 0
        self._begin(size + len(self._patterns) - m, law, means, moments)

    def _begin(self, size: int, law: FloatArray, means: FloatArray, moments: FloatArray) -> None:
        """The messages with x(0), and the copies."""
        step, m = self._step, self._step.agents
        width = 1 + 2 * m + len(self._air)
        base = np.zeros((len(law), width, width))
        base[:, 0, 0], base[:, 0, 1 : m + 1], base[:, 1 : m + 1, 0] = law, means, means
        base[:, 1 : m + 1, 1 : m + 1] = moments
        added = np.array([0.0] * (m + 1) + [step.broadcast**2] * m + [step.link**2] * len(self._air))
        base += law[:, None, None] * np.diag(added)
        self._c = np.zeros((len(law), size, size))
        self._used, rows = 1, np.zeros((size, base.shape[1]))
        rows[0, 0] = 1.0
        self.x, self.y = [self._new(m)], [self._new(m) if step.broadcast else range(1, m + 1)]
        rows[self.x[0], range(1, m + 1)] = 1.0
        heard = {link: self.y[0][link[1]] for link in self._links}
        if step.broadcast:
            rows[self.y[0]] = rows[self.x[0]]
            rows[self.y[0], range(m + 1, 2 * m + 1)] = 1.0
        for number, link in enumerate(self._air):
            entry = self._new(1)[0]
            rows[entry] = rows[heard[link]]
            rows[entry, 2 * m + 1 + number] = 1.0
            heard[link] = entry
        self._first = heard
        self.h: list[dict[tuple[int, int], int]] = [{link: heard[link] for link in self._held}]
        self._copies = [self._new(len(self._patterns)) if len(self._patterns) > m else self.x[0]]
        rows[self._copies[0]] = rows[self.x[0]][self._agent]
        self._c[:] = rows @ base @ rows.T

    def _new(self, count: int) -> range:
        self._used += count
        return range(self._used - count, self._used)

    def now(self, k: int) -> MomentsAt:
        """Of x(k), in the coordinates of the system."""
        step, lift = self._step, self._system.lift
        messages, m = self._system.messages, step.agents
        if messages is None:
            entries = [entry for age in range(step.delay + 1) for entry in self.x[max(0, k - age)]]
        else:
            entries = list(self.x[k])
            for age, receiver, sender in messages.origins[m:].tolist():
                at = max(0, k - age)
                entries.append(self.y[at][sender] if receiver < 0 else self.h[at][receiver, sender])
        moments = self._c[:, entries][:, :, entries]
        return MomentsAt(self._c[:, 0, 0].copy(), self._c[:, 0, entries] @ lift, lift.T @ moments @ lift)

    def after(self, k: int) -> MomentsAt:
        """Of x(k + 1), after the step k."""
        step, m = self._step, self._step.agents
        copies = self._new(len(self._patterns))
        self._copies.append(copies)
        x = self._new(m) if len(copies) > m else copies
        y = self._new(m) if step.broadcast else x
        h = dict(zip(self._held, self._new(len(self._held)), strict=True))
        for mode, one in enumerate(self._c):
            graph, probability = self._mode(mode)
            self._step_copies(one, *self._rows(k, graph, probability))
            # The new state: of two agents the patterns are independent, of one and the same they are the same.
            known = self._collapse @ one[copies]
            for block in self._copies:
                known[:, block] = np.where(self._own, one[copies, block], known[:, block])
            both = known[:, copies] @ self._collapse.T
            for new in (x, y) if step.broadcast else (x,):
                one[new], one[:, new] = known, known.T
            for left, right in product((x, y), repeat=2):
                one[np.ix_(left, right)] = both
            one[y, y] += one[0, 0] * step.broadcast**2
            self._hear(one, probability, y, h)
        self.x.append(x)
        self.y.append(y)
        self.h.append(h)
        frozen = [not step.holds and k < step.delay - int(self._ahead[link]) for link in self._channels]
        self._c = _mixed(self._c, step.transition, step, self._channels, frozen)
        return self.now(k + 1)

    def _step_copies(
        self, one: FloatArray, rows: FloatArray, noise: FloatArray, losses: list[tuple[int, int, int, float]]
    ) -> None:
        """The newest copies, in the moments (Z, Z) of one mode."""
        new = self._copies[-1]
        across = rows @ one
        inside = across @ rows.T + one[0, 0] * noise
        for row, brought, instead, variance in losses:
            seen = one[brought, brought] + one[instead, instead] - 2.0 * one[brought, instead]
            inside[row, row] += variance * seen
        for y, x, block in zip(self.y[1:], self.x[1:], self._copies[1:-1], strict=True):
            # What others have heard of an agent has the pattern of the copy that it is multiplied with.
            same = np.array(block)
            change = np.einsum("rz,zr->r", rows, one[:, same]) - (across[:, y] * self._own.T).sum(axis=1)
            used = change[:, None] * rows[:, y].T[self._agent]
            inside += used + used.T
            for heard in {x, y}:
                across[:, heard] = np.where(self._own.T, across[range(len(new)), same][:, None], across[:, heard])
        one[new], one[:, new] = across, across.T
        one[np.ix_(new, new)] = inside

    def _mode(self, mode: int) -> tuple[int, FloatArray]:
        """Graph, and the probabilities of losses (m, m)."""
        graph, state = divmod(mode, 2 ** len(self._channels))
        probability = self._step.losses.copy()
        for place, link in enumerate(reversed(self._channels)):
            probability[link] = float(state >> place & 1)
        return graph, probability

    def _rows(
        self, k: int, graph: int, probability: FloatArray
    ) -> tuple[FloatArray, FloatArray, list[tuple[int, int, int, float]]]:
        """The copies after step k: rows (copies, Z), noise, and losses: row, entries brought and instead, variance."""
        step, copies = self._step, self._copies[-2]
        rows = np.zeros((len(copies), self._c.shape[1]))
        losses: list[tuple[int, int, int, float]] = []
        gain = step.noise_gain[graph][self._agent]
        noise = gain @ gain.T
        for row, (i, pattern, _) in enumerate(self._patterns):
            own = copies[row]
            rows[row, own] += step.nominal[graph, i, i]
            for j in step.neighbours(graph, i).tolist():
                weight, link = float(step.nominal[graph, i, j]), (i, j)
                late = max(0, k - step.delay + int(self._ahead[link]))
                if link in self.h[0]:
                    rows[row, self.h[late][link]] += weight
                    continue
                entry, p = self.y[late][j] if late else self._first[link], float(probability[link])
                p = p if late else pattern.get(link, p)
                rows[row, entry] += (1.0 - p) * weight
                rows[row, own] += p * weight
                if late:
                    noise[row, row] += (1.0 - p) * (weight * step.link) ** 2
                if 0.0 < p < 1.0:
                    losses.append((row, entry, own, p * (1.0 - p) * weight**2))
        return rows, noise, losses

    def _hear(self, one: FloatArray, probability: FloatArray, y: range, h: dict[tuple[int, int], int]) -> None:
        """What receivers hold after they have heard the new message, or not."""
        rows, added = np.zeros((len(h), len(one))), np.zeros(len(h))
        for row, link in enumerate(h):
            p, new, old = float(probability[link]), y[link[1]], self.h[-1][link]
            rows[row, new], rows[row, old] = 1.0 - p, p
            added[row] = (1.0 - p) * self._step.link**2 * one[0, 0]
            added[row] += p * (1.0 - p) * (one[new, new] + one[old, old] - 2.0 * one[new, old])
        entries, across = list(h.values()), rows @ one
        one[entries], one[:, entries] = across, across.T
        one[np.ix_(entries, entries)] = across @ rows.T + np.diag(added)


def _ahead(step: StepModel) -> IntArray:
    """(m, m) by receiver and sender: 1 where the sender steps first, else 0."""
    rank = np.zeros(step.agents) if step.turns is None else np.argsort(step.turns)
    return np.asarray((rank < rank[:, None]).astype(np.int64))


def _mixed(
    stack: FloatArray, graphs: FloatArray, step: StepModel, channels: list[tuple[int, int]], frozen: list[bool]
) -> FloatArray:
    """The stack (n, a, b) after the graph has switched by (n, n) ``graphs``, and the channels that are not frozen."""
    chain: FloatArray = graphs
    for link, stays in zip(channels, frozen, strict=True):
        one = np.eye(2) if stays else gilbert(float(step.losses[link]), step.burst or 1.0)[0]
        chain = np.asarray(np.kron(chain, one))
    return np.asarray(np.tensordot(chain.T, stack, axes=1))
