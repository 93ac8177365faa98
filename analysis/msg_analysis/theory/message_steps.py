# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The steps of a run whose messages are noisy, late or lost, as a jump linear system of the agents and what they heard.

A period is composed of micro-steps: an agent makes its step from what it has heard, then publishes its new state, and
every receiver hears it or not. In lockstep all agents step, then all publish; in real time one agent after the other.
The stack z has the states x; where they differ from these, the published values y, and those that a delay makes older;
and, where the last value heard takes the place of a lost one, what every receiver has heard, h. All entries move
together if all agents do, so in consensus one number drops out. See docs/theory.md, "Messages one by one".
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
import scipy.linalg

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.errors import InputError
from msg_analysis.experiment.limits import MOST_GIVEN, MOST_STATES, MOST_VALUES
from msg_analysis.experiment.markov_chain import MarkovChain
from msg_analysis.model.step_model import StepModel


@dataclass(frozen=True, slots=True, eq=False)
class LossEvents:
    """The losses of one step under each of n graphs, matrix-free; zeros where a graph has fewer than L.

    A loss changes the stack z by xi u v^T z, with xi of mean 0 and variance 1, independent of all others: u is what it
    acts on, at the end of the step, v the difference between what the message brings and what takes its place, for the
    z at the beginning. A loss may act on the difference that a later one sees: with q_e = E[(v_e^T z)^2] at that time,

        q_e = v_e^T C v_e + sum_(f before e) R_ef q_f,    L[C] = sum_e q_e u_e u_e^T is added to A C A^T
    """

    into: FloatArray  # (n, L, d) u
    differences: FloatArray  # (n, L, d) v
    chain: FloatArray | None  # (n, L, L) (I - R)^-1; None where no loss acts on what another one sees

    def lost(self, moments: FloatArray) -> FloatArray:
        """(..., n, d, d): L[C] of the moments C (..., n, d, d)."""
        seen = ((self.differences @ moments) * self.differences).sum(axis=-1)
        if self.chain is not None:
            seen = (self.chain @ seen[..., None])[..., 0]
        return np.asarray(self.into.swapaxes(-1, -2) @ (seen[..., None] * self.into))

    def adjoint(self, forms: FloatArray) -> FloatArray:
        """(..., n, d, d): the adjoint of ``lost``, of forms Y (..., n, d, d)."""
        felt = ((self.into @ forms) * self.into).sum(axis=-1)
        if self.chain is not None:
            felt = (self.chain.swapaxes(-1, -2) @ felt[..., None])[..., 0]
        return np.asarray(self.differences.swapaxes(-1, -2) @ (felt[..., None] * self.differences))

    def uses(self) -> BoolArray:
        """(d, d): whether a loss changes coordinate a by what it sees in b, in any graph; too often with a chain."""
        found = np.zeros((self.into.shape[2],) * 2, dtype=np.bool_)
        for changed, seen in zip(self.into != 0.0, self.differences != 0.0, strict=True):
            if self.chain is None:
                found |= (changed.T.astype(float) @ seen.astype(float)) > 0.0
            else:
                found |= np.outer(changed.any(axis=0), seen.any(axis=0))
        return found

    def of_modes(self, modes: IntArray) -> LossEvents:
        """Those of some modes, from 0."""
        return LossEvents(self.into[modes], self.differences[modes], None if self.chain is None else self.chain[modes])

    def projected(self, basis: FloatArray) -> LossEvents:
        """In the coordinates that the columns of ``basis`` (d, d') span."""
        return LossEvents(self.into @ basis, self.differences @ basis, self.chain)


def whole_link_events(step: StepModel) -> LossEvents:
    """Of losses that take both directions of a link: with w_ij (x_j - x_i) goes w_ji (x_i - x_j), at the same time."""
    pairs = np.argwhere(np.triu((step.losses > 0.0) & (step.listens() | step.listens().T), 1))
    into, differences = np.zeros((2, step.modes, len(pairs), step.agents))
    for event, (i, j) in enumerate(pairs.tolist()):
        deviation = np.sqrt(step.losses[i, j] * (1.0 - step.losses[i, j]))
        into[:, event, i], into[:, event, j] = deviation * step.nominal[:, i, j], -deviation * step.nominal[:, j, i]
        differences[:, event, i], differences[:, event, j] = -1.0, 1.0
    return LossEvents(into, differences, None)


_Loss = tuple[int, int, int, float, float]
"""Entry that it changes; the entries that the message brings, and that take its place; probability; weight."""


