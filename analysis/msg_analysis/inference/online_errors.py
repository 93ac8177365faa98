# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Errors of a network next to their prediction while it runs: the numbers of a comparison, one step at a time.

Only sums are kept; a step takes O(m^2), and while the effect of a start that is not stationary lasts, O(n m^3).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from msg_analysis.common.arrays import BLOCK_NUMBERS, BoolArray, FloatArray, IntArray
from msg_analysis.common.text import number_text
from msg_analysis.experiment.limits import unpredictable
from msg_analysis.inference.estimates import Estimate, beside, beside_sampled, sampled_beside
from msg_analysis.inference.observation import bounded, deviations
from msg_analysis.inference.online_evidence import AnyTime, ReceivedEvidence, RunningEvidence, needs_log, supports
from msg_analysis.inference.online_steps import Lateness, LoggedStates, Recent, RecentSteps, StateLog, StepCollector
from msg_analysis.inference.statistics import RunningBatches, simultaneous_half_width, steps_to_half_width
from msg_analysis.inference.time_means import Value, forms_of, packed_moments, start_of_run, values_of
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.model.run_record import RunRecord, Until
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.prediction import Prediction, predict_run
from msg_analysis.theory.sampling import SampledPrediction
from msg_analysis.theory.scheduled import course

TUNING_STEPS = 500  # before the interval is given: their variances say how it is tuned


class RunningInterval:
    """Half-width of the 95 % interval of the system error that holds at all times at once."""

    def __init__(self, record: RunRecord, prediction: Prediction | None, variance: float | None) -> None:
        self._until, self._planned = record.until, record.planned_steps
        self._predicted = prediction.emulated.system_error if prediction is not None else None
        self._variance = variance  # of a step, as far as it is known before the run
        self._batches = RunningBatches()
        self._target: float | None = None  # sum of variances for which the interval is narrowest: set early, and kept

    def add(self, series: FloatArray) -> None:
        """Add the system errors of steps (b,)."""
        self._batches.add(series)

    def half_width(self, system: Estimate, steps: int) -> float | None:
        """Of the mean over so many steps, with this estimate; None: not known yet."""
        if steps < TUNING_STEPS:
            return None
        error = system.standard_error
        variance = self._batches.variance() if error is None else (error * steps) ** 2
        if not variance or not system.measured:
            return None
        if self._target is None:
            each, size = self._variance or variance / steps, self._predicted or system.measured
            wanted = self._planned if self._until is None else steps_to_half_width(each, self._until.precision * size)
            self._target = each * min(self._planned, wanted)
        return float(simultaneous_half_width(variance, self._target)) / steps


EVERY_STEP = 20  # agents up to which every step is used for the standard errors of the nodes; beyond, one in m / 20
MOST_BYTES = 256 * 2**20  # memory for the standard errors of the nodes; where that is too little, they are left out


@dataclass(frozen=True, slots=True)
class LiveReport:
    """Progress of a network, and its errors so far."""

    first: int  # first step in the errors; -1: none
    last: int  # last step in the errors; -1: none
    steps: int  # number of steps in the errors
    newest: int  # largest step with any state; -1: none
    system: Estimate
    nodes: list[Estimate]
    note: str | None  # why there is no prediction, or no standard error; None where there are both
    refused: dict[str, int] = field(default_factory=dict)  # states or steps that do not count, by reason
    recent: Recent | None = None  # the newest whole steps
    lateness: list[float | None] | None = None  # of each agent in real time, see ``Lateness.medians``
    any_time: AnyTime = field(default_factory=lambda: AnyTime(None))

    @property
    def missing(self) -> int:
        """Incomplete steps between first and last."""
        return self.last - self.first + 1 - self.steps if self.steps else 0


