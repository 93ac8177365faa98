# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Exact moments of a run whose sequence of graphs is given: no chain is assumed.

With g(k) the graph of the step k -> k+1, the reduced states of a ``JumpSystem`` have the second moments

    M(0) = y(0) y(0)^T,    M(k+1) = K_g(k)[M(k)] + N_g(k).

With losses in bursts, M has one part for each state of the channels, between which a chain of their own switches.

Where agents keep nothing but their states, M is followed for the agents themselves, without matrices of all graphs:
W = I + D, where D has rows of those agents only that hear somebody, so W (W M)^T costs links times agents.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.common.resources import blas_threads, tell
from msg_analysis.experiment.graphs import Graph
from msg_analysis.experiment.markov_chain import MarkovChain
from msg_analysis.experiment.validation import union_of
from msg_analysis.model.graph_path import mode_path
from msg_analysis.model.step_model import StepModel, build_run_model, build_step_model, step_law, turns
from msg_analysis.theory.first_steps import known_start
from msg_analysis.theory.jump_system import JumpSystem, emulated, part

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment

STEPS_PER_REPORT = 1000
STEPS_PER_CENTERING = 32  # what is common to all agents grows in between, and costs digits
MOST_LAWS = 1000  # of graphs, that are kept
FEW = 0.125  # share of entries up to which a sparse matrix is faster than a dense one


@dataclass(frozen=True, slots=True, eq=False)
class PathMoments:
    """Second moments of the states x(1), ..., x(N) given the graphs, and their errors."""

    system_errors: FloatArray  # (N,)
    covariance: FloatArray  # (m, m) of the deviations, mean over the steps from ``first`` on,
    counted: int  # of which there are so many

    @property
    def largest(self) -> tuple[float, int]:
        """The largest system error, and of which x(k)."""
        k = int(np.argmax(self.system_errors))
        return float(self.system_errors[k]), k + 1


def path_moments(
    system: JumpSystem, start: FloatArray, modes: IntArray, first: int = 0
) -> tuple[PathMoments, FloatArray]:
    """Moments of a run from ``start`` (m, R) with the graphs ``modes`` (N,), means over x(first + 1), ..., x(N).

    Also (n, d, d) the same means of y y^T, those after the steps of each graph.
    """
    errors = np.empty(len(modes))
    by_mode = np.zeros((_step(system).modes, system.dimension, system.dimension))
    weights = system.output.T @ system.output  # so that tr(weights M) is the system error
    for k, (_, moments) in enumerate(course(system, start, modes)):
        if k % STEPS_PER_REPORT == 0:
            tell("moments given the graphs", k, len(modes))
        if k:
            errors[k - 1] = np.vdot(weights, moments)
        if k > first:
            by_mode[modes[k - 1]] += moments
    counted = len(modes) - first
    by_mode /= max(1, counted)
    return PathMoments(errors, system.lifted(by_mode.sum(axis=0)), counted), by_mode


@dataclass(frozen=True, slots=True)
class Outage:
    """A longest stretch of time whose graphs have more parts than the union of all graphs has."""

    start: float  # [units of simulated time]
    end: float
    parts: int  # most of a graph in it
    adds: float | None  # to the mean system error, which is lower by so much without these steps; None: no others


@dataclass(frozen=True, slots=True)
class Outages:
    """The longest outages of a run with a schedule, and what they cost."""

    count: int  # of all outages
    error_without: float | None  # mean system error without the steps of the longest ones; None: no others
    longest: Sequence[Outage]  # the longest one first

    def to_json(self) -> dict[str, Any]:
        """In the document of ``predict``."""
        return dataclasses.asdict(self)


