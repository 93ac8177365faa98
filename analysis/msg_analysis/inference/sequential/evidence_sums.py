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

"""Running sums over the steps of runs, which give the evidence on every question at any time (docs/statistics.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from msg_analysis.inference.departures.departure import Block, Law
from msg_analysis.inference.departures.departures import Departures
from msg_analysis.inference.errors.time_means import moments
from msg_analysis.inference.hypothesis_tests.innovations import QUIET_ROUNDING, innovations
from msg_analysis.inference.observed.heard_values import NO_NOISE, HeardValues, process_noise
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.inference.sequential.error_martingale import ErrorMartingale
from msg_analysis.inference.statistics.mixture_evidence import (
    coefficient_evidence,
    log_means,
    log_sum,
    proportion_evidence,
    row_evidence,
    variance_evidence,
)
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.theory.prediction import Prediction
from msg_analysis.types import BoolArray, FloatArray, IntArray

MOST_PAIRS = 5_000  # of agents whose noises are compared; beyond, none are
MAIN = ("noise", "gain", "switching", "loss")  # kinds of questions that one part of the law answers, not all at once
FARTHEST = 1e4
"""Standard deviations of the noise: the squares of larger numbers, 1e8, would lose more than 8 of 16 digits."""
MAIN_SHARE = 0.75  # of these together in the mean, however many others there are


@dataclass(frozen=True, slots=True)
class Question:
    """What a part of the law says; agents and graphs from 0."""

    kind: str  # see ``EvidenceSums``
    agent: int | None = None
    other: int | None = None  # sender of a link, second agent of a pair
    graph: int | None = None


class EvidenceSums:
    """Sums for the families of questions, each of which counts the same in the evidence on the whole law:

    "noise" of an agent, "gain" of a link or of a leader's pull, "gains" of all at once, "pair" of noises, "switching"
    away from a graph, "loss" of a link, "broadcast" noise of an agent, "system error". Given its past and, on the air
    and in real time, what was heard, each is exact; the system error only in lockstep without noise or loss on the air.
    With ``in_detail``, the kinds of ``departures`` are added, which take as much time as all others together.
    """

    def __init__(self, prediction: Prediction, replicas: int, *, in_detail: bool = False) -> None:
        experiment, step = prediction.experiment, prediction.step
        noise, m = experiment.noise, step.agents
        self._step, self._noise = step, noise
        real_time = experiment.run.pace == "realtime"
        self.plain = not (noise.on_air or noise.delay or real_time)  # all agents hear the states themselves
        # A message that is used twice has the same noise both times.
        self._independent = independent = not (noise.link and (step.holds or real_time))
        self._process = np.array([process_noise(step, np.full(m, g)) for g in range(step.modes)])  # (n, m, m)
        variances = np.diagonal(self._process, axis1=1, axis2=2)
        self._floor = NO_NOISE * float(variances.max(initial=0.0))
        # (m,) agents whose questions can be asked
        self.noisy: BoolArray = np.asarray((variances > self._floor).all(axis=0) & independent)
        correlated = bool((self._process * ~np.eye(m, dtype=bool)).any())
        # In real time a value that is used may contain a part of the noise of the same step.
        usable = self.noisy if not (real_time and correlated) else np.zeros(m, dtype=bool)
        pull = np.abs(step.nominal.sum(axis=2) - 1.0).max(axis=0) > 1e-12
        self._pulled = pull
        self._quadratic = self.plain and bool((variances > self._floor).all())
        self.links: IntArray = np.argwhere((step.listens() | np.diag(pull)) & usable[:, None])  # (L, 2)
        first, second = np.triu_indices(m, 1)
        paired = usable[first] & usable[second] & (len(first) <= MOST_PAIRS) & (not correlated)
        self.pairs: IntArray = np.column_stack([first[paired], second[paired]])
        self.samples, self.squares = np.zeros(m, np.int64), np.zeros(m)
        self.link_score, self.link_information = np.zeros((m, m)), np.zeros((m, m))
        self.pair_score, self.pair_information = np.zeros((m, m)), np.zeros((m, m))
        self.common_score = self.common_information = 0.0
        self._common = bool(usable.any()) and not correlated
        self.counts = np.zeros((step.modes, step.modes), np.int64)
        self.messages, self.lost = np.zeros((m, m), np.int64), np.zeros((m, m), np.int64)
        self.broadcast_samples, self.broadcast_squares = 0, np.zeros(m)
        self._rows = np.flatnonzero(np.diag(step.transition) < 1.0)  # graphs that are left some time
        independent_losses = step.burst is None and not real_time
        self.lossy: IntArray = np.argwhere(step.listens() & (step.losses > 0.0) & independent_losses)  # (links, 2)
        self.impossible = (
            False  # whether anything happened that cannot: movement without noise, a loss of what never is
        )
        self.error = ErrorMartingale(prediction, replicas) if self.plain else None
        self.departures: Departures | None = None
        if in_detail:
            heard = np.argwhere(step.listens() & usable[:, None])
            law = Law(step, experiment.steps, replicas, self.noisy, self._common, heard, self.plain)
            self.departures = Departures(law)

    def add(
        self, observation: Observation, first: int, last: int, heard: tuple[HeardValues, FloatArray] | None = None
    ) -> None:
        """Add the steps first..last-1 of a run, which follow those that were added before.

        ``heard``: what was heard in them, and their innovations (b, m, R), where these are known.
        """
        quadratic = self._quadratic and self._near(observation.states[first : last + 1])
        if quadratic:
            self._add_quadratic(observation, first, last)
        if self.departures or not quadratic:
            block = self._block(observation, first, last, heard)
            if not quadratic:
                lost = None if observation.lost is None else observation.lost[first:last]
                self._add_heard(block.reception, block.white, block.scale, lost)
            if self.departures:
                self.departures.add(block)
        graphs = observation.modes[first : last + 1]
        self.add_transitions(graphs[:-1], graphs[1:])
        if observation.published is not None:
            self.add_broadcast(observation.published[first:last] - observation.states[first:last])
        if self.error is not None and len(graphs) > 1:
            steps = len(graphs) - 1
            a = np.ones((steps + 1, self.error.numbers))
            a[:, :-1] = moments(observation, first, first + steps + 1, observation.states)
            self.error.add(graphs[:-1], graphs[1:], a[:-1], a[1:])

    def add_transitions(self, graphs: IntArray, following: IntArray) -> None:
        """Add steps of the switching: graphs (k,) and those of the next step (k,)."""
        modes = self._step.modes
        self.counts += np.bincount(graphs * modes + following, minlength=modes**2).reshape(modes, modes)

    def add_broadcast(self, added: FloatArray) -> None:
        """Add what was published minus the states (b, m, R)."""
        if self._noise.broadcast:
            self.broadcast_samples += added.shape[0] * added.shape[2]
            self.broadcast_squares += (added**2).sum(axis=(0, 2)) / self._noise.broadcast**2

    def add_heard(self, reception: HeardValues, e: FloatArray, lost: BoolArray | None, largest: float) -> None:
        """Add steps by what was heard, in any order: their innovations (b, m, R), the lost messages (b, m, D), if any.

        Of a step with an infinite ``link_variance``, the agent is left out. ``largest``: size of the largest state.
        """
        scale = self._scales(reception, e, largest)
        self._add_heard(reception, e / scale[:, :, None], scale, lost)

    def _near(self, states: FloatArray) -> bool:
        """Whether states are so near to each other, or to the reference, that squares lose nothing that counts."""
        centre = self._step.reference if self._pulled.any() else states.mean(axis=1, keepdims=True)
        smallest = math.sqrt(float(np.diagonal(self._process, axis1=1, axis2=2).min()))
        return float(np.abs(states - centre).max()) <= FARTHEST * smallest

    def _add_quadratic(self, observation: Observation, first: int, last: int) -> None:
        """Noise, gains and pairs where all agents hear the states themselves, and all have noise.

        Every sum is then a quadratic form in z = (x(k) - c, x(k+1) - c, 1), so that for each graph the sum of z z^T is
        enough; c, the reference or the mean of x(k), keeps the numbers small.
        """
        step, m = self._step, self._step.agents
        states, modes = observation.states[first : last + 1], observation.modes[first:last]
        pull = step.nominal.sum(axis=2) - 1.0  # (n, m)
        pulled = bool(self._pulled.any())
        self.samples += observation.replicas * len(modes)
        for mode in np.unique(modes).tolist():
            at = np.flatnonzero(modes == mode)
            now, after = states[at], states[at + 1]
            centre = step.reference if pulled else now.mean(axis=1, keepdims=True)
            z = np.ones((2 * m + 1, len(at), observation.replicas))
            z[:m], z[m:-1] = (now - centre).transpose(1, 0, 2), (after - centre).transpose(1, 0, 2)
            flat = z.reshape(2 * m + 1, -1)
            gram = flat @ flat.T
            deviation = np.sqrt(np.diagonal(self._process[mode]))[:, None]
            # White innovations and the effects of links, as rows that are multiplied with z.
            offset = step.offsets[mode] + (pull[mode] * step.reference if pulled else 0.0)
            white = np.column_stack([-step.nominal[mode], np.eye(m), -offset]) / deviation
            weights = step.nominal[mode] * ~np.eye(m, dtype=bool) / deviation
            own = pull[mode] / deviation[:, 0] if pulled else np.zeros(m)
            seen, now_now = white @ gram, gram[:m, :m]
            products, size = seen @ white.T, np.diagonal(now_now)
            self.squares += np.diagonal(products)
            score = weights * (seen[:, :m] - np.diagonal(seen[:, :m])[:, None])
            information = weights**2 * (size[None, :] + size[:, None] - 2.0 * now_now)
            self.link_score += score + np.diag(own * np.diagonal(seen[:, :m]))
            self.link_information += information + np.diag(own**2 * size)
            if len(self.pairs):
                self.pair_score += products
                self.pair_information += np.diagonal(products)[None, :]
            if self._common:
                common = weights + np.diag(own - weights.sum(axis=1))
                self.common_score += float((common * seen[:, :m]).sum())
                self.common_information += float(((common @ now_now) * common).sum())

    def _block(
        self, observation: Observation, first: int, last: int, heard: tuple[HeardValues, FloatArray] | None
    ) -> Block:
        """The steps, with their innovations over the standard deviations, by what was heard."""
        reception = heard[0] if heard else HeardValues.of(observation, first, last)
        e = heard[1] if heard else innovations(observation, first, last, reception)
        scale = self._scales(reception, e, observation.largest)
        graphs, after = observation.modes[first : last + 1], observation.states[first + 1 : last + 1]
        return Block(first, graphs, e / scale[:, :, None], scale, after, reception)

    def _scales(self, reception: HeardValues, e: FloatArray, largest: float) -> FloatArray:
        """(b, m): standard deviations of innovations; infinite without noise, where nothing may move."""
        agents = np.arange(self._step.agents)
        variances = np.diagonal(self._process, axis1=1, axis2=2)[reception.graphs, agents] + reception.link_variance
        still = variances <= self._floor
        if self._independent and still.any() and np.abs(e[still]).max() > QUIET_ROUNDING * largest:
            self.impossible = True
        return np.asarray(np.sqrt(np.where(still, np.inf, variances)))

    def _add_heard(self, reception: HeardValues, white: FloatArray, scale: FloatArray, lost: BoolArray | None) -> None:
        """Noise, gains, pairs and losses by what was heard."""
        self.samples += np.where(np.isinf(scale), 0, white.shape[2]).sum(axis=0)
        self.squares += (white**2).sum(axis=(0, 2))
        self._add_links(reception, white, scale[:, :, None], lost if len(self.lossy) else None)
        if len(self.pairs):
            flat = white.transpose(1, 0, 2).reshape(len(white[0]), -1)
            products = flat @ flat.T
            self.pair_score += products
            self.pair_information += np.diag(products)[None, :]

    def _add_links(self, reception: HeardValues, white: FloatArray, scale: FloatArray, lost: BoolArray | None) -> None:
        """Scores of the gains; regressors and innovations over the standard deviation of the noise."""
        step = self._step
        agents, every = np.arange(step.agents), np.arange(len(white))
        count = neighbour_tables(step).count[reception.graphs, agents]  # (b, m)
        pull = (step.nominal.sum(axis=2) - 1.0)[reception.graphs, agents]
        common = pull[:, :, None] * (reception.states - step.reference) / scale
        self.link_score[agents, agents] += (common * white).sum(axis=(0, 2))
        self.link_information[agents, agents] += (common**2).sum(axis=(0, 2))
        m = step.agents
        for d in range(step.most_neighbours):
            there = count > d
            weights = reception.weights[:, :, d]
            difference = reception.heard(every, agents, np.full(m, d)) - reception.states
            part = np.where(weights != 0.0, weights, 0.0)[:, :, None] * difference / scale
            common += part
            place = (agents * m + reception.senders[:, :, d])[there]  # in one dimension: many times as fast
            np.add.at(self.link_score.reshape(-1), place, (part * white).sum(axis=2)[there])
            np.add.at(self.link_information.reshape(-1), place, (part**2).sum(axis=2)[there])
            if lost is not None:
                np.add.at(self.messages.reshape(-1), place, 1)
                np.add.at(self.lost.reshape(-1), place, lost[:, :, d][there])
        if self._common:
            self.common_score += float((common * white).sum())
            self.common_information += float((common**2).sum())

    def merge(self, other: EvidenceSums) -> None:
        """Add the sums of another run of the same experiment, with another seed."""
        for name in (
            *("samples", "squares", "link_score", "link_information", "pair_score", "pair_information"),
            *("common_score", "common_information", "counts", "messages", "lost"),
            *("broadcast_samples", "broadcast_squares"),
        ):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.impossible |= other.impossible
        if self.departures and other.departures:
            self.departures.merge(other.departures)
        if self.error is not None and other.error is not None:
            self.error.merge(other.error)

    def families(self) -> dict[str, FloatArray]:
        """For each kind the evidence on its questions, logarithms (questions, alternatives)."""
        found: dict[str, FloatArray] = {}
        noisy, rows = np.flatnonzero(self.noisy), self._rows
        if len(noisy):
            found["noise"] = variance_evidence(self.samples[noisy], self.squares[noisy])
        if len(self.links):
            i, j = self.links.T
            found["gain"] = coefficient_evidence(self.link_score[i, j], self.link_information[i, j])
        if self._common:
            score, information = np.array([self.common_score]), np.array([self.common_information])
            found["gains"] = coefficient_evidence(score, information)
        if len(self.pairs):
            i, j = self.pairs.T
            found["pair"] = coefficient_evidence(self.pair_score[i, j], self.pair_information[i, j])
        if len(rows):
            each = row_evidence(self.counts, self._step.transition)[rows]
            found["switching"] = np.vstack([each, each.sum(axis=0)])  # rows are independent of each other
        if len(self.lossy):
            i, j = self.lossy.T
            found["loss"] = proportion_evidence(self.lost[i, j], self.messages[i, j], self._step.losses[i, j])
        if self.broadcast_samples:
            samples = np.full(self._step.agents, self.broadcast_samples)
            found["broadcast"] = variance_evidence(samples, self.broadcast_squares)
        if self.error is not None and len(self.error.rates):
            found["system error"] = self.error.total[None]
        return found | self.departures.families() if self.departures else found

    def question(self, kind: str, row: int) -> Question:
        """What a row of ``families`` is about."""
        if kind == "noise":
            return Question(kind, int(np.flatnonzero(self.noisy)[row]))
        if kind == "broadcast":
            return Question(kind, row)
        if kind == "switching":
            return Question(kind, graph=int(self._rows[row]) if row < len(self._rows) else None)
        if kind in ("gain", "pair", "loss"):
            places = {"gain": self.links, "pair": self.pairs, "loss": self.lossy}[kind]
            return Question(kind, int(places[row, 0]), int(places[row, 1]))
        return Question(kind)

    def evidence(self) -> float:
        """Log of the evidence against the whole law: the weighted mean over the kinds of the mean over questions."""
        if self.impossible or self.lost[self._step.losses == 0.0].any():
            return float("inf")
        families = self.families()
        if not families:
            return 0.0
        each = log_means(list(families.values()))
        return float(log_sum(each + np.log(kind_weights(list(families))), axis=0))


def kind_weights(kinds: list[str]) -> FloatArray:
    """Of kinds of questions in the mean, of sum 1: fixed before the run, since they depend on the law only."""
    main: BoolArray = np.array([kind in MAIN for kind in kinds])
    weights = np.where(main, MAIN_SHARE / max(main.sum(), 1), (1.0 - MAIN_SHARE) / max((~main).sum(), 1))
    return np.asarray(weights / weights.sum())