class LiveEstimate:
    """The errors of a run next to their prediction, from the states as they arrive; InputError without one."""

    def __init__(
        self, record: RunRecord, *, nodes: bool = True, evidence: bool = True, kept: int | None = None
    ) -> None:
        experiment = record.experiment
        lockstep = experiment.run.pace == "lockstep"
        self.record = record
        reason = unpredictable(experiment)
        prediction = None if reason else predict_run(experiment, record.step_model)
        sampled = sampled_beside(experiment) if reason else None
        self._errors = RunningErrors(record, prediction, nodes=nodes, sampled=sampled)
        self._plain: RunningEvidence | None = None
        self._received: ReceivedEvidence | None = None
        self.log: StateLog | None = None  # None: the messages are not needed
        if evidence and prediction is not None and supports(prediction):
            if needs_log(experiment):
                self._received = ReceivedEvidence(prediction, experiment.run.replicas, kept)
                self.log = StateLog(record)
            else:
                self._plain = RunningEvidence(prediction, experiment.run.replicas)
        self.evidence = self._received or self._plain
        # Whether what the agents publish is needed, too, because it is not their states.
        self.needs_published = self.log is not None and self.log.truth
        self.steps = StepCollector(
            experiment.agents,
            len(experiment.graph_list),
            experiment.steps,
            lockstep=lockstep,
            logged=self.log is not None,
            truth=self.needs_published,
        )
        self._interval = RunningInterval(record, prediction, self.evidence.variance if self.evidence else None)
        self._recent = RecentSteps()
        self._lateness = None if lockstep else Lateness(experiment)
        self._newest = -1
        self._note = reason
        if sampled is not None:
            low, high = map(number_text, sampled.interval)
            self._note = f"predicted: of the steady state, sampled, {low} to {high} (95 %), without a test: {reason}"
        if prediction is not None and not lockstep:
            self._note = "in real time the expected errors depend on the lateness of the agents: compare the bag"
        elif prediction is not None and prediction.path:
            self._note = "of a given sequence of graphs, intervals need the whole run: compare the bag"
        elif prediction is not None and prediction.system.readout is not None:
            self._note = "where values are kept from step to step, intervals need the whole run: compare the bag"
        elif prediction is not None and prediction.fourth_moment.finite is not True:
            self._note = "fourth moments are infinite, so that errors have no standard errors: compare the bag"
        elif prediction is not None and not self._errors.nodes_tested:
            self._note = "too many agents for intervals of the agent errors"

    def end_at(self, step: int) -> None:
        """The run ends at this step, or has ended there: what was done after it is not a part of it."""
        self.steps.end_at(step)
        if self.evidence is not None:
            self.evidence.end_at(step)

    def add(
        self, agent: int, step: int, mode: int, payload: bytes, message: bytes = b"", *, published: bool = False
    ) -> None:
        """Add x(step) of an agent (from 0), see ``StepCollector.add``; its message is needed with a ``log``."""
        self.steps.add(agent, step, mode, payload, message, published=published)

    def add_logged(self, logged: LoggedStates) -> None:
        """Add whole states with their logs, besides ``add_whole``; nothing where there is no ``log``."""
        if self._received is not None:
            self._received.add(logged)

    def add_holding_period(self, first: int, last: int, graph: int) -> bool:
        """In real time: take steps in which the network has a graph, from 0; False: they contradict earlier ones."""
        return self._received is None or self._received.add_holding_period(first, last, graph)

    def add_whole(self, steps: IntArray, modes: IntArray, states: FloatArray, after: FloatArray) -> None:
        """Add whole steps k (b,), each only once: graphs of k -> k+1 from 0 (b,), x(k) and x(k+1) (b, m, width)."""
        if not len(steps):
            return
        self._interval.add(self._errors.add(steps, modes, states, after))
        if self._plain is not None:
            self._plain.add(steps, modes, states, after)
        self._newest = max(self._newest, int(steps.max()))
        self._recent.add(steps, modes, states)

    def add_stamps(self, agent: int, steps: Iterable[int], stamps: Iterable[int]) -> None:
        """In real time: the stamps [ns] of states of an agent (from 0), by which it is said how late it is."""
        if self._lateness is not None:
            for step, stamp in zip(steps, stamps, strict=True):
                self._lateness.add(agent, step, stamp)

    def report(self) -> LiveReport:
        """The numbers so far."""
        self.add_whole(*self.steps.take())
        if self.log is not None and (found := self.steps.take_log()):
            self.add_logged(self.log.of_messages(*zip(*found, strict=True)))
            self.steps.refused[Refusal.BAD_HEARD] = self.log.impossible
        errors = self._errors
        system, nodes = errors.estimates()
        half_width = self._interval.half_width(system, errors.count)
        return LiveReport(
            first=errors.first,
            last=errors.last,
            steps=errors.count,
            newest=max(self.steps.newest, self._newest),
            system=system,
            nodes=nodes,
            note=self._note,
            any_time=self.evidence.report(half_width) if self.evidence else AnyTime(half_width),
            refused={reason: count for reason, count in sorted(self.steps.refused.items()) if count},
            recent=self._recent.newest(),
            lateness=self._lateness.medians() if self._lateness else None,
        )