def outages(experiment: Experiment, modes: IntArray, most: int, error: Callable[[BoolArray], float | None]) -> Outages:
    """The ``most`` longest ones of a run with the graphs ``modes`` (N,); ``error``: of some of the steps (N,) alone."""
    whole = Graph.of("union", union_of(experiment.graph_list).astype(float)).parts
    used = np.unique(modes)
    parts = np.zeros(len(experiment.graph_list), np.int64)
    parts[used] = [experiment.graph_list[mode].parts for mode in used.tolist()]
    apart = np.concatenate([[False], parts[modes] > whole, [False]])
    found = np.flatnonzero(apart[1:] != apart[:-1]).reshape(-1, 2)  # first step, and the first one after it
    longest = found[np.argsort(found[:, 0] - found[:, 1], kind="stable")][:most].tolist()
    steps, dt = np.arange(len(modes)), experiment.step_length

    def without(those: Sequence[Sequence[int]]) -> float | None:
        return error(~np.any([(steps >= first) & (steps < end) for first, end in those], axis=0))

    total = error(np.ones(len(modes), np.bool_))
    entries = []
    for first, end in longest:
        rest = without([(first, end)])
        adds = None if rest is None or total is None else total - rest
        entries.append(Outage(first * dt, end * dt, int(parts[modes[first:end]].max()), adds))
    return Outages(len(found), without(longest) if longest else total, entries)


def without_stacks(experiment: Experiment) -> bool:
    """Whether ``sparse_moments`` has its law: built in, in continuous time, with no values kept from step to step."""
    noise = experiment.noise
    kept = (
        noise.leaves_out_steps
        or noise.whole_link
        or noise.delay
        or noise.holds
        or (noise.loss.any and noise.burst is not None)
    )
    alone = step_law(experiment) == "synchronous" or not noise.on_messages
    return experiment.time == "continuous" and not experiment.protocol and not kept and alone


def sparse_moments(experiment: Experiment, start: FloatArray, modes: IntArray, first: int = 0) -> PathMoments:
    """The same of an experiment, from x(0) (m,), by sparse steps."""
    deviations = start - experiment.reference
    consensus = experiment.problem == "consensus"
    m, steps = len(start), _SparseSteps(experiment)
    deviations -= deviations.mean() if consensus else 0.0
    steps.moments[:] = np.outer(deviations, deviations)
    errors, total = np.empty(len(modes)), np.zeros((m, m))
    for k, mode in enumerate(modes.tolist()):
        if k % STEPS_PER_REPORT == 0:
            tell("moments given the graphs", k, len(modes))
        steps.advance(mode)
        if consensus and k % STEPS_PER_CENTERING == 0:
            _center(steps.moments)
        errors[k] = np.trace(steps.moments) - (steps.moments.sum() / m if consensus else 0.0)
        if k >= first:
            total += steps.moments
    total /= max(1, len(modes) - first)
    if consensus:
        _center(total)
    return PathMoments(errors, total, len(modes) - first)


def _center(moments: FloatArray) -> None:
    """Second moments (m, m) of what differs from the mean of all agents, in place."""
    moments -= moments.mean(axis=0)
    moments -= moments.mean(axis=1)[:, None]


