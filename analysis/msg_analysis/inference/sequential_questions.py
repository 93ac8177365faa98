# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Evidence on the system error: the martingale of its Poisson equation, exponentially tilted.

For f(y, g) = y^T Y_g y + kappa_g of ``errors.time_means`` and any rate l, exp(l f(y_k+1, g_k+1)) over its conditional
mean is a martingale factor. The mean is in closed form: given the next graph j, the next y is normal, so that of a
quadratic form is exp of another one; the graphs are then summed over. Replicas are averaged inside f.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import ClassVar
from weakref import WeakKeyDictionary

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.inference.e_values import (
    coefficient_evidence,
    log_means,
    log_sum,
    proportion_evidence,
    row_evidence,
    variance_evidence,
)
from msg_analysis.inference.time_means import Value, forms_of, values_of
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.moments import MomentSolver, mode_potential
from msg_analysis.theory.prediction import Prediction


@dataclass(slots=True, eq=False)
class RunningSums:
    """Sums over the steps before each of T looks, for m agents, n graphs and L rates of the system error."""

    impossible: IntArray  # (T,) steps in which an agent without noise moved
    samples: IntArray  # (T, m) innovations
    squares: FloatArray  # (T, m) of innovations over their standard deviations
    link_score: FloatArray  # (T, m, m) receiver, sender
    link_information: FloatArray  # (T, m, m)
    pair_score: FloatArray  # (T, m, m)
    pair_information: FloatArray  # (T, m, m)
    common_score: FloatArray  # (T,) of all gains at once
    common_information: FloatArray  # (T,)
    counts: IntArray  # (T, n, n) of steps from graph to graph
    messages: IntArray  # (T, m, m) of links that lose some
    lost: IntArray  # (T, m, m)
    broadcast_samples: IntArray  # (T,) of each agent
    broadcast_squares: FloatArray  # (T, m)
    error: FloatArray  # (T, L) logarithms of the martingales of the system error

    @classmethod
    def zeros(cls, looks: int, agents: int, graphs: int, rates: int) -> RunningSums:
        """Of no step."""

        def whole(*shape: int) -> IntArray:
            return np.zeros((looks, *shape), np.int64)

        def real(*shape: int) -> FloatArray:
            return np.zeros((looks, *shape))

        m, n = agents, graphs
        return cls(
            impossible=whole(),
            samples=whole(m),
            squares=real(m),
            link_score=real(m, m),
            link_information=real(m, m),
            pair_score=real(m, m),
            pair_information=real(m, m),
            common_score=real(),
            common_information=real(),
            counts=whole(n, n),
            messages=whole(m, m),
            lost=whole(m, m),
            broadcast_samples=whole(),
            broadcast_squares=real(m),
            error=real(rates),
        )

    def then(self, parts: RunningSums) -> RunningSums:
        """After each look, from the last sums of these and those between the looks."""
        added = {each.name: getattr(parts, each.name).cumsum(axis=0) for each in fields(self)}
        return RunningSums(**{name: getattr(self, name)[-1] + values for name, values in added.items()})

    def last(self) -> RunningSums:
        """After the last look only."""
        return RunningSums(**{each.name: getattr(self, each.name)[-1:].copy() for each in fields(self)})

    def merge(self, other: RunningSums) -> None:
        """Add the sums of another run, looked at as often."""
        for each in fields(self):
            getattr(self, each.name).__iadd__(getattr(other, each.name))


HORIZONS = (300.0, 1e3, 3e3, 1e4, 3e4, 1e5, 1e6)
"""Steps after which the rates find an error that shows then: one rate of either sign for each."""

DETECTED = 4.0  # size of such an error, in standard errors at that time: its evidence is then exp(8)
MOST_SHARE = 0.5  # of the rate beyond which the mean is infinite