class RunningErrors:
    """Sums over steps that give errors and standard errors at any time; without a prediction, errors only."""

    def __init__(
        self,
        record: RunRecord,
        prediction: Prediction | None,
        *,
        nodes: bool = True,
        most_bytes: int = MOST_BYTES,
        sampled: SampledPrediction | None = None,
    ) -> None:
        experiment = record.experiment
        self._record, self._prediction, self._sampled = record, prediction, sampled
        self._agents, self._replicas = experiment.agents, experiment.run.replicas
        self.first = self.last = -1  # first and last step that was added; -1: none
        self.count = 0  # steps that were added
        self.nodes_tested = False  # whether the nodes have standard errors, too
        self._squares = np.zeros(self._agents)  # sums of the agents' errors
        self._variances: _ErrorVariances | None = None
        self._expected: _Expected | None = None
        if prediction is not None:
            self._expected = _Expected(prediction)
            heavy = prediction.fourth_moment.finite is not True
            steady = prediction.system.readout is None and not heavy and prediction.path is None
            if experiment.run.pace == "lockstep" and steady:
                self._variances = _ErrorVariances(prediction, self._replicas, most_bytes if nodes else 0)
                self.nodes_tested = self._variances.nodes

    def add(self, steps: IntArray, modes: IntArray, states: FloatArray, after: FloatArray) -> FloatArray:
        """Add steps, arrays as in ``LiveEstimate.add_whole``; their system errors (b,)."""
        if not len(steps):
            return np.empty(0)
        self.first = int(steps.min()) if self.first < 0 else min(self.first, int(steps.min()))
        self.last = max(self.last, int(steps.max()))
        self.count += len(steps)
        if self._expected is not None:
            known = np.flatnonzero(steps == 0)
            self._expected.add(steps, self._record, int(modes[known[0]]) if len(known) else None)
        here = self._deviations(states)
        later = self._deviations(after) if self._variances is not None and self._variances.needs_later else here
        squares = (here**2).mean(axis=2)
        self._squares += squares.sum(axis=0)
        if self._variances is not None:
            self._variances.add(steps, modes, here, later)
        return np.asarray(squares.sum(axis=1))

    def estimates(self) -> tuple[Estimate, list[Estimate]]:
        """System error and node errors so far."""
        if not self.count:
            return Estimate(), [Estimate()] * self._agents
        measured = np.concatenate([[self._squares.sum()], self._squares]) / self.count
        if self._expected is None:
            known = None
            if self._sampled is not None:
                known = np.append(self._sampled.system_error, self._sampled.node_errors)
            found = beside_sampled(measured, known)
            return found[0], found[1:]
        nodes = self._expected.total / self.count
        predicted = np.concatenate([[nodes.sum()], nodes])
        if self._variances is None:
            found = [Estimate(float(m), float(p)) for m, p in zip(measured, predicted, strict=True)]
            return found[0], found[1:]
        errors = np.sqrt(self._variances.variances().clip(0.0)) / self.count
        tested = len(errors)
        system, tested_nodes = beside(measured[:tested], predicted[:tested], errors)
        pairs = zip(measured[tested:], predicted[tested:], strict=True)
        return system, tested_nodes + [Estimate(float(m), float(p)) for m, p in pairs]

    def _deviations(self, states: FloatArray) -> FloatArray:
        """(b, m, R): deviations of the agents from the reference, or in consensus from their mean."""
        return deviations(bounded(states[:, :, : self._replicas]), self._record.experiment)


