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

from msg_analysis.common.arrays import FloatArray
from msg_analysis.model.step_model import StepModel, ahead
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.message_steps import Move, Use, add_uses, burst_channels, hear, joint_chain, loss_modes

MOST_NUMBERS = 2000  # that are followed together, see ``simplification``


@dataclass(frozen=True, slots=True, eq=False)
class MomentsAt:
    """The paper's pi, nu and c at one time, in reduced coordinates."""

    law: FloatArray  # (n,) pi_i = P(g = i)
    means: FloatArray  # (n, d) E[y; mode i]
    moments: FloatArray  # (n, d, d) C_i = E[y y^T; mode i]


Start = Sequence[MomentsAt]
"""The moments of the steps 0, 1, ...: from the last of them on, the equations of the system hold."""


def known_start(
    system: JumpSystem, deviations: FloatArray, law: FloatArray, *, most_numbers: int = MOST_NUMBERS
) -> Start:
    """Of agents at known places, x(0) (R, m) less the reference, each with probability 1 / R; law (n,) of g(0)."""
    if system.unreduced is not None:  # what is common to all agents has no effect, and is not to be squared
        deviations = deviations - deviations.mean(axis=1, keepdims=True)
    means = np.multiply.outer(law, deviations.mean(axis=0))
    moment = deviations.T @ deviations / len(deviations)
    return _start(system, law, means, law[:, None, None] * moment, most_numbers)


def steady_start(system: JumpSystem, agents: FloatArray, law: FloatArray, *, most_numbers: int = MOST_NUMBERS) -> Start:
    """Of agents with their steady second moments (n, m, m) given the mode; law (n,) of g(0)."""
    moments, step = (law / system.stationary)[:, None, None] * agents, system.step
    if step is not None and not step.holds:
        # A channel that decides on the message of step -d or 1 - d is to decide on that with x(0).
        for k in range(step.delay if burst_channels(step) else 0):
            decided = [not stays for stays in _frozen(step, k)]
            moments = _mixed(moments, joint_chain(step, np.eye(step.modes), decided))
    return _start(system, law, np.zeros((system.modes, moments.shape[1])), moments, most_numbers)


def simplification(system: JumpSystem, most_numbers: int = MOST_NUMBERS) -> str | None:
    """What is not exact in the first steps of a large network, as a sentence; None: all is."""
    step = system.step
    if step is None or not step.delay:
        return None
    first, renewed = _FirstSteps(system, step, most_numbers), ""
    if first.again and not first.count:
        renewed = "their noise and losses"
    elif first.unsplit:
        renewed = f"the losses of those to {first.unsplit} agents"
    return renewed and (
        f"the network is large: in the steps 0 to {step.delay}, which use the messages with x(0) again, {renewed} are "
        "taken as new for each use, so predictions from the start on are approximate; the steady state is exact"
    )


def _start(system: JumpSystem, law: FloatArray, means: FloatArray, moments: FloatArray, most_numbers: int) -> Start:
    """From the law (n,), means (n, m) and second moments (n, m, m) of x(0)."""
    step = system.step
    if step is None or (not step.delay and system.messages is None):
        return [MomentsAt(law, means @ system.lift, system.lift.T @ moments @ system.lift)]
    return _FirstSteps(system, step, most_numbers).course(law, means, moments)