class ErrorMartingale:
    """Steps of the logarithm of the martingale, for every rate (L,).

    ValueError for a system with lost messages, whose next state is not normal given this one.
    """

    _known: ClassVar[WeakKeyDictionary[MomentSolver, dict[int, ErrorMartingale]]] = WeakKeyDictionary()

    @classmethod
    def of(cls, prediction: Prediction, replicas: int) -> ErrorMartingale:
        """Made once for all runs with this prediction."""
        known = cls._known.setdefault(prediction.solver, {})
        if replicas not in known:
            known[replicas] = cls(prediction, replicas)
        return known[replicas]

    def __init__(self, prediction: Prediction, replicas: int) -> None:
        system = prediction.system
        if system.loss_variance is not None:
            raise ValueError("lost messages: the next state is not normal given this one")
        forms, _, trace = forms_of(system, "system")
        values = [value for value in values_of(prediction, forms) if isinstance(value, Value)]
        self._forms = values[0].forms[:, 0]  # (n, d, d), the same for every graph of this step
        self._kappa = mode_potential(system, self._forms[None])[1][0]  # (n,)
        self._system, self._replicas = system, replicas
        self.variance = _typical_variance(prediction, replicas, values, trace)
        self.rates = self._choose_rates()
        self.numbers = packed_symmetric.size(system.dimension) + 1
        self._value = np.concatenate([packed_symmetric.pack(self._forms), self._kappa[:, None]], axis=1)  # (n, p + 1)
        # (n, n, L, p + 1): log E[exp(l f(next)) | next graph j] = means[g, j, l] @ (s, 1)
        self._means = np.array([[self._tilted(g, j) for j in range(system.modes)] for g in range(system.modes)])
        with np.errstate(divide="ignore"):
            self._log_law = np.log(system.chain)

    def steps(self, modes: IntArray, following: IntArray, a: FloatArray, b: FloatArray) -> FloatArray:
        """(k, L): of steps with these graphs and next ones (k,), and (s, 1) before and after them, (k, p + 1) each."""
        found = np.empty((len(modes), len(self.rates)))
        for mode in np.unique(modes).tolist():
            at = np.flatnonzero(modes == mode)
            reached = (self._value[following[at]] * b[at]).sum(axis=1)
            means = np.einsum("jlp,kp->klj", self._means[mode], a[at], optimize=True)
            found[at] = reached[:, None] * self.rates - log_sum(means + self._log_law[mode], axis=2)
        return found

    def _choose_rates(self) -> FloatArray:
        """(L,); none where nothing is random."""
        if self.variance <= 0.0:
            return np.empty(0)
        largest = 0.0
        for noise in self._system.noise:
            root = _root(noise)
            largest = max(largest, float(np.abs(np.linalg.eigvalsh(root @ self._forms @ root)).max()))
        most = MOST_SHARE * self._replicas / (2.0 * largest) if largest else math.inf
        rates = np.unique(np.minimum(DETECTED / np.sqrt(np.array(HORIZONS) * self.variance), most))
        return np.concatenate([-rates[::-1], rates])

    def _tilted(self, mode: int, following: int) -> FloatArray:
        """(L, p + 1): see ``_means``."""
        system, d, r = self._system, self._system.dimension, self._replicas
        root, step = _root(system.noise[mode]), system.matrices[mode]
        form = (self.rates / r)[:, None, None] * self._forms[following]  # (L, d, d)
        seen = form @ root
        left = np.eye(d) - 2.0 * root @ seen
        tilted = form + 2.0 * seen @ np.linalg.solve(left, seen.transpose(0, 2, 1))
        tilted = (tilted + tilted.transpose(0, 2, 1)) / 2.0
        constants = self.rates * self._kappa[following] - 0.5 * r * np.linalg.slogdet(left)[1]
        return np.column_stack([r * packed_symmetric.pack(step.T @ tilted @ step), constants])


def _typical_variance(prediction: Prediction, replicas: int, values: Sequence[Value], trace: FloatArray) -> float:
    """Var(D_k) at the steady second moments: what rates are chosen by; nothing depends on its being exact."""
    total = 0.0
    law = prediction.system.stationary
    for value, moments, share in zip(values, prediction.steady, law, strict=True):
        a = np.append(packed_symmetric.pack(moments / share), 1.0)[None]
        total += share * float(value.variances(trace, a, replicas)[0])
    return total


def _root(covariance: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(values.clip(0.0))) @ vectors.T)


MAIN = ("noise", "gain", "switching", "loss")  # kinds of questions that one part of the law answers, not all at once
MAIN_SHARE = 0.75  # of these together in the mean, however many others there are