class _ErrorVariances:
    """Sums that give the variances of the time means, as in ``time_means``."""

    def __init__(self, prediction: Prediction, replicas: int, most_bytes: int) -> None:
        system = prediction.system
        p = packed_symmetric.size(system.dimension)
        agents = len(system.output)
        # Whether the node errors are tested, too, and not only the system error.
        self.nodes = 8 * system.modes**2 * agents * (p + 1) <= most_bytes
        forms, _, trace = forms_of(system, "nodes" if self.nodes else "system")
        self._system, self._replicas = system, replicas
        self.needs_later = system.lossy  # whether the states after a step count, beside those before it
        self._largest = 0.0  # size of the largest deviation so far
        self._values = values_of(prediction, forms)
        self._each = np.eye(len(forms)) if self.nodes else np.empty((0, len(forms)))
        self._trace = trace
        self._stride = -(-agents // EVERY_STEP)
        self._totals = np.zeros((system.modes, p + 1))
        self._known = [
            np.array([value.spread_variance(row) for row in (trace, *self._each)]) if isinstance(value, Value) else None
            for value in self._values
        ]
        self._squares = np.zeros(1 + len(self._each))
        self._sampled = self._count = 0  # steps used for the nodes, and all
        self._length = max(1, BLOCK_NUMBERS // max(p, agents * replicas))

    def add(self, steps: IntArray, modes: IntArray, here: FloatArray, later: FloatArray) -> None:
        """Arrays as in ``RunningErrors.add``, with deviations in place of states."""
        self._count += len(steps)
        for first in range(0, len(steps), self._length):
            block = slice(first, first + self._length)
            a = self._packed(here[block])
            b = self._packed(later[block]) if self.needs_later else a
            self._add(modes[block], a, b, steps[block] % self._stride == 0)

    def _add(self, modes: IntArray, a: FloatArray, b: FloatArray, sampled: BoolArray) -> None:
        self._sampled += int(sampled.sum())
        for mode in np.unique(modes).tolist():
            here = modes == mode
            self._totals[mode] += a[here].sum(axis=0)
            self._squares[0] += self._sum_squares(mode, self._trace[None], a[here], b[here])[0]
            if self.nodes:
                some = here & sampled
                self._squares[1:] += self._sum_squares(mode, self._each, a[some], b[some])

    def _packed(self, here: FloatArray) -> FloatArray:
        """(b, p + 1): (s, 1) of every step."""
        self._largest = max(self._largest, float(np.abs(here).max(initial=0.0)))
        packed = packed_moments(here, self._system, self._largest)
        return np.concatenate([packed, np.ones((len(packed), 1))], axis=1)

    def _sum_squares(self, mode: int, rows: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
        """(len(rows),): the part that is not linear in a, for some combinations of the forms."""
        value = self._values[mode]
        if isinstance(value, Value):
            return np.asarray(value.jump_variances(rows, a).sum(axis=0))
        increments = value.increments(a, b) @ rows.T
        return np.asarray((increments**2 + value.jump_variances(rows, b)).sum(axis=0))

    def variances(self) -> FloatArray:
        """(1,) or (1 + m,): of the sums over all steps, of the system error and of the node errors."""
        found = self._squares.copy()
        if self._sampled:
            found[1:] *= self._count / self._sampled
        for known, total in zip(self._known, self._totals, strict=True):
            if known is not None:
                found += known @ total / self._replicas
        return found


class _Expected:
    """Exact expectation of the node errors, summed over steps."""

    def __init__(self, prediction: Prediction) -> None:
        self._prediction = prediction
        self._steady = np.diag(prediction.emulated.covariance)
        self._given: Iterator[tuple[FloatArray, FloatArray]] | None = None  # of a schedule: moments of the next step
        self._away: FloatArray | None = None  # (n, d, d) from the steady state, of the next step
        self._law = np.empty(0)
        self._scale = 0.0
        self._series: list[FloatArray] = []  # distance from the steady errors, of every step before that
        self.total = np.zeros(len(self._steady))  # (m,)

    def add(self, steps: IntArray, record: RunRecord, first_mode: int | None) -> None:
        """Add steps; ``first_mode`` is g(0), which counts if it is known in the first call."""
        system, last = self._prediction.system, int(steps.max())
        if schedule := record.experiment.schedule:
            if self._given is None:
                graphs = schedule.sampled(record.experiment.steps, record.experiment.step_length)
                self._given = course(system, record.start, graphs)
            while len(self._series) <= last:
                self._series.append(np.diag(system.lifted(next(self._given)[1])))
            self.total += np.sum([self._series[step] for step in steps.tolist()], axis=0)
            return
        if self._away is None:
            steady = self._prediction.steady
            *before, now = start_of_run(self._prediction, record.start, first_mode)
            self._series = [np.diag(system.lifted((each.moments - steady).sum(axis=0))) for each in before]
            self._away, self._law = now.moments - steady, now.law - system.stationary
            self._scale = max(np.abs(steady).max(initial=0.0), np.abs(now.moments).max(initial=0.0))
        while len(self._series) <= last and (
            np.abs(self._away).max(initial=0.0) > 1e-17 * self._scale or np.abs(self._law).max() > 1e-17
        ):
            self._series.append(np.diag(system.lifted(self._away.sum(axis=0))))
            self._away, self._law = system.advance(self._away, self._law)
        self.total += len(steps) * self._steady
        early = steps[steps < len(self._series)]
        if len(early):
            self.total += np.sum([self._series[step] for step in early.tolist()], axis=0)


LEAST_STEPS = 100  # before an interval counts


def reached(until: Until, report: LiveReport) -> str | None:
    """Why the run may end now, in words; None: it goes on."""
    seen, measured = report.any_time, report.system.measured
    if until.decided and seen.crossed is not None:
        return f"evidence against the prediction passed {seen.threshold:g} at step {report.last + 1}"
    if seen.half_width is None or not measured or report.steps < LEAST_STEPS:
        return None
    if seen.half_width > until.precision * measured:
        return None
    return f"precision {number_text(100 * until.precision)} % reached at step {report.last + 1}"


def precision_words(report: LiveReport) -> str:
    """How precisely the system error is known, in words."""
    half, measured = report.any_time.half_width, report.system.measured
    if half is None or not measured:
        return "the precision is not known"
    return f"precision {100 * half / measured:.2g} % at step {report.last + 1}"