class _FirstSteps:
    """Second moments of all that the first steps use and leave, with the number 1 among it, for every mode."""

    def __init__(self, system: JumpSystem, step: StepModel, most_numbers: int) -> None:
        m, d = step.agents, step.delay
        self._system, self._step, self._modes = system, step, loss_modes(step)
        listens = step.listens()
        lossy = listens & (step.losses > 0.0)
        links = [(i, j) for i, j in np.argwhere(listens).tolist()]
        self._held = [link for link in links if step.holds and lossy[link]]
        self._ahead = ahead(step.turns, m)
        self.again = bool(d and (step.broadcast or step.link or (step.loss and not step.holds)))
        each = (1 + bool(step.broadcast)) * m + len(self._held)
        fits = 1 + m + len(links) * bool(step.link) + (d + 2) * each <= most_numbers
        self.count = d + 1 if self.again and fits else 0
        self._links = links if self.count else self._held
        self._air = self._links if step.link else []
        size = 1 + m + len(self._air) + (self.count + 1) * each
        # Of agents with few links that may lose, every pattern of losses: which links lose, and its probability.
        self._patterns: list[tuple[int, dict[tuple[int, int], float], float]] = []
        self.unsplit = 0  # agents with more
        split = self.count and step.burst is None and not step.holds
        room = (most_numbers - size) // (self.count + 1) - m
        for i in range(m):
            links = [(i, j) for j in np.flatnonzero(lossy[i]).tolist()] if split else []
            if room < 2 ** min(60, len(links)):
                links, self.unsplit = [], self.unsplit + bool(links)
            losses = [float(step.losses[link]) for link in links]
            for lost in product([0.0, 1.0], repeat=len(links)):
                share = float(np.prod([p if gone else 1.0 - p for p, gone in zip(losses, lost, strict=True)]))
                self._patterns.append((i, dict(zip(links, lost, strict=True)), share))
            room -= 2 ** len(links) - 1
        self._agent = np.array([i for i, _, _ in self._patterns])
        self._own = np.eye(m, dtype=np.bool_)[:, self._agent]  # (m, copies)
        self._collapse = self._own * np.array([share for _, _, share in self._patterns])
        self._split = len(self._patterns) > m
        self._size = size + ((self.count + 1) * len(self._patterns) if self._split else 0)

    def course(self, law: FloatArray, means: FloatArray, moments: FloatArray) -> Start:
        """The moments of x(0), ..., x(count)."""
        self._begin(law, means, moments)
        return [self._now(0), *(self._after(k) for k in range(self.count))]

    def _begin(self, law: FloatArray, means: FloatArray, moments: FloatArray) -> None:
        """The messages with x(0), and the copies."""
        step, m = self._step, self._step.agents
        width = 1 + 2 * m + len(self._air)
        base = np.zeros((len(law), width, width))
        base[:, 0, 0], base[:, 0, 1 : m + 1], base[:, 1 : m + 1, 0] = law, means, means
        base[:, 1 : m + 1, 1 : m + 1] = moments
        added = np.array([0.0] * (m + 1) + [step.broadcast**2] * m + [step.link**2] * len(self._air))
        base += law[:, None, None] * np.diag(added)
        self._used, rows = 1, np.zeros((self._size, width))
        rows[0, 0] = 1.0
        self._x, self._y = [self._new(m)], [self._new(m) if step.broadcast else range(1, m + 1)]
        rows[self._x[0], range(1, m + 1)] = 1.0
        heard = {link: self._y[0][link[1]] for link in self._links}
        if step.broadcast:
            rows[self._y[0]] = rows[self._x[0]]
            rows[self._y[0], range(m + 1, 2 * m + 1)] = 1.0
        for number, link in enumerate(self._air):
            entry = self._new(1)[0]
            rows[entry] = rows[heard[link]]
            rows[entry, 2 * m + 1 + number] = 1.0
            heard[link] = entry
        self._first = heard
        self._h: list[dict[tuple[int, int], int]] = [{link: heard[link] for link in self._held}]
        self._copies = [self._new(len(self._patterns)) if self._split else self._x[0]]
        rows[self._copies[0]] = rows[self._x[0]][self._agent]
        self._c = rows @ base @ rows.T

    def _new(self, count: int) -> range:
        self._used += count
        return range(self._used - count, self._used)

    def _now(self, k: int) -> MomentsAt:
        """Of x(k), in the coordinates of the system."""
        step, lift = self._step, self._system.lift
        messages, m = self._system.messages, step.agents
        if messages is None:
            entries = [entry for age in range(step.delay + 1) for entry in self._x[max(0, k - age)]]
        else:
            entries = list(self._x[k])
            for age, receiver, sender in messages.origins[m:].tolist():
                at = max(0, k - age)
                entries.append(self._y[at][sender] if receiver < 0 else self._h[at][receiver, sender])
        moments = self._c[:, entries][:, :, entries]
        return MomentsAt(self._c[:, 0, 0].copy(), self._c[:, 0, entries] @ lift, lift.T @ moments @ lift)

    def _after(self, k: int) -> MomentsAt:
        """Of x(k + 1), after the step k."""
        step, m = self._step, self._step.agents
        copies = self._new(len(self._patterns))
        self._copies.append(copies)
        x = self._new(m) if self._split else copies
        y = self._new(m) if step.broadcast else x
        h = dict(zip(self._held, self._new(len(self._held)), strict=True))
        for one, (graph, probability) in zip(self._c, self._modes, strict=True):
            share = float(one[0, 0])
            self._step_copies(one, self._move(k, graph, probability), share)
            # The new state: of two agents the patterns are independent, of one and the same they are the same.
            known = self._collapse @ one[copies]
            for block in self._copies:
                known[:, block] = np.where(self._own, one[copies, block], known[:, block])
            both = known[:, copies] @ self._collapse.T
            one[x], one[:, x] = known, known.T
            one[np.ix_(x, x)] = both
            if step.broadcast:
                Move(y, np.eye(self._size)[x], step.broadcast**2 * np.eye(m), ()).apply(one, share)
            hear(step, probability, y, self._h[-1], h, self._size).apply(one, share)
        self._x.append(x)
        self._y.append(y)
        self._h.append(h)
        self._c = _mixed(self._c, joint_chain(step, step.transition, [] if step.holds else _frozen(step, k)))
        return self._now(k + 1)

    def _step_copies(self, one: FloatArray, move: Move, share: float) -> None:
        """The newest copies, in the moments (Z, Z) of one mode."""
        new, rows = self._copies[-1], move.matrix
        before = one[:, : new[0]].copy()
        move.apply(one, share)
        for y, x, block in zip(self._y[1:], self._x[1:], self._copies[1:-1], strict=True):
            # What others have heard of an agent has the pattern of the copy that it is multiplied with.
            same = np.array(block)
            change = np.einsum("rz,zr->r", rows, before[:, same]) - (one[new][:, y] * self._own.T).sum(axis=1)
            used = change[:, None] * rows[:, y].T[self._agent]
            one[np.ix_(new, new)] += used + used.T
            for heard in {x, y}:
                seen = np.where(self._own.T, one[new, same][:, None], one[np.ix_(new, heard)])
                one[np.ix_(new, heard)], one[np.ix_(heard, new)] = seen, seen.T

    def _move(self, k: int, graph: int, probability: FloatArray) -> Move:
        """The step k of the copies in a mode."""
        step, old, new = self._step, self._copies[-2], self._copies[-1]
        matrix, gain = np.zeros((len(new), self._size)), step.noise_gain[graph][self._agent]
        noise, losses = gain @ gain.T, []
        for row, (i, pattern, _) in enumerate(self._patterns):
            uses: list[Use] = []
            for j in step.neighbours(graph, i).tolist():
                link, late = (i, j), max(0, k - step.delay + int(self._ahead[i, j]))
                if link in self._h[0]:
                    uses.append((j, self._h[late][link], 0.0, 0.0))
                elif late:
                    uses.append((j, self._y[late][j], float(probability[link]), step.link))
                else:
                    uses.append((j, self._first[link], pattern.get(link, float(probability[link])), 0.0))
            variance, lost = add_uses(matrix[row], step.nominal[graph, i], i, old[row], new[row], uses)
            noise[row, row] += variance
            losses += lost
        return Move(new, matrix, noise, losses)


def _frozen(step: StepModel, k: int) -> list[bool]:
    """Whether each channel, in step k, still decides on the message with x(0)."""
    return [k < step.delay - int(ahead(step.turns, step.agents)[link]) for link in burst_channels(step)]


def _mixed(stack: FloatArray, chain: FloatArray) -> FloatArray:
    """The stack (n, a, b) after a jump by the chain (n, n)."""
    return np.asarray(np.tensordot(chain.T, stack, axes=1))