class _SparseSteps:
    """The second moments of all agents, and what a step does to them, graph by graph."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment, m = experiment, experiment.agents
        self.moments, self._other = np.zeros((m, m)), np.empty((m, m))
        self._follows = np.isfinite(experiment.leader_gains)
        order, n = turns(experiment), len(experiment.graph_list)
        self._rank = np.zeros(m) if order is None else np.argsort(order)
        self._law = lru_cache(MOST_LAWS)(self._law_of)
        self._process = lru_cache(MOST_LAWS)(self._process_of)
        self._gains = np.arange(n) * bool(experiment.noise_gain.strides[0])  # all 0 where all graphs have the same

    def advance(self, mode: int) -> None:
        """Make a step with a graph, from 0."""
        rows, change, noise, (targets, sources, variance) = self._law(mode)
        own = np.diag(self.moments)
        each = variance * (own[targets] + own[sources] - 2.0 * self.moments[targets, sources])
        self.moments[rows] += change @ self.moments
        np.copyto(self._other, self.moments.T)
        self.moments, self._other = self._other, self.moments
        self.moments[rows] += change @ self.moments
        if isinstance(noise, np.ndarray):
            self.moments += noise
        else:
            self.moments[noise.row, noise.col] += noise.data
        if each.size:
            self.moments.flat[:: len(own) + 1] += np.bincount(targets, each, len(own))

    def _process_of(self, mode: int) -> Any:
        """(m, m) covariance of the process noise of a step."""
        gain = np.sqrt(self._experiment.step_length) * self._experiment.noise_gain[mode]
        gain[~self._follows] = 0.0
        return scipy.sparse.coo_array(gain @ gain.T)

    def _law_of(self, mode: int) -> tuple[IntArray, Any, Any, tuple[IntArray, IntArray, FloatArray]]:
        """Rows of D that are not zero, these rows of it, N, and the variance of what lost messages change."""
        experiment, m = self._experiment, self._experiment.agents
        graph, noise = experiment.graph_list[mode], experiment.noise
        hears = self._follows[graph.targets]
        targets, sources = graph.targets[hears], graph.sources[hears]
        sure = experiment.step_length * graph.weights[hears]
        loss = experiment.loss[targets, sources]
        mean = (1.0 - loss) * sure
        pull = experiment.step_length * np.where(self._follows, experiment.leader_gains, 0.0)
        own = np.where(self._follows, -np.bincount(targets, mean, m) - pull, -1.0)
        rows, place = np.flatnonzero(own), np.cumsum(own != 0.0) - 1
        entries = place[np.append(targets, rows)], np.append(sources, rows)
        change = scipy.sparse.csr_array((np.append(mean, own[rows]), entries), (len(rows), m))
        added = self._process(int(self._gains[mode]))
        if noise.link or noise.broadcast:
            links = scipy.sparse.csr_array((mean, (targets, sources)), (m, m))
            air = np.bincount(targets, (noise.link**2 + noise.broadcast**2 * loss) * mean * sure, m)
            added = (
                added + scipy.sparse.diags_array(np.asarray(air, dtype=float)) + noise.broadcast**2 * (links @ links.T)
            )
        ahead = self._rank[sources] < self._rank[targets]
        if ahead.any():  # agents that step first are heard with their new states: W = I + (I - ahead)^-1 D
            power = scipy.sparse.csr_array((mean[ahead], (targets[ahead], sources[ahead])), (m, m))
            inverse = scipy.sparse.eye_array(m, format="csr")
            while power.nnz:  # (I + ahead) (I + ahead^2) (I + ahead^4) ..., of which few are not I
                inverse, power = inverse + power @ inverse, power @ power
            change, added = inverse[rows][:, rows] @ change, inverse @ added @ inverse.T
        lossy = loss > 0.0
        lost = targets[lossy], sources[lossy], (loss * (1.0 - loss) * sure**2)[lossy]
        return rows, _stored(change), _stored(added.tocoo()), lost


def _stored(matrix: Any) -> Any:
    """The sparse matrix, or an array where it has many entries."""
    return matrix if matrix.nnz <= FEW * matrix.shape[0] * matrix.shape[1] else matrix.toarray()


class Matrices:
    """Step, system and steady moments of a run. Of a schedule, which may have too many graphs, only when used."""

    def __init__(
        self,
        experiment: Experiment,
        step: StepModel | None = None,
        system: JumpSystem | None = None,
        steady: FloatArray | None = None,
        *,
        first: int = 0,
    ) -> None:
        self.experiment, self._first = experiment, first
        self._given = step, system, steady

    @cached_property
    def step(self) -> StepModel:
        """See ``Prediction``."""
        return self._given[0] or build_step_model(self.experiment)

    @cached_property
    def system(self) -> JumpSystem:
        """See ``Prediction``."""
        known = self._given[1]
        return known or emulated(build_run_model(self.experiment, self.step), self.experiment.problem)

    @cached_property
    def steady(self) -> FloatArray:
        """See ``Prediction``."""
        if self._given[2] is not None:
            return self._given[2]
        start, modes = given_path(self.experiment)
        with blas_threads(self.experiment.agents):
            return path_moments(self.system, start[:, None], modes, self._first)[1]

    def path(self, steps: BoolArray | None = None) -> PathMoments:
        """Of a schedule: moments given its graphs; ``steps`` (N,): those that are made, by default all."""
        start, modes = given_path(self.experiment)
        made = np.ones(len(modes), np.bool_) if steps is None else steps
        first = int(made[: self._first].sum())
        if without_stacks(self.experiment):
            return sparse_moments(self.experiment, start, modes[made], first)
        path, steady = path_moments(self.system, start[:, None], modes[made], first)
        if steps is None:
            self._given = self.step, self.system, steady
        return path


def given_path(experiment: Experiment) -> tuple[FloatArray, IntArray]:
    """(m,) x(0) and (N,) graphs of a run with a schedule."""
    places = experiment.known_start
    assert places is not None, "a schedule has no steady state to start from"
    return places, mode_path(experiment, np.empty(0))


def mean_given(system: JumpSystem, start: FloatArray, modes: IntArray) -> FloatArray:
    """(d, d): mean of the second moments of y(0), ..., y(N - 1)."""
    total = np.zeros((system.dimension, system.dimension))
    for _, moments in islice(course(system, start, modes), len(modes)):
        total += moments
    return total / len(modes)


def _step(system: JumpSystem) -> StepModel:
    assert system.step is not None, "a system of the steps of a run"
    return system.step


def course(system: JumpSystem, start: FloatArray, modes: IntArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """(d,) means and (d, d) second moments of y(0), ..., y(N), from ``start`` (m, R) with the graphs ``modes`` (N,)."""
    step = _step(system)
    states = system.modes // step.modes  # of the channels
    channels = system.chain[:states, :states]
    shares: FloatArray = system.stationary.reshape(-1, states).sum(axis=0)

    def only(graphs: IntArray, chain: FloatArray) -> JumpSystem:
        which = (graphs[:, None] * states + np.arange(states)).reshape(-1)
        jumps = np.asarray(np.kron(chain, channels), dtype=float)
        law = np.tile(shares / len(graphs), len(graphs))
        return part(system, which, jumps, law, np.repeat(np.arange(len(graphs)), states))

    # The first steps may use the messages with x(0) again: their graphs are followed as a chain, which is certain, and
    # which has one more that stands for all links of the others.
    count = min(len(modes), step.delay + 2)
    graphs = np.append(modes[:count], 0)
    certain = np.eye(count + 1)[[*range(1, count), count - 1, count]]
    begin = dataclasses.replace(only(graphs, certain), step=_of_graphs(step, graphs, certain))
    law = np.kron(np.eye(count + 1)[0], shares)
    known = known_start(begin, (start - step.reference).T, law)
    for now in known[: len(modes) + 1]:
        yield now.means.sum(axis=0), now.moments.sum(axis=0)
    here = slice((len(known) - 1) * states, len(known) * states)
    means, moments, law = known[-1].means[here], known[-1].moments[here], known[-1].law[here]
    of_graph = {mode: only(np.array([mode]), np.ones((1, 1))) for mode in np.unique(modes).tolist()}
    for mode in modes[len(known) - 1 :].tolist():
        means = channels.T @ np.einsum("sab,sb->sa", of_graph[mode].matrices, means)
        moments, law = of_graph[mode].advance(moments, law)
        yield means.sum(axis=0), moments.sum(axis=0)


def _of_graphs(step: StepModel, graphs: IntArray, chain: FloatArray) -> StepModel:
    """The step with these graphs, one after the other, as its modes, and the last one with the links of all."""
    stacks = ("links", "weights", "nominal", "offsets", "noise_gain", "noise", "loss_variance")
    found = {name: getattr(step, name)[graphs] for name in stacks}
    found["links"][-1] = step.links.any(axis=0)
    return dataclasses.replace(step, switching=MarkovChain("discrete", chain), initial=np.eye(len(graphs))[0], **found)