Use = tuple[int, int, float, float]
"""Sender, entry of z, probability that the own value takes its place, and standard deviation of the link's noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A micro-step: the entries ``rows`` of z become matrix @ z, with losses, independent of each other."""

    rows: Sequence[int]
    matrix: FloatArray  # (r, K) mean over the losses
    noise: FloatArray  # (r, r) covariance of what is random and does not depend on z, mean over the losses
    losses: Sequence[_Loss]

    def events(self) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
        """Of every loss, the entry that it changes, those that the message brings and the loss, and the variance."""
        entry, brings, instead = (np.array([loss[part] for loss in self.losses], dtype=np.int64) for part in range(3))
        return entry, brings, instead, np.array([p * (1.0 - p) * weight**2 for *_, p, weight in self.losses])

    def apply(self, moments: FloatArray, share: float = 1.0) -> None:
        """Second moments (K, K) of z after the move, in place, weighted with the probability ``share``."""
        entry, brings, instead, variance = self.events()
        spread = moments[brings, brings] + moments[instead, instead] - 2.0 * moments[brings, instead]
        across = self.matrix @ moments
        moments[self.rows], moments[:, self.rows] = across, across.T
        moments[np.ix_(self.rows, self.rows)] = across @ self.matrix.T + share * self.noise
        np.add.at(moments, (entry, entry), variance * spread)


@dataclass(frozen=True, slots=True, eq=False)
class MessageSteps:
    """A jump linear system of k stacked numbers, not reduced. Modes are graphs, or graphs and states of channels."""

    matrices: FloatArray  # (n, k, k) mean over losses
    noise: FloatArray  # (n, k, k) covariance of what is random and does not depend on z
    losses: LossEvents | None
    chain: FloatArray  # (n, n)
    stationary: FloatArray  # (n,)
    graphs: IntArray  # (n,) graph of every mode
    # (k, 3) age in messages, receiver and sender of every entry; the receiver is -1 in what was published, and in the
    # first m, which are the agents
    origins: IntArray
    moves: list[list[Move]]  # the micro-steps of every mode, of all K entries
    kept: IntArray  # (k,) those of the K entries that are read from one step to the next
    entries: int  # K


def message_steps(step: StepModel) -> MessageSteps:
    """The period of a run with this synchronous step, message by message. InputError: too many links or channels."""
    stack = _Stack(step)
    channels = burst_channels(step)
    modes = loss_modes(step)
    periods = [_period(step, stack, graph, probability) for graph, probability in modes]
    burst_rates = np.array([step.losses[link] for link in channels])
    shares = np.where(_channel_states(step) > 0.0, burst_rates, 1.0 - burst_rates).prod(axis=1)
    matrices = np.stack([period.matrix for period in periods])
    losses = _stacked(periods)
    kept = _read(matrices, losses, step.agents)
    square = np.ix_(np.arange(len(modes)), kept, kept)
    return MessageSteps(
        matrices=matrices[square],
        noise=np.stack([period.noise for period in periods])[square],
        losses=losses and LossEvents(losses.into[:, :, kept], losses.differences[:, :, kept], losses.chain),
        chain=joint_chain(step, step.transition),
        stationary=np.asarray(np.kron(step.stationary, shares)),
        graphs=np.array([graph for graph, _ in modes]),
        origins=stack.origins[kept],
        moves=[period.moves for period in periods],
        kept=kept,
        entries=stack.size,
    )


class _Stack:
    """Where the entries of z are, before those that nobody reads are left out."""

    def __init__(self, step: StepModel) -> None:
        m, lines = step.agents, range(step.delay + 1)
        self._step = step
        listens = step.listens()
        held = np.argwhere(listens & (step.losses > 0.0) & step.holds)
        origins = [(0, -1, j) for j in range(m)]
        # Entries of what each agent published last, and 1, ..., d messages before; of what each receiver has heard.
        self.published = [list(range(m)) for _ in lines]
        self.heard: list[dict[tuple[int, int], int]] = [{} for _ in lines]
        for line in lines:
            if line or step.broadcast:
                self.published[line] = list(range(len(origins), len(origins) + m))
                origins += [(line, -1, j) for j in range(m)]
            for i, j in held.tolist():
                self.heard[line][i, j] = len(origins)
                origins.append((line, i, j))
        # Process noise that several agents feel must be the same for all of them, whenever they step.
        sources = (step.noise_gain != 0.0).any(axis=0)
        self.sources = list(range(len(origins), len(origins) + m)) if step.turns is not None else []
        if not self.sources or not (sources.sum(axis=0) > 1).any():
            self.sources = []
        self.origins = np.array(origins + [(-1, -1, -1)] * len(self.sources), dtype=np.int64)
        if len(origins) > MOST_VALUES:
            raise InputError(
                f"noise.on_loss: {len(held)} links of {m} agents make {len(origins)} values that are kept from step to "
                f"step; at most {MOST_VALUES} are predicted: use fewer agents or links, or own values"
            )

    @property
    def size(self) -> int:
        """K."""
        return len(self.origins)

    def use(self, receiver: int, sender: int, loss: float, link: float) -> Use:
        """What a receiver uses of a sender."""
        held = self.heard[-1].get((receiver, sender))
        return (sender, self.published[-1][sender], loss, link) if held is None else (sender, held, 0.0, 0.0)


