# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Exact moments of a run whose sequence of graphs is given: no chain is assumed.

With g(k) the graph of the step k -> k+1, the reduced states of a ``JumpSystem`` have the second moments

    M(0) = y(0) y(0)^T,    M(k+1) = K_g(k)[M(k)] + N_g(k).

With losses in bursts, M has one part for each state of the channels, between which a chain of their own switches.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.common.resources import tell
from msg_analysis.experiment.markov_chain import MarkovChain
from msg_analysis.model.step_model import StepModel
from msg_analysis.theory.first_steps import known_start
from msg_analysis.theory.jump_system import JumpSystem, part

STEPS_PER_REPORT = 1000


@dataclass(frozen=True, slots=True, eq=False)
class PathMoments:
    """Second moments of the states x(1), ..., x(N) given the graphs, and their errors."""

    system_errors: FloatArray  # (N,)
    node_errors: FloatArray  # (m,) mean over the steps from ``first`` on
    by_mode: FloatArray  # (n, d, d) the same of y y^T, those after the steps of each graph

    @property
    def largest(self) -> tuple[float, int]:
        """The largest system error, and of which x(k)."""
        k = int(np.argmax(self.system_errors))
        return float(self.system_errors[k]), k + 1


def path_moments(system: JumpSystem, start: FloatArray, modes: IntArray, first: int = 0) -> PathMoments:
    """Moments of a run from ``start`` (m, R) with the graphs ``modes`` (N,), means over x(first + 1), ..., x(N)."""
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
    by_mode /= max(1, len(modes) - first)
    return PathMoments(errors, np.diag(system.lifted(by_mode.sum(axis=0))), by_mode)


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
