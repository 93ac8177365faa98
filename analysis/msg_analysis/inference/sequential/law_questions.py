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

"""The questions that sums over steps answer about a law, and the evidence on them (docs/statistics.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msg_analysis.inference.evidence.mixture_evidence import (
    coefficient_evidence,
    log_means,
    log_sum,
    proportion_evidence,
    row_evidence,
    variance_evidence,
)
from msg_analysis.inference.sequential.running_sums import RunningSums
from msg_analysis.types import BoolArray, FloatArray, IntArray

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