class _Period:
    """The micro-steps of one period, composed: z is matrix @ (z at the beginning) + noise + the losses so far."""

    def __init__(self, size: int) -> None:
        self.matrix, self.noise = np.eye(size), np.zeros((size, size))
        self.into, self.differences = np.empty((0, size)), np.empty((0, size))
        self.acts: list[FloatArray] = []  # row by row, R of ``LossEvents``
        self.moves: list[Move] = []

    def step(self, move: Move, older: Sequence[tuple[int, int]] = ()) -> None:
        """Make a move; of ``older``, the first entry becomes what the second was."""
        if older:
            matrix = np.concatenate([move.matrix, _copies([before for _, before in older], len(self.noise))])
            noise = scipy.linalg.block_diag(move.noise, np.zeros((len(older), len(older))))
            move = Move([*move.rows, *(entry for entry, _ in older)], matrix, noise, move.losses)
        self.moves.append(move)
        entry, brings, instead, variance = move.events()
        differences = self.matrix[brings] - self.matrix[instead]
        self.acts += list((self.into[:, brings] - self.into[:, instead]).T ** 2)
        self.matrix[move.rows] = move.matrix @ self.matrix
        self.into[:, move.rows] = self.into @ move.matrix.T
        move.apply(self.noise)
        into = np.zeros((len(entry), len(self.noise)))
        into[range(len(entry)), entry] = np.sqrt(variance)
        self.into = np.concatenate([self.into, into])
        self.differences = np.concatenate([self.differences, differences])


def _period(step: StepModel, stack: _Stack, graph: int, probability: FloatArray) -> _Period:
    period, m = _Period(stack.size), step.agents
    if stack.sources:
        period.step(Move(stack.sources, np.zeros((m, stack.size)), np.eye(m), ()))
    turns = [list(range(m))] if step.turns is None else [[i] for i in step.turns.tolist()]
    for agents in turns:
        _move(period, step, stack, graph, probability, agents)
        if step.broadcast:
            newest = [stack.published[0][j] for j in agents]
            period.step(Move(newest, _copies(agents, stack.size), step.broadcast**2 * np.eye(len(agents)), ()))
        _hear(period, step, stack, probability, agents)
    return period


def _move(
    period: _Period, step: StepModel, stack: _Stack, graph: int, probability: FloatArray, agents: list[int]
) -> None:
    """These agents make their step, all at once; what they published before gets older."""
    gain = step.noise_gain[graph][agents]
    matrix, noise = np.zeros((len(agents), stack.size)), np.zeros((len(agents), len(agents)))
    losses: list[_Loss] = []
    for row, i in enumerate(agents):
        uses = [stack.use(i, j, float(probability[i, j]), step.link) for j in step.neighbours(graph, i).tolist()]
        noise[row, row], lost = add_uses(matrix[row], step.nominal[graph, i], i, i, i, uses)
        losses += lost
    if stack.sources:
        matrix[:, stack.sources] = gain
    else:
        noise += gain @ gain.T
    older = [(new[j], before[j]) for before, new in pairwise(stack.published) for j in agents]
    period.step(Move(agents, matrix, noise, losses), older)


def add_uses(
    row: FloatArray, weights: FloatArray, agent: int, own: int, new: int, uses: Iterable[Use]
) -> tuple[float, list[_Loss]]:
    """Add to the row (K,) what an agent with weights (m,) makes of ``own`` and ``uses``; its variance and losses."""
    row[own] += weights[agent]
    variance, losses = 0.0, list[_Loss]()
    for sender, source, p, link in uses:
        weight = float(weights[sender])
        row[source] += (1.0 - p) * weight
        row[own] += p * weight
        variance += (1.0 - p) * (weight * link) ** 2
        if 0.0 < p < 1.0:
            losses.append((new, source, own, p, weight))
    return variance, losses


def _hear(period: _Period, step: StepModel, stack: _Stack, probability: FloatArray, agents: list[int]) -> None:
    """What these agents publish is heard, or what was heard before is kept; and what was heard gets older."""
    entries = {link: entry for link, entry in stack.heard[0].items() if link[1] in agents}
    if entries:
        move = hear(step, probability, stack.published[0], entries, entries, stack.size)
        older = [(new[link], before[link]) for before, new in pairwise(stack.heard) for link in entries]
        period.step(move, older)


