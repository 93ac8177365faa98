# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Evidence after each interim analysis, from sums over steps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.common.arrays import BLOCK_NUMBERS, BoolArray, FloatArray, IntArray
from msg_analysis.experiment.markov_chain import Schedule
from msg_analysis.inference.dependence import LAGS
from msg_analysis.inference.e_values import Analyses, log_mean, log_means, log_sum
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.question import Block, Diagnostic, Finding, Law, RunningSums
from msg_analysis.inference.questions import QUESTIONS, evidence_weights
from msg_analysis.inference.received_values import (
    DIGITS,
    ReceivedValues,
    RepeatedNoise,
    errors_have_digits,
    process_noise,
    state_rounding,
)
from msg_analysis.inference.residuals import PULLED, residuals
from msg_analysis.inference.statistics import simultaneous_half_width
from msg_analysis.inference.system_error import ErrorMartingale
from msg_analysis.inference.time_means import moments
from msg_analysis.model.reception import neighbour_tables
from msg_analysis.theory.prediction import Prediction

MOST_PAIRS = 5_000  # of agents whose noises are compared; beyond, none are


class EvidenceSums:
    """Sums for the evidence of all questions; with ``in_detail``, of the diagnostics, too."""

    def __init__(self, prediction: Prediction, replicas: int, *, in_detail: bool = False) -> None:
        experiment, step = prediction.experiment, prediction.step
        noise, m = experiment.noise, step.agents
        self._step, self._noise = step, noise
        real_time = experiment.run.pace == "realtime"
        self.plain = not (noise.on_air or noise.delay or real_time)  # all agents receive the states themselves
        # A message that is used twice has the same noise both times.
        self._independent = independent = not (noise.link and (step.holds or real_time))
        self._process = np.array([process_noise(step, np.full(m, g)) for g in range(step.modes)])  # (n, m, m)
        variances = np.diagonal(self._process, axis1=1, axis2=2)
        # With a delay, the message with x(0) is used in several steps.
        again = noise.link and step.delay and independent
        self.repeated = RepeatedNoise(step, replicas, realtime=False) if again else None
        rounding = state_rounding(prediction)
        self._floor = (DIGITS * rounding) ** 2  # variances up to this are rounding
        noisy = np.asarray((variances > self._floor).all(axis=0) & independent)
        correlated = bool((self._process * ~np.eye(m, dtype=bool)).any())
        # In real time a value that is used may contain a part of the noise of the same step.
        usable = noisy if not (real_time and correlated) else np.zeros(m, dtype=bool)
        pull = np.abs(step.nominal.sum(axis=2) - 1.0).max(axis=0) > PULLED
        first, second = np.triu_indices(m, 1)
        paired = usable[first] & usable[second] & (len(first) <= MOST_PAIRS) & (not correlated)
        independent_losses = step.burst is None and not real_time
        # Given its past and what was received, each sum is exact; the system error only where nothing is added or lost.
        random = self.plain and not prediction.path and errors_have_digits(prediction)
        self.error = ErrorMartingale.of(prediction, replicas) if random else None
        self._law = law = Law(
            step=step,
            graphs=[graph.name for graph in experiment.graph_list],
            planned=experiment.steps,
            replicas=replicas,
            noisy=noisy,
            rounding=rounding / np.sqrt(np.where(noisy, variances.min(axis=0), np.inf)),
            apart=bool(usable.any()) and not correlated,
            links=np.argwhere(step.listens() & usable[:, None]),
            lockstep=not real_time,
            gains=np.argwhere((step.listens() | np.diag(pull)) & usable[:, None]),
            pairs=np.column_stack([first[paired], second[paired]]),
            # Where a loss takes both directions, one of them says all.
            lossy=np.argwhere(
                (step.listens() & ~(np.tril(step.listens()) & step.listens().T & step.whole_link))
                & ((step.losses > 0.0) & independent_losses)
            ),
        )
        asked = [kind for kind in QUESTIONS if in_detail or not issubclass(kind, Diagnostic)]
        self.questions = {kind.name: kind(law) for kind in asked}
        self.diagnostics = [each for each in self.questions.values() if isinstance(each, Diagnostic)]
        self.total = self._zeros(1)
        # Of temporary arrays: of one interim analysis, and of one step.
        self.numbers_per_analysis = 8 * m**2 + step.modes**2 + (10 * LAGS * (m + 1) if self.diagnostics else 0)
        numbers = (4 + step.most_neighbours) * m * replicas + m**2
        error = self.error
        self.numbers_per_step = max(numbers, error.numbers * (1 + len(error.rates))) if error else numbers

    def add(
        self,
        observation: Observation,
        first: int,
        last: int,
        received: tuple[ReceivedValues, FloatArray] | None = None,
        analyses: Analyses | None = None,
    ) -> tuple[RunningSums, dict[str, FloatArray]]:
        """Add the next steps first..last-1: the sums and the evidence of the diagnostics after each analysis."""
        # ``received`` in the steps, and their residuals (b, m, R), where these are known.
        analyses = analyses or Analyses(np.array([last - first]))
        # One analysis needs no copies of what may be large.
        parts = self.total if analyses.count == 1 else self._zeros(analyses.count)
        block = self._block(parts, analyses, observation, first, last, received)
        lost = None if observation.lost is None else observation.lost[first:last]
        decided = np.arange(first, last) >= self._noise.sure_messages
        self._add_received(parts, analyses, block.reception, block.white, block.scale, lost, decided)
        found = {each.name: each.add(block) for each in self.diagnostics}
        graphs = observation.modes[first : last + 1]
        now, following = graphs[:-1], graphs[1:]
        self.add_transitions(now, following, parts, analyses.after(np.arange(len(now))))
        if observation.published is not None:
            self.add_broadcast(observation.published[first:last] - observation.states[first:last], parts, analyses)
        if self.error is not None and len(now):
            a = np.ones((len(graphs), self.error.numbers))
            a[:, :-1] = moments(observation, first, first + len(graphs))
            steps = np.zeros((last - first, len(self.error.rates)))
            steps[: len(now)] = self.error.steps(now, following, a[:-1], a[1:])
            parts.error += analyses.sums(steps)
        running = self.total
        if analyses.count > 1:
            running = self.total.then(parts)
            self.total = running.last()
        return running, found

    def _zeros(self, analyses: int) -> RunningSums:
        rates = 0 if self.error is None else len(self.error.rates)
        counted = 0 if isinstance(self._step.switching, Schedule) else self._step.modes
        return RunningSums.zeros(analyses, self._step.agents, counted, rates)

    def add_transitions(
        self, graphs: IntArray, following: IntArray, parts: RunningSums | None = None, analysis: IntArray | int = 0
    ) -> None:
        """Add steps of the switching: graphs (k,) and those of the next step (k,), before an ``analysis`` (k,)."""
        counts, modes = (parts or self.total).counts, self._step.modes
        if not counts.size:
            return
        place = (analysis * modes + graphs) * modes + following
        counts += np.bincount(place, minlength=counts.size).reshape(counts.shape)

    def add_broadcast(
        self, added: FloatArray, parts: RunningSums | None = None, analyses: Analyses | None = None
    ) -> None:
        """Add what was published minus the states (b, m, R)."""
        if self._noise.broadcast:
            parts, analyses = parts or self.total, analyses or Analyses(np.array([len(added)]))
            parts.broadcast_samples += analyses.lengths * added.shape[2]
            parts.broadcast_squares += analyses.sums((added**2).sum(axis=2)) / self._noise.broadcast**2

    def add_received(
        self, reception: ReceivedValues, e: FloatArray, lost: BoolArray | None, decided: BoolArray
    ) -> None:
        """Add steps, in any order: residuals (b, m, R), and lost messages (b, m, D), of the ``decided`` (b,) steps."""
        # Of a step with an infinite ``link_variance``, the agent is left out.
        analyses = Analyses(np.array([len(e)]))
        scale = self._scales(self.total, analyses, reception, e)
        self._add_received(self.total, analyses, reception, e / scale[:, :, None], scale, lost, decided)

    def _block(
        self,
        parts: RunningSums,
        analyses: Analyses,
        observation: Observation,
        first: int,
        last: int,
        received: tuple[ReceivedValues, FloatArray] | None,
    ) -> Block:
        """The steps, with their residuals over the standard deviations, by what was received."""
        reception = received[0] if received else ReceivedValues.of(observation, first, last)
        e = received[1] if received else residuals(observation, first, last, reception)
        if self.repeated:
            e, reception = self.repeated.free(first, e, reception)
        scale = self._scales(parts, analyses, reception, e)
        graphs, after = observation.modes[first : last + 1], observation.states[first + 1 : last + 1]
        return Block(first, graphs, e / scale[:, :, None], scale, after, reception, analyses)

    def _scales(self, parts: RunningSums, analyses: Analyses, reception: ReceivedValues, e: FloatArray) -> FloatArray:
        """(b, m): standard deviations of residuals; infinite without noise, where nothing may move."""
        agents = np.arange(self._step.agents)
        variances = np.diagonal(self._process, axis1=1, axis2=2)[reception.graphs, agents] + reception.link_variance
        still = variances <= self._floor
        if self._independent and still.any():
            allowed = reception.allowed(np.sqrt(np.where(still, variances, 0.0)))
            moved = (np.abs(e).max(axis=2) > allowed) & still
            parts.impossible += analyses.counts(np.asarray(moved.any(axis=1)))
        return np.asarray(np.sqrt(np.where(still, np.inf, variances)))

    def _add_received(
        self,
        parts: RunningSums,
        analyses: Analyses,
        reception: ReceivedValues,
        white: FloatArray,
        scale: FloatArray,
        lost: BoolArray | None,
        decided: BoolArray,
    ) -> None:
        """Noise, pairs, and of gains and losses the regressors, over the standard deviation of the noise."""
        parts.samples += analyses.counts(np.where(np.isinf(scale), 0, white.shape[2]))
        parts.squares += analyses.sums((white**2).sum(axis=2))
        if len(self._law.pairs):
            for analysis, (begin, end) in enumerate(zip(analyses.begins.tolist(), analyses.ends.tolist(), strict=True)):
                flat = white[begin:end].transpose(1, 0, 2).reshape(len(white[0]), -1)
                products = flat @ flat.T
                parts.pair_score[analysis] += products
                parts.pair_information[analysis] += np.diag(products)[None, :]
        step, scale = self._step, scale[:, :, None]
        agents, every = np.arange(step.agents), np.arange(len(white))
        count = neighbour_tables(step).count[reception.graphs, agents]  # (b, m)
        pull = (step.nominal.sum(axis=2) - 1.0)[reception.graphs, agents]
        common = pull[:, :, None] * (reception.states - step.reference) / scale
        parts.link_score[:, agents, agents] += analyses.sums((common * white).sum(axis=2))
        parts.link_information[:, agents, agents] += analyses.sums((common**2).sum(axis=2))
        m = step.agents
        receivers = (analyses.after(every)[:, None] * m + agents) * m  # places of rows of (T, m, m) in one dimension
        for d in range(step.most_neighbours):
            there = count > d
            weights = reception.weights[:, :, d]
            difference = reception.received(every, agents, np.full(m, d)) - reception.states
            part = np.where(weights != 0.0, weights, 0.0)[:, :, None] * difference / scale
            common += part
            place = (receivers + reception.senders[:, :, d])[there]  # in one dimension: many times as fast
            np.add.at(parts.link_score.reshape(-1), place, (part * white).sum(axis=2)[there])
            np.add.at(parts.link_information.reshape(-1), place, (part**2).sum(axis=2)[there])
            if lost is not None and len(self._law.lossy):
                counted = decided[np.nonzero(there)[0]]
                np.add.at(parts.messages.reshape(-1), place[counted], 1)
                np.add.at(parts.lost.reshape(-1), place[counted], lost[:, :, d][there][counted])
        if self._law.apart:
            parts.common_score += analyses.sums((common * white).sum(axis=(1, 2)))
            parts.common_information += analyses.sums((common**2).sum(axis=(1, 2)))

    def merge(self, other: EvidenceSums) -> None:
        """Add the sums of another run of the same experiment, with another seed."""
        self.total.merge(other.total)
        for mine, its in zip(self.diagnostics, other.diagnostics, strict=True):
            mine.merge(its)

    def families(self) -> dict[str, FloatArray]:
        """By name of the question, the evidence so far, logarithms (rows, alternatives)."""
        return {name: logarithms[0] for name, logarithms in self._families(self.total, {}).items()}

    def _families(self, sums: RunningSums, known: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """By name of the question, where it has evidence, logarithms (T, rows, alternatives); some are ``known``."""
        each = {
            name: known[name] if name in known else question.evidence(sums) for name, question in self.questions.items()
        }
        return {name: logarithms for name, logarithms in each.items() if logarithms.size}

    def weights(self, names: Iterable[str]) -> FloatArray:
        """Of questions with these names in the evidence."""
        return evidence_weights([self.questions[name].main for name in names])

    def strongest(self, families: dict[str, FloatArray]) -> list[tuple[str, float]]:
        """For each question its row with the most evidence, in words, and its logarithm."""
        found = []
        for name, logarithms in families.items():
            each = log_mean(logarithms, axis=1)
            best = int(np.argmax(each))
            found.append((self.questions[name].about(best), float(each[best])))
        return found

    def findings(self) -> dict[str, Finding]:
        """By name of the diagnostic, its clearest deviation, of those with something to test."""
        return {each.name: found for each in self.diagnostics if (found := each.finding())}

    def evidence(self, families: dict[str, FloatArray] | None = None) -> float:
        """Log of the evidence against the whole law; ``families``: where they are known."""
        families = self.families() if families is None else families
        return float(self._log_evidence(self.total, {name: found[None] for name, found in families.items()})[0])

    def log_evidence(self, sums: RunningSums, known: dict[str, FloatArray]) -> FloatArray:
        """(T,): of the evidence after each analysis, of what ``add`` returns."""
        return self._log_evidence(sums, self._families(sums, known))

    def _log_evidence(self, sums: RunningSums, families: dict[str, FloatArray]) -> FloatArray:
        """(T,): the weighted mean over the questions of the mean over their rows, after each analysis."""
        total = np.zeros(len(sums.impossible))
        if families:
            total = log_sum(log_means(list(families.values())) + np.log(self.weights(families)), axis=1)
        never = sums.lost[:, self._step.losses == 0.0].any(axis=1)
        total[never | (sums.impossible > 0)] = np.inf
        return total


LARGEST_LOGARITHM = 700.0  # evidence beyond is not shown as a number: floating point ends there


class WatchedEvidence:
    """Sums over a run, and the evidence after the numbers of ``steps`` (T,), of which the last is all."""

    def __init__(self, observation: Observation, steps: IntArray) -> None:
        self.sums = EvidenceSums(observation.prediction, observation.replicas, in_detail=True)
        self.dt = observation.step.dt
        self.steps: IntArray | None = steps  # None, as the logarithms (T,), of several runs
        self.logarithms: FloatArray | None = np.empty(len(steps))
        self._done = 0
        self._most = max(1, BLOCK_NUMBERS // self.sums.numbers_per_analysis)  # analyses in one pass

    def follow(self, observation: Observation) -> WatchedEvidence:
        """Add all steps of the run."""
        for first, last in observation.blocks(self.sums.numbers_per_step, "evidence"):
            self.add(observation, first, last)
        return self

    def add(
        self, observation: Observation, first: int, last: int, received: tuple[ReceivedValues, FloatArray] | None = None
    ) -> None:
        """Add the next steps first..last-1; ``received`` as of ``EvidenceSums.add``."""
        assert self.steps is not None
        assert self.logarithms is not None
        begin = first
        while first < last:
            ends = self.steps[self._done : self._done + self._most]
            ends = ends[ends <= last]
            done = self._done + len(ends)
            if len(ends) < self._most and (not len(ends) or ends[-1] < last):
                ends = np.append(ends, last)
            until = int(ends[-1])
            known = received and (
                received[0].part(first - begin, until - begin),
                received[1][first - begin : until - begin],
            )
            found = self.sums.log_evidence(*self.sums.add(observation, first, until, known, Analyses(ends - first)))
            self.logarithms[self._done : done] = found[: done - self._done]
            first, self._done = until, done

    def merge(self, other: WatchedEvidence) -> None:
        """Add other runs of the same experiment."""
        self.sums.merge(other.sums)
        self.steps = self.logarithms = None


@dataclass(frozen=True, slots=True, eq=False)
class AnyTimeEvidence:
    """What may be said at any time: a correct run ever passes ``threshold`` with probability 1 / threshold at most."""

    threshold: float
    log_evidence: float
    crossed: float | None  # [units of simulated time] when it passed the threshold first; None: never, or several runs
    time: FloatArray | None  # (T,) [units of simulated time]; None of several runs
    log_curve: FloatArray | None  # (T,)
    questions: Sequence[tuple[str, float]]  # the strongest question of each kind, and its log evidence; largest first
    half_width: float | None  # of the 95 % interval of the system error that holds at all times at once

    @property
    def exceeded(self) -> bool:
        """Whether the threshold is exceeded, or was."""
        return self.crossed is not None or self.log_evidence >= math.log(self.threshold)

    def to_json(self) -> dict[str, Any]:
        """The document; evidence that is too large for a number is None."""
        small = self.log_evidence < LARGEST_LOGARITHM
        return {
            "evidence": math.exp(self.log_evidence) if small else None,
            "log_evidence": self.log_evidence,
            "threshold": self.threshold,
            "exceeded": self.exceeded,
            "crossed_at": self.crossed,
            "questions": [{"about": words, "log_evidence": log} for words, log in self.questions],
            "half_width": self.half_width,
        }


def any_time_evidence(
    watched: WatchedEvidence,
    level: float,
    families: dict[str, FloatArray] | None = None,
    variance: float | None = None,
    steps: int | None = None,
    planned: float | None = None,
) -> AnyTimeEvidence:
    """Evidence of runs in numbers; ``variance``: sum of Var(D_k) of the system error over so many ``steps``."""
    # The interval is narrowest at so many ``planned`` steps, a number that is chosen before the run.
    threshold, sums = 1.0 / level, watched.sums
    time, crossed, half_width = None, None, None
    if watched.steps is not None and watched.logarithms is not None:
        time = np.asarray(watched.steps * watched.dt, dtype=float)
        over = np.flatnonzero(watched.logarithms >= math.log(threshold))
        crossed = float(time[over[0]]) if len(over) else None
    families = sums.families() if families is None else families
    if variance and steps and planned and sums.error is not None:
        half_width = float(simultaneous_half_width(variance, sums.error.variance * planned)) / steps
    strongest = sorted(sums.strongest(families), key=lambda entry: -entry[1])
    evidence = sums.evidence(families)
    return AnyTimeEvidence(threshold, evidence, crossed, time, watched.logarithms, strongest, half_width)
