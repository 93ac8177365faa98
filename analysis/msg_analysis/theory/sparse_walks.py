# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Sparse steps of a run, and vectors that go backwards through them, each on a path of the graphs of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.errors import NotAvailableError
from msg_analysis.experiment.graphs import Graph
from msg_analysis.model.step_model import step_matrices, turns

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment

FEW_GRAPHS = 8  # whose matrices are multiplied, and not the arcs of each walk
LONGEST, NEVER = 2**60, 1e-18  # steps, and probability in a step, that are not told from infinity and 0


class Law:
    """The step of a run, sparse. An arc is a pair of agents of which the first hears the second in some graph."""

    targets: IntArray  # (l,)
    sources: IntArray  # (l,)
    weights: FloatArray  # (l, n) W_ij
    rows: FloatArray  # (m, 1) or (m, n) sums of the rows of W

    def __init__(self, experiment: Experiment) -> None:
        links = experiment.links
        m, dt, noise = experiment.agents, experiment.step_length, experiment.noise
        if links is None and experiment.schedule:
            raise NotAvailableError("switching: the sequence of the graphs is given: expected a Markov chain for this")
        if experiment.protocol and (lines := experiment.protocol.unavailable("predict")):
            raise NotAvailableError(lines[0])
        self.agents, self.consensus, self.links = m, experiment.problem == "consensus", links
        self.leaves_out_steps = noise.leaves_out_steps  # then "links" are agents
        self.holds, self.delay, self.burst = noise.holds, noise.delay, noise.burst
        self.broadcast, self.link = noise.broadcast, noise.link
        if experiment.protocol or experiment.time == "discrete":
            self._dense(experiment)
        else:
            self._sparse(experiment, (links.mesh,) if links else experiment.graph_list)
        if links:  # arcs in the order of the links
            order = np.argsort(links.link_of, kind="stable")
            self.targets, self.sources, self.weights = self.targets[order], self.sources[order], self.weights[order]
            self.link_of, self.rates = links.link_of[order], np.stack([links.rise, links.fall])
            self.first = np.searchsorted(self.link_of, np.arange(len(links.rise) + 1))
        loss = experiment.loss[self.targets, self.sources]
        self.lossy = np.flatnonzero(loss)  # arcs on which messages can be lost
        ends = np.stack([self.targets, self.sources])[:, self.lossy]
        pairs = np.sort(ends, axis=0) if noise.whole_link else ends
        _, first, which = np.unique(pairs, axis=1, return_index=True, return_inverse=True)
        self.drawn = first[which.reshape(-1)]  # (lossy,) the one with whose messages those of each arc are lost
        # (3, lossy, 1) with which probability, after one that was not lost, and after one that was
        p, burst = loss[self.lossy, None], noise.burst
        self.losses = np.stack(
            [p, p, p] if burst is None else [p, p / (burst * (1.0 - p)), 0.0 * p + 1.0 - 1.0 / burst]
        )
        # The chain of the graphs backwards in time: probability to leave each one, and where to, as sums.
        chain = np.ones((1, 1)) if links else experiment.chain.transition(dt)
        self.stationary = np.ones(1) if links else experiment.switching_law.stationary
        jumps = chain.T * self.stationary / self.stationary[:, None]
        np.fill_diagonal(jumps, 0.0)
        self.leave = jumps.sum(axis=1)
        self.jumps = np.cumsum(jumps, axis=1) / np.maximum(self.leave, NEVER)[:, None]
        arcs = np.arange(len(self.targets))
        own, into = (
            sparse.csr_array((np.ones(len(arcs)), (ends, arcs)), (m, len(arcs)))
            for ends in (self.targets, self.sources)
        )
        self.flow = sparse.csr_array(into - own)  # (m, l) what is used of a message goes from who used it to its sender
        turn = turns(experiment)
        self.plain = not (self.delay or self.holds or self.broadcast or self.link or turn is not None)
        self.products: list[Any] = []  # W^T of every graph (m, m), where nothing else is random
        if self.plain and not len(self.lossy) and not links and len(chain) <= FEW_GRAPHS:
            for mode, weights in enumerate(self.weights.T):
                same = sparse.diags_array(self.rows[:, mode % self.rows.shape[1]])
                self.products.append(sparse.csr_array(same + self.flow @ sparse.diags_array(weights) @ own.T))
        if self.plain:
            return
        # In real time agents step one after the other: backwards, the last one first.
        self.ahead, groups = np.zeros(len(arcs), dtype=np.int64), [np.arange(m)]
        if turn is not None:
            ranks = np.argsort(turn)
            self.ahead = (ranks[self.sources] < ranks[self.targets]).astype(np.int64)
            groups = [np.array([i]) for i in turn[::-1].tolist()]
        self.groups = []
        for agents in groups:
            heard, said = (np.flatnonzero(np.isin(ends, agents)) for ends in (self.targets, self.sources))
            place = np.searchsorted(agents, self.targets[heard])
            self.groups.append((agents, heard, said, place, own[agents][:, heard], into[agents][:, said]))

    def _dense(self, experiment: Experiment) -> None:
        """Of a protocol, or exp(-Z)."""
        matrices = step_matrices(experiment)
        arcs = (matrices.weights != 0.0).any(axis=0) & ~np.eye(self.agents, dtype=np.bool_)
        self.targets, self.sources = np.nonzero(arcs)
        self.weights = np.ascontiguousarray(matrices.weights[:, self.targets, self.sources].T)
        self.rows = matrices.weights.sum(axis=2).T
        self._feel([gain.T for gain in matrices.noise_gain])

    def _sparse(self, experiment: Experiment, graphs: Sequence[Graph]) -> None:
        """Of the built-in law, with these graphs."""
        m, dt, gains = self.agents, experiment.step_length, experiment.leader_gains
        keys, place = np.unique(np.concatenate([g.targets * m + g.sources for g in graphs]), return_inverse=True)
        self.targets, self.sources = np.divmod(keys, m)
        grounded = np.isinf(gains)
        self.weights = np.zeros((len(keys), len(graphs)))
        mode = np.repeat(np.arange(len(graphs)), [len(graph.weights) for graph in graphs])
        self.weights[place, mode] = dt * np.concatenate([graph.weights for graph in graphs])
        self.weights[grounded[self.targets]] = 0.0
        self.rows = np.where(grounded, 0.0, 1.0 - dt * np.where(grounded, 0.0, gains))[:, None]
        process, free = experiment.noise.process, np.where(grounded, 0.0, math.sqrt(dt))
        given = list(experiment.noise_gain[: len(graphs)]) if isinstance(process, dict) else [process]
        forms = [np.asarray(gain, dtype=float) for gain in given]
        self._feel([(f * free[:, None]).T if f.ndim == 2 else sparse.diags_array(f * free) for f in forms])

    def _feel(self, gains: Sequence[Any]) -> None:
        """Take B^T (m, m) of every graph, or of all of them."""
        self.gains = [sparse.csr_array(gain) for gain in gains]
        self.squares: FloatArray | None = None  # (m, 1) or (m, n) of B, where it is diagonal
        if all(gain.count_nonzero() == np.count_nonzero(gain.diagonal()) for gain in self.gains):
            self.squares = np.stack([gain.diagonal() ** 2 for gain in self.gains], axis=1)
        on_air = (self.broadcast**2 + self.link**2) * (self.weights**2).sum() / self.weights.shape[1]
        process = np.mean([(gain.data**2).sum() for gain in self.gains])
        self.noise = float(process + on_air) / self.agents  # of an agent in a step, in the mean