@dataclass(frozen=True, slots=True)
class Question:
    """What a part of the law says; agents and graphs from 0."""

    kind: str  # of ``EvidenceSums``
    agent: int | None = None
    other: int | None = None  # sender of a link, second agent of a pair
    graph: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LawQuestions:
    """What can be asked; the kinds are those of ``EvidenceSums``."""

    transition: FloatArray  # (n, n)
    losses: FloatArray  # (m, m) probabilities
    noisy: IntArray  # (a,) agents whose noise is asked about
    links: IntArray  # (L, 2) receivers and senders whose gains are; the same agent twice: pull of a leader
    pairs: IntArray  # (P, 2) agents whose noises may be common
    common: bool  # whether all gains at once are
    lossy: IntArray  # (l, 2) receivers and senders whose losses are
    error: bool  # whether the system error is

    @property
    def _rows(self) -> IntArray:
        """Graphs that are left some time."""
        return np.flatnonzero(np.diag(self.transition) < 1.0)

    def families(self, sums: RunningSums) -> dict[str, FloatArray]:
        """For each kind the evidence on its questions after each look, logarithms (T, questions, alternatives)."""
        found: dict[str, FloatArray] = {}
        noisy, rows = self.noisy, self._rows
        if len(noisy):
            found["noise"] = variance_evidence(sums.samples[:, noisy], sums.squares[:, noisy])
        if len(self.links):
            i, j = self.links.T
            found["gain"] = coefficient_evidence(sums.link_score[:, i, j], sums.link_information[:, i, j])
        if self.common:
            found["gains"] = coefficient_evidence(sums.common_score, sums.common_information)[:, None]
        if len(self.pairs):
            i, j = self.pairs.T
            found["pair"] = coefficient_evidence(sums.pair_score[:, i, j], sums.pair_information[:, i, j])
        if len(rows):
            each = row_evidence(sums.counts, self.transition)[:, rows]
            every = each.sum(axis=1, keepdims=True)  # rows are independent of each other
            found["switching"] = np.concatenate([each, every], axis=1)
        if len(self.lossy):
            i, j = self.lossy.T
            losses = self.losses[i, j]
            found["loss"] = proportion_evidence(sums.lost[:, i, j], sums.messages[:, i, j], losses)
        if sums.broadcast_samples.any():
            samples = np.broadcast_to(sums.broadcast_samples[:, None], sums.broadcast_squares.shape)
            found["broadcast"] = variance_evidence(samples, sums.broadcast_squares)
        if self.error:
            found["system error"] = sums.error[:, None]
        return found

    def question(self, kind: str, row: int) -> Question:
        """What a row of ``families`` is about."""
        if kind == "noise":
            return Question(kind, int(self.noisy[row]))
        if kind == "broadcast":
            return Question(kind, row)
        if kind == "switching":
            return Question(kind, graph=int(self._rows[row]) if row < len(self._rows) else None)
        if kind in ("gain", "pair", "loss"):
            places = {"gain": self.links, "pair": self.pairs, "loss": self.lossy}[kind]
            return Question(kind, int(places[row, 0]), int(places[row, 1]))
        return Question(kind)

    def log_evidence(self, sums: RunningSums, families: dict[str, FloatArray]) -> FloatArray:
        """(T,): log of the evidence against the whole law after each look, from that of ``families`` of any kind.

        The weighted mean over the kinds of the mean over questions.
        """
        total = np.zeros(len(sums.impossible))
        if families:
            each = log_means(list(families.values()))
            total = log_sum(each + np.log(kind_weights(list(families))), axis=1)
        never = sums.lost[:, self.losses == 0.0].any(axis=1)
        total[never | (sums.impossible > 0)] = np.inf
        return total


def kind_weights(kinds: list[str]) -> FloatArray:
    """Of kinds of questions in the mean, of sum 1: fixed before the run, since they depend on the law only."""
    main: BoolArray = np.array([kind in MAIN for kind in kinds])
    weights = np.where(main, MAIN_SHARE / max(main.sum(), 1), (1.0 - MAIN_SHARE) / max((~main).sum(), 1))
    return np.asarray(weights / weights.sum())


def question_words(question: Question, graphs: Sequence[str]) -> str:
    """What is asked, with agents by number and graphs by name."""
    agent = None if question.agent is None else question.agent + 1
    other = None if question.other is None else question.other + 1
    if question.kind == "gain":
        return f"gain of leader {agent}" if agent == other else f"gain of the link from agent {other} to agent {agent}"
    if question.kind == "loss":
        return f"losses from agent {other} to agent {agent}"
    if question.kind == "switching":
        return "switching" if question.graph is None else f"switching away from {graphs[question.graph]}"
    return {
        "noise": f"noise of agent {agent}",
        "gains": "all gains",
        "pair": f"common noise of agents {agent} and {other}",
        "broadcast": f"broadcast noise of agent {agent}",
        "system error": "system error",
    }[question.kind]