def hear(
    step: StepModel,
    probability: FloatArray,
    published: Sequence[int],
    before: Mapping[tuple[int, int], int],
    after: Mapping[tuple[int, int], int],
    size: int,
) -> Move:
    """Receivers hear what is published, or keep what they have heard; entries of z by link, and by sender."""
    matrix, noise = np.zeros((len(after), size)), np.zeros(len(after))
    losses: list[_Loss] = []
    for row, (link, entry) in enumerate(after.items()):
        p, newest = float(probability[link]), published[link[1]]
        matrix[row, newest], matrix[row, before[link]] = 1.0 - p, p
        noise[row] = (1.0 - p) * step.link**2
        if 0.0 < p < 1.0:
            losses.append((entry, newest, before[link], p, 1.0))
    return Move(list(after.values()), matrix, np.diag(noise), losses)


def _copies(entries: list[int], size: int) -> FloatArray:
    """(r, k) rows that pick entries."""
    rows = np.zeros((len(entries), size))
    rows[range(len(entries)), entries] = 1.0
    return rows


def _stacked(periods: list[_Period]) -> LossEvents | None:
    """The losses of all modes; None where there are none."""
    most = max(len(period.into) for period in periods)
    if not most:
        return None
    shape = len(periods), most, len(periods[0].noise)
    into, differences, acts = np.zeros(shape), np.zeros(shape), np.zeros((len(periods), most, most))
    for mode, period in enumerate(periods):
        count = len(period.into)
        into[mode, :count], differences[mode, :count] = period.into, period.differences
        for event, row in enumerate(period.acts):
            acts[mode, event, : len(row)] = row
    if not acts.any():
        return LossEvents(into, differences, None)
    eye = np.eye(most)
    chain = [scipy.linalg.solve_triangular(eye - one, eye, lower=True, unit_diagonal=True) for one in acts]
    return LossEvents(into, differences, np.stack(chain))


def _read(matrices: FloatArray, losses: LossEvents | None, agents: int) -> IntArray:
    """Entries on which a later state of an agent depends, ascending; the agents are among them."""
    uses = (matrices != 0.0).any(axis=0)
    if losses is not None:
        uses |= losses.uses()
    kept: BoolArray = np.arange(len(uses)) < agents
    while True:
        more = kept | uses[kept].any(axis=0)
        if (more == kept).all():
            return np.flatnonzero(kept)
        kept = more


def burst_channels(step: StepModel) -> list[tuple[int, int]]:
    """The links, receiver and sender, that lose messages in bursts."""
    lossy = step.listens() & (step.losses > 0.0)
    return [(i, j) for i, j in np.argwhere(lossy).tolist()] if step.burst is not None else []


def joint_chain(step: StepModel, graphs: FloatArray, frozen: Sequence[bool] = ()) -> FloatArray:
    """(n, n) chain of the graphs, which switch by ``graphs``, and of the channels; ``frozen`` ones stay as they are."""
    # The two states of a channel (Gilbert 1960): 0 delivers, 1 loses.
    chain, mends = graphs, 1.0 / (step.burst or 1.0)
    for number, link in enumerate(burst_channels(step)):
        fails = mends * float(step.losses[link]) / (1.0 - float(step.losses[link]))
        moving = np.array([[1.0 - fails, fails], [mends, 1.0 - mends]])
        chain = np.asarray(np.kron(chain, np.eye(2) if number < len(frozen) and frozen[number] else moving))
    return chain


def loss_modes(step: StepModel) -> list[tuple[int, FloatArray]]:
    """Graph of every mode, and (m, m) probabilities of losses, 0 or 1 on the links that lose in bursts."""
    receivers, senders = np.array(burst_channels(step), dtype=np.int64).reshape(-1, 2).T
    modes = []
    for graph, lost in product(range(step.modes), _channel_states(step)):
        probability = step.losses.copy()
        probability[receivers, senders] = lost
        modes.append((graph, probability))
    return modes


def _channel_states(step: StepModel) -> FloatArray:
    """(2^c, c): 1.0 where a channel loses, for every combination of states, in the order of Kronecker products."""
    channels = len(burst_channels(step))
    most = MOST_STATES if isinstance(step.switching, MarkovChain) else MOST_GIVEN
    if step.modes * 2**channels > most:
        raise InputError(
            f"noise.burst: {step.modes} graphs and {channels} links that lose messages make {step.modes} * "
            f"2^{channels} states of the network; at most {most} are predicted: give a loss to fewer links "
            "(noise.loss: arcs), or leave noise.burst out"
        )
    return np.array(list(product([0.0, 1.0], repeat=channels)))
