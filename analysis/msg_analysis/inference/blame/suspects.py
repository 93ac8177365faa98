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

"""Scores of the parameters that may be wrong (gains, noise, messages), and the single causes searched for.

Every group has parameters with a score s and its information J, so that a change c of them gives s the mean J c.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from msg_analysis.inference.hypothesis_tests.gain_regression import Term
from msg_analysis.inference.hypothesis_tests.innovations import InnovationSums
from msg_analysis.inference.hypothesis_tests.losses import LossTally
from msg_analysis.inference.observed.heard_values import NO_NOISE
from msg_analysis.inference.statistics.forward_selection import Candidate
from msg_analysis.inference.statistics.known_covariance import pseudo_inverse
from msg_analysis.types import BoolArray, FloatArray

MIN_SAMPLES = 30  # fewest innovations for a variance
MAX_PARAMETERS = 600  # most parameters whose information is inverted


@dataclass(frozen=True, slots=True, eq=False)
class Suspects:
    """A group of parameters that may be wrong."""

    score: FloatArray  # (K,)
    information: FloatArray  # (K, K)
    classes: list[list[Candidate]]  # candidates, class by class; the more specific of equal ones first


def frozen(sums: InnovationSums) -> list[tuple[int, int, int]]:
    """(agent, steps in which it did not move, steps) of agents that cannot have stood still with their noise."""
    noisy = np.sqrt(np.diagonal(sums.noises, axis1=1, axis2=2)) > 1e-12 * sums.largest
    still, steps = (sums.still * noisy).sum(axis=0), (sums.steps[:, None] * noisy).sum(axis=0)
    # One or two unmoved steps may be a coincidence of rounding.
    return [(i, int(still[i]), int(steps[i])) for i in np.flatnonzero(still >= 3).tolist()]


def gains(sums: InnovationSums, pardoned: Iterable[int]) -> Suspects | None:
    """Parameters of the regression on what the agents heard, without the ``pardoned``; None where it is not available.

    Changes of gains are relative, those of the reference and of offsets (per step) absolute. The score G C^-1 U and the
    information G C^-1 G follow from the regression's score U, covariance C and gram G.
    """
    if sums.gram is None or len(sums.terms) > MAX_PARAMETERS:
        return None
    out = set(pardoned)
    kept = np.array([a for a, term in enumerate(sums.terms) if term.agent not in out], dtype=np.int64)
    if not kept.size:
        return None
    square = np.ix_(kept, kept)
    inverse = pseudo_inverse(sums.covariance[square])
    back = sums.gram[square] @ inverse
    score, information = np.zeros(len(sums.terms)), np.zeros_like(sums.gram)
    score[kept], information[square] = back @ sums.score[kept], back @ sums.gram[square]
    return Suspects(score, information, _gain_classes(sums.terms))


def _gain_classes(terms: Sequence[Term]) -> list[list[Candidate]]:
    weights = np.array([term.weight for term in terms])

    def group(kind: str, part: str, of: Callable[[Term], Hashable]) -> list[Candidate]:
        """One candidate for each value of ``of`` over the terms of a kind."""
        found: dict[Hashable, FloatArray] = {}
        for a, term in enumerate(terms):
            if term.kind == kind:
                found.setdefault(of(term), np.zeros(len(terms)))[a] = weights[a]
        return [Candidate(part, key, direction) for key, direction in found.items()]

    def pair(term: Term) -> Hashable:
        return frozenset((term.agent, term.sender))

    classes = [
        group("link", "link", lambda t: (t.sender, t.agent, None)),
        group("link", "link", lambda t: (t.sender, t.agent, t.graph)),
        group("link", "edge", lambda t: (pair(t), None)),
        group("link", "edge", lambda t: (pair(t), t.graph)),
        group("link", "receiver", lambda t: t.agent),
        group("link", "sender", lambda t: t.sender),
        group("link", "graph", lambda t: t.graph),
        group("link", "all", lambda _: None),
        group("lead", "leader", lambda t: t.agent),
        group("lead", "leaders", lambda _: None),
        group("pull", "receiver", lambda t: t.agent),
        group("pull", "receiver in graph", lambda t: (t.agent, t.graph)),
        group("pull", "graph", lambda t: t.graph),
        group("pull", "all", lambda _: None),
        group("constant", "offset", lambda t: t.agent),
        [Candidate("reference", None, _reference(terms))],
    ]
    return [found for found in classes if any(candidate.direction.any() for candidate in found)]


def _reference(terms: Sequence[Term]) -> FloatArray:
    """(K,): effect of a reference that is larger by 1: leaders are pulled that much higher."""
    pulls: dict[int, list[float]] = {}
    for term in terms:
        if term.kind == "lead":
            pulls.setdefault(term.agent, []).append(-term.weight)
    return np.array(
        [np.mean(pulls[term.agent]) if term.kind == "constant" and term.agent in pulls else 0.0 for term in terms]
    )


def noise(sums: InnovationSums, pardoned: Iterable[int], change: FloatArray) -> Suspects | None:
    """Logarithms of the noise variances over their nominal values, by graph and agent; None without usable ones.

    Left out are the ``pardoned`` agents, and what the coefficients ``change`` (K,) of the regression explain.
    """
    n, m = sums.still.shape
    out = np.zeros(m, np.bool_)
    out[list(pardoned)] = True
    should = np.diagonal(sums.noises, axis1=1, axis2=2)
    squares = np.diagonal(sums.scatter, axis1=1, axis2=2) - _explained(sums, change)
    usable: BoolArray = (should > NO_NOISE * should.max(initial=0.0)) & (sums.samples >= MIN_SAMPLES)[:, None] & ~out
    usable &= squares > 0.0
    cells = np.argwhere(usable)
    if not 0 < len(cells) <= MAX_PARAMETERS:
        return None
    graph, agent = cells.T
    ratios = np.log(squares[graph, agent] / (sums.samples[graph] * should[graph, agent]))
    root = np.sqrt(should[graph, agent])
    # Cells of different graphs are independent; their entries here are not used.
    correlation = sums.noises[graph[:, None], agent[:, None], agent] / (root[:, None] * root)
    covariance = np.where(graph[:, None] == graph, 2.0 * correlation**2 / sums.samples[graph][:, None], 0.0)
    information = pseudo_inverse(covariance)
    classes = [
        [Candidate("agent", int(i), (agent == i) * 1.0) for i in np.unique(agent)],
        [Candidate("agent in graph", (int(i), int(g)), np.eye(len(cells))[c]) for c, (g, i) in enumerate(cells)],
        [Candidate("graph", int(g), (graph == g) * 1.0) for g in np.unique(graph)],
        [Candidate("all", None, np.ones(len(cells)))],
    ]
    return Suspects(information @ ratios, information, classes if n > 1 else [classes[0], classes[3]])


def variances(squares: FloatArray, samples: int) -> Suspects:
    """Logarithms of the variances of m kinds of independent normal numbers, nominally 1.

    ``squares`` (m,) are sums of squares of as many numbers as ``samples``.
    """
    information = np.eye(len(squares)) * samples / 2.0
    classes = [
        [Candidate("agent", i, row) for i, row in enumerate(np.eye(len(squares)))],
        [Candidate("all", None, np.ones(len(squares)))],
    ]
    return Suspects(information @ np.log(np.maximum(squares, 1e-300) / samples), information, classes)


def losses(tally: LossTally) -> Suspects:
    """Log-odds of losing a message, link by link."""
    pairs = tally.pairs
    score, information = tally.score()
    # Other links say nothing; one that should lose nothing, but does, is all but impossible.
    usable = (tally.probability > 0.0) | (tally.lost > 0)
    information = np.where(usable & (information == 0.0), 1e-9 * tally.messages, information)
    identity = np.eye(len(pairs))
    classes = [
        [Candidate("link", (int(j), int(i)), identity[a]) for a, (i, j) in enumerate(pairs) if usable[a]],
        [Candidate("receiver", int(i), (pairs[:, 0] == i) * usable.astype(float)) for i in np.unique(pairs[usable, 0])],
        [Candidate("sender", int(j), (pairs[:, 1] == j) * usable.astype(float)) for j in np.unique(pairs[usable, 1])],
        [Candidate("all", None, usable.astype(float))],
    ]
    return Suspects(np.asarray(score), np.diag(information), classes)


def _explained(sums: InnovationSums, change: FloatArray) -> FloatArray:
    """(n, m): how much smaller the sums of squares are with this change of the law."""
    n, m = sums.still.shape
    explained = np.zeros((n, m))
    touched = np.flatnonzero(change)
    if sums.gram is None or not touched.size:
        return explained
    shares = sums.samples / max(int(sums.samples.sum()), 1)
    gram = sums.gram[np.ix_(touched, touched)]
    for place, a in enumerate(touched.tolist()):
        term, c = sums.terms[a], change[touched]
        less = c[place] * (2.0 * sums.score[a] - gram[place] @ c)
        explained[:, term.agent] += less * (shares if term.graph is None else np.arange(n) == term.graph)
    return explained
