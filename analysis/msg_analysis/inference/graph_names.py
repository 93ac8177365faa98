# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The question whether the log calls the graphs by their names."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import permutations
from typing import Self

import numpy as np

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.inference.e_values import WindowEvidence, Windows, log_mean
from msg_analysis.inference.question import Block, Diagnostic, Finding, Largest, Law, Place
from msg_analysis.inference.received_values import ReceivedValues
from msg_analysis.inference.residuals import received_residuals

MOST_GRAPHS = 20  # of a law for which this is tested
MOST_PERMUTED = 6  # graphs of which all permutations are tried; of more, only those of two


class SwappedGraphs(Diagnostic):
    """Likelihood ratios of two graphs whose names are swapped, in windows of 1, 2, 4, ... steps, for every pair.

    And of every permutation of the names in the whole run.
    """

    name = "residuals: swapped graphs"
    meaning = "two graphs have each other's name in the log"
    kind = "graph"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        self._step = step = law.step
        tested = law.lockstep and law.apart and law.noisy.all() and step.modes <= MOST_GRAPHS
        self._pairs: IntArray = np.column_stack(np.triu_indices(step.modes if tested else 0, 1))  # (P, 2)
        self._variance = np.square(step.noise_gain).sum(axis=2)  # (n, m) of process noise
        self._windows = Windows(law.planned, len(self._pairs))
        self._evidence = WindowEvidence(self._windows, len(self._pairs))
        self._best = Largest(-np.inf, (0, 0))
        n = step.modes if tested else 0
        orders = list(permutations(range(n)))[1:] if n <= MOST_PERMUTED else [_swap(n, *pair) for pair in self._pairs]
        self._orders: IntArray = np.array(orders, dtype=np.int64).reshape(len(orders), n)  # (P, n) what each name means
        self._likelihood = np.zeros((n, n))  # log likelihood ratio of each graph in the steps that are logged as each

    def add(self, block: Block) -> FloatArray:
        """The windows that end in the block."""
        if not len(self._pairs):
            return np.empty((block.analyses.count, 0, 1))
        # The product over the steps of a window is evidence, so is the mean over windows and pairs; 1 / it is the p.
        logged, modes = _log_density(block.white, block.scale), block.reception.modes
        density = self._densities(block, logged)
        between = np.zeros((block.analyses.count, *self._likelihood.shape))
        np.add.at(between, (block.analyses.after(np.arange(len(modes))), modes), density - logged[:, None])
        likelihood = self._likelihood + between.cumsum(axis=0)
        self._likelihood = likelihood[-1]
        first, second = self._pairs.T
        swapped = np.where(modes[:, None] == first, density[:, second], logged[:, None])
        swapped = np.where(modes[:, None] == second, density[:, first], swapped)
        ended = self._windows.add(swapped - logged[:, None])
        level = ended.level
        evidence = self._evidence.add(ended, ended.sums, block.analyses)
        values = ended.sums - np.log(self._windows.planned[level])[:, None]
        at, pair = np.unravel_index(int(np.argmax(values)), values.shape)
        start = int(ended.first[at]) + 1
        place = Place(start, start + (1 << int(level[at])) - 1)
        self._best.take(float(values[at, pair]), tuple(self._pairs[pair].tolist()), place)
        return np.append(evidence, log_mean(self._renamed(likelihood), axis=1)[:, None], axis=1)[:, :, None]

    def _densities(self, block: Block, logged: FloatArray) -> FloatArray:
        """(b, n) log density of each step if its graph were another, given the values that were received."""
        # The log says of the d-th neighbour what was used, whichever agent that is.
        step, known = self._step, block.reception
        steps = block.first + np.arange(len(logged))
        newest = np.broadcast_to(np.maximum(steps - step.delay, 0)[:, None, None], known.used.shape)
        used = known.used if step.loss else newest
        density = np.empty((len(logged), step.modes))
        for graph, variance in enumerate(self._variance):
            graphs = np.full(known.graphs.shape, graph)
            other = ReceivedValues.by(step, graphs[:, 0], graphs, used, known.states, known.published)
            deviation = np.sqrt(variance + other.link_variance)
            white = received_residuals(step, other, block.after) / deviation[:, :, None]
            density[:, graph] = _log_density(white, deviation)
        # With a delay the message with x(0), and the noise in it, is used in several steps.
        again = steps <= step.delay if step.link and step.delay else steps < 0
        return np.where(again[:, None], logged[:, None], density)

    def _renamed(self, likelihood: FloatArray) -> FloatArray:
        """(..., P): of the permutations, from log likelihood ratios (..., n, n)."""
        change = likelihood - np.einsum("...gg->...g", likelihood)[..., None]
        return np.asarray(change[..., np.arange(likelihood.shape[-1]), self._orders].sum(axis=-1))

    def merge(self, other: Self) -> None:
        """The window with more evidence."""
        self._evidence.merge(other._evidence)
        self._best.merge(other._best)
        self._likelihood = self._likelihood + other._likelihood

    def finding(self) -> Finding | None:
        """The window and the pair with the most evidence, or the names in the whole run."""
        if not len(self._pairs) or not self._windows.steps:
            return None
        graph, other = map(int, self._best.of)
        log_p = min(0.0, -float(log_mean(self.logarithms()[:, 0])))
        renamed = self._renamed(self._likelihood)
        best = int(np.argmax(renamed))
        if renamed[best] - math.log(len(renamed)) > self._best.value:
            return Finding(log_p, renamed=tuple(self._orders[best].tolist()))
        return Finding(log_p, graph=graph, other=other, place=self._best.place)

    @classmethod
    def explains_others(cls, found: Finding) -> bool:
        """Where the whole run has other names, all else was computed with the wrong law."""
        return bool(found.renamed)

    def logarithms(self) -> FloatArray:
        """(pairs + 1, 1)."""
        if not len(self._pairs):
            return np.empty((0, 1))
        return np.append(self._evidence.logarithms(), log_mean(self._renamed(self._likelihood)))[:, None]

    def about(self, row: int) -> str:
        """Two graphs."""
        if row == len(self._pairs):
            return "names of the graphs in the whole run"
        first, second = (self.law.graphs[graph] for graph in self._pairs[row].tolist())
        return f"names of the graphs {first} and {second} swapped"

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """Two names, or more."""
        moved = [names[graph] for graph, meant in enumerate(found.renamed) if meant != graph]
        if len(moved) == 2:
            return f"the log has the names of the graphs {' and '.join(moved)} swapped in the whole run"
        if moved:
            meant = [names[other] for graph, other in enumerate(found.renamed) if other != graph]
            each = ", ".join(f"{name} means {other}" for name, other in zip(moved, meant, strict=True))
            return f"the log has the names of the graphs exchanged in the whole run: {each}"
        pair = " and ".join(names[graph] for graph in (found.graph, found.other) if graph is not None)
        words = f"the log has the names of the graphs {pair} swapped"
        return f"{words} {found.place.words}" if found.place else words


def _swap(graphs: int, first: int, second: int) -> IntArray:
    """(n,): the permutation of two."""
    order = np.arange(graphs)
    order[[first, second]] = second, first
    return order


def _log_density(white: FloatArray, deviation: FloatArray) -> FloatArray:
    """(b,) log density of all residuals of a step but for a constant; standardised ones (b, m, R)."""
    return np.asarray(-0.5 * (white**2).sum(axis=(1, 2)) - white.shape[2] * np.log(deviation).sum(axis=-1))
