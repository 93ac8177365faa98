# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Sums over one run, or over several of one experiment: all that the verdict needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from msg_analysis.common.arrays import IntArray
from msg_analysis.common.resources import blas_threads
from msg_analysis.inference.counts import LossTally, Transitions
from msg_analysis.inference.event_order import order_events
from msg_analysis.inference.evidence_sums import Watch, WatchedEvidence
from msg_analysis.inference.given_path import means_given_path
from msg_analysis.inference.observation import Observation, spaced_steps
from msg_analysis.inference.realtime_laws import Laws, means_in_lockstep, measure_laws
from msg_analysis.inference.residuals import BroadcastSums, ResidualSums
from msg_analysis.inference.time_means import TimeMeans, time_means
from msg_analysis.inference.timing import Timing, measure_timing

ANALYSES = 20, 80  # at the evidence over time, in short and in long runs: each takes as long as some hundred steps
STEPS_PER_ANALYSIS = 100  # between these
DECIDED_ANALYSES = 400  # where the evidence has decided when the run ended, and so decides the verdict


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Sums over the steps of runs; those of several runs of one experiment are added up."""

    steps: int
    means: TimeMeans  # time means, and their expectation over all paths of the graphs; in real time: given the log
    decisive: bool  # whether the law that the means are compared with is exact
    given: TimeMeans | None  # with their expectation given the path; None where it is not computed
    residuals: ResidualSums
    transitions: Transitions
    loss: LossTally | None  # None without loss
    broadcast: BroadcastSums | None  # None without broadcast noise
    watched: WatchedEvidence  # what holds at any time
    timing: Timing | None = None  # of one run in real time
    laws: Laws | None = None  # of one run in real time

    @property
    def tested(self) -> TimeMeans | None:
        """The errors next to the exact law that they are tested against; None where there is none.

        In lockstep that given the path, which holds for every run, before that over all paths, which needs long runs;
        but one with the errors of the agents before one without.
        """
        laws = [self.given, self.means if self.means.long_enough else None] if self.decisive else []
        known = [law for law in laws if law]
        return next((law for law in known if len(law.nodes)), known[0] if known else None)

    @classmethod
    def of(cls, observation: Observation, level: float, *, decided: bool = False) -> Evidence:
        """Of one run, which ended when its evidence ``decided``; in real time, laws are tested at ``level``."""
        analyses = spaced_steps(observation.steps, DECIDED_ANALYSES if decided else usual_analyses(observation.steps))
        with blas_threads(observation.step.agents):
            return cls._of(observation, level, analyses)

    @classmethod
    def _of(cls, observation: Observation, level: float, analyses: IntArray) -> Evidence:
        laws, timing, position, given = None, None, None, None
        if observation.timers:
            timing, order = measure_timing(observation), order_events(observation)
            position = order.position
            means, laws = measure_laws(observation, order, timing, level)
        else:
            means = time_means(observation)
            kept = observation.prediction.system.readout is not None
            given = means_in_lockstep(observation) if kept else means_given_path(observation)
        watch = Watch(observation, analyses)
        residuals = ResidualSums(observation, position, watch)
        return cls(
            steps=observation.steps,
            means=means,
            decisive=laws is None or laws.measured_against == "pattern",
            given=given,
            residuals=residuals,
            transitions=Transitions.of(observation.modes, observation.step.modes),
            loss=LossTally.of(observation),
            broadcast=BroadcastSums.of(observation),
            watched=watch.result(),
            timing=timing,
            laws=laws,
        )

    def merged(self, other: Evidence) -> Evidence:
        """The evidence of these and other runs of the same experiment; the sums of ``self`` are changed in place.

        Time means are weighted with the numbers of steps, so that every step, and every martingale increment, counts
        the same.
        """
        self.residuals.merge(other.residuals)
        if self.loss and other.loss:
            self.loss.merge(other.loss)
        if self.broadcast and other.broadcast:
            self.broadcast.merge(other.broadcast)
        given = None
        if self.given and other.given:
            given = _merged_means(self.given, self.steps, other.given, other.steps)
        return replace(
            self,
            steps=self.steps + other.steps,
            means=_merged_means(self.means, self.steps, other.means, other.steps),
            decisive=self.decisive and other.decisive,
            given=given,
            transitions=self.transitions.merged(other.transitions),
            watched=self.watched.merged(other.watched),
            timing=None,
            laws=None,
        )


def usual_analyses(steps: int) -> int:
    """At the evidence over time of a run with so many steps, at most."""
    few, most = ANALYSES
    return min(max(steps // STEPS_PER_ANALYSIS, few), most)


def _merged_means(one: TimeMeans, steps: int, other: TimeMeans, more: int) -> TimeMeans:
    a, b = steps / (steps + more), more / (steps + more)
    if one.joint != other.joint or len(one.nodes) != len(other.nodes):
        one, other = _coarser(one, other), _coarser(other, one)
    return replace(
        one,
        second_moments=a * one.second_moments + b * other.second_moments,
        expected_moments=a * one.expected_moments + b * other.expected_moments,
        measured=a * one.measured + b * other.measured,
        predicted=a * one.predicted + b * other.predicted,
        covariance=a**2 * one.covariance + b**2 * other.covariance,
        system_series=np.concatenate([one.system_series, other.system_series]),
        system_variances=np.concatenate([one.system_variances, other.system_variances]),
        switches=one.switches + other.switches,
    )


def _coarser(means: TimeMeans, other: TimeMeans) -> TimeMeans:
    """Reduced to what both have: the node errors, or only the system error."""
    combinations = means.nodes if len(means.nodes) and len(other.nodes) else means.trace[None]
    count = len(combinations)
    return replace(
        means,
        joint=False,
        measured=combinations @ means.measured,
        predicted=combinations @ means.predicted,
        covariance=combinations @ means.covariance @ combinations.T,
        nodes=np.eye(count) if count > 1 else np.empty((0, 1)),
        trace=np.ones(count),
    )