class Walk:
    """Vectors (m, C), each of which goes backwards through the steps of a path of its own."""

    def __init__(self, law: Law, z: FloatArray, rng: np.random.Generator) -> None:
        self.law, self.steps, self._rng, self.z = law, 0, rng, z
        count = z.shape[1]
        self.modes: IntArray = np.asarray(rng.choice(len(law.stationary), count, p=law.stationary))
        self._until = self._held(law.leave[self.modes])
        self.up = self._flip = np.empty((0, count), dtype=np.int64)
        self._shared = not law.links and (bool(law.products) or law.weights.shape[1] == 1)
        self._weights = law.weights if self._shared else law.weights[:, self.modes]
        if law.links:  # each link starts in its stationary law
            up = rng.random((law.rates.shape[1], count)) * law.rates.sum(axis=0)[:, None] < law.rates[0, :, None]
            self.up = up.astype(np.int64)
            self._flip = self._held(law.rates[self.up, np.arange(len(up))[:, None]])
            self._weights = law.weights * up[law.link_of]
        self._lost = np.zeros((len(law.targets) if len(law.lossy) else 0, count), dtype=np.bool_)
        if len(law.lossy):
            self._lost[law.lossy] = (rng.random((len(law.lossy), count)) < law.losses[0])[law.drawn]
        # What was used of the messages of d + 2 steps, and what passes on to an earlier message.
        self._used = np.zeros((law.delay + 2, 0 if law.plain else len(law.targets), count))
        self._passed = np.zeros((len(law.targets) if law.holds else 0, count))

    def _held(self, leave: FloatArray) -> IntArray:
        """After how many steps something happens that has these probabilities in a step."""
        held = self._rng.geometric(np.maximum(leave, NEVER))
        return np.minimum(held, LONGEST).astype(np.int64) + self.steps

    def switch(self) -> None:
        """Go on by a step to its graphs and losses."""
        law = self.law
        if self.steps:
            self._flip_graphs()
        self.steps += 1
        if len(law.lossy):
            chance = law.losses[1]
            if law.burst is not None:
                chance = np.where(self._lost[law.lossy], law.losses[2], chance)
            self._lost[law.lossy] = (self._rng.random((len(law.lossy), self.z.shape[1])) < chance)[law.drawn]

    def weights(self) -> FloatArray:
        """(l, C) of the messages that arrive."""
        weights = self._weights if not self._shared or len(self._weights[0]) == 1 else self._weights[:, self.modes]
        return weights * ~self._lost if len(self.law.lossy) else weights

    def _flip_graphs(self) -> None:
        """The graphs one step earlier: a stationary chain of two states is the same backwards."""
        law = self.law
        if (ends := np.flatnonzero(self._until == self.steps)).size:
            jumps = law.jumps[self.modes[ends]]
            self.modes[ends] = new = (self._rng.random((len(ends), 1)) > jumps).sum(axis=1)
            self._until[ends] = self._held(law.leave[new])
            if not self._shared:
                self._weights[:, ends] = law.weights[:, new]
        if (ends := np.flatnonzero(self._flip == self.steps)).size:
            link, column = np.divmod(ends, self._flip.shape[1])
            self.up[link, column] ^= 1
            up = self.up[link, column]
            self._flip[link, column] = self._held(law.rates[up, link])
            arc, last = law.first[link], law.first[link + 1]
            while (more := arc < last).any():
                self._weights[arc[more], column[more]] = law.weights[arc[more], 0] * up[more]
                arc = arc + 1

    def back(self) -> FloatArray:
        """Go back by a step: (C,) the terms of its noise."""
        law = self.law
        self.switch()
        if not law.plain:
            return self._messages()
        terms = self._noise(self.z)
        for mode, product in enumerate(law.products):
            there = self.modes == mode
            if there.all():
                self.z = product @ self.z
                break
            if there.any():
                self.z[:, there] = product @ self.z[:, there]
        if not law.products:
            flow = self.weights() * self.z[law.targets]
            self.z = self.rows() * self.z + law.flow @ flow
        return terms

    def _messages(self) -> FloatArray:
        """The same with messages that are noisy, late or held, or agents that step one after the other."""
        law, depth, terms = self.law, len(self._used), np.zeros(self.z.shape[1])
        noisy, rows = np.empty_like(self.z), self.rows()
        for agents, heard, said, place, own, into in law.groups:
            # The message of the state after this step, which later steps have used.
            message = self._used[(1 - self.steps) % depth, said]
            if law.holds:
                message += self._passed[said]
                self._passed[said] = message * self._lost[said]
                message *= ~self._lost[said]
            published = into @ message
            terms += law.link**2 * (message**2).sum(axis=0) + law.broadcast**2 * (published**2).sum(axis=0)
            noisy[agents] = z = self.z[agents] + published
            flow = self._weights[heard] * z[place]
            if len(law.lossy) and not law.holds:
                flow *= ~self._lost[heard]
            self.z[agents] = rows[agents] * z - own @ flow
            self._used[(law.ahead[heard] - self.steps - law.delay) % depth, heard] = flow
        return terms + self._noise(noisy)

    def rows(self) -> FloatArray:
        """(m, 1) or (m, C) sums of the rows of W; 1 of an agent that leaves out the step, unless it is held."""
        rows = self._of_graphs(self.law.rows)
        return np.where((self.up == 0) & (rows != 0.0), 1.0, rows) if self.law.leaves_out_steps else rows

    def _of_graphs(self, table: FloatArray) -> FloatArray:
        """The columns of the present graphs, of a table (m, n); of one (m, 1), the only one."""
        return table if table.shape[1] == 1 else table[:, self.modes]

    def _noise(self, z: FloatArray) -> FloatArray:
        """(C,) |B^T z|^2, of the agents that make the step."""
        z = z * self.up if self.law.leaves_out_steps else z
        if self.law.squares is not None:
            return np.asarray(np.einsum("ic,ic->c", z * self._of_graphs(self.law.squares), z))
        terms = np.zeros(z.shape[1])
        for mode, gain in enumerate(self.law.gains):
            there = self.modes == mode if len(self.law.gains) > 1 else slice(None)
            terms[there] = ((gain @ z[:, there]) ** 2).sum(axis=0)
        return terms

    def block(self, steps: int, ended: Callable[[], bool]) -> tuple[FloatArray, FloatArray] | None:
        """(C,) terms of the sum over these steps, and |z|^2 after them, of what messages carry, too; None: ended."""
        terms = np.zeros(self.z.shape[1])
        for _ in range(steps):
            terms += self.back()
            if ended():
                return None
        return terms, (self.z**2).sum(axis=0) + (self._used**2).sum(axis=(0, 1)) + (self._passed**2).sum(axis=0)

    def keep(self, lives: BoolArray) -> None:
        """Only these vectors go on."""
        if lives.all():
            return
        for name in ("z", "modes", "_until", "up", "_flip", "_lost", "_used", "_passed"):
            setattr(self, name, getattr(self, name)[..., lives])
        if not self._shared:
            self._weights = self._weights[:, lives]
