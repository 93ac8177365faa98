# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What the law does between two samples of a log, given the path of the graphs, with switches inside the interval.

x is the deviation from the reference. A stretch of length s of graph g makes Phi x + w of it,

    Phi = exp(-Z_g s),    Cov(w) = Q = int_0^s exp(-Z_g u) F_g F_g^T exp(-Z_g u)^T du

(Van Loan, IEEE Trans. Automatic Control 23 (1978)). Both are power series in s, whose coefficients are computed once
for a graph; long stretches are doubled: Phi(2s) = Phi(s)^2, Q(2s) = Q(s) + Phi(s) Q(s) Phi(s)^T.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.regression import MAX_REGRESSORS, Term
from msg_analysis.model.step_model import StepModel, build_step_model

ORDER = 24  # of the power series: its remainder is below 1e-16 up to the norm
NORM = 1.0  # of Z_g s, beyond which a stretch is halved
NODES, WEIGHTS = (np.polynomial.legendre.leggauss(4)[0] + 1) / 2, np.polynomial.legendre.leggauss(4)[1] / 2
MOST_NODES = 8  # steps within an interval at which regressors are evaluated
OFF_GRID = 0.01  # of a step: how far a sample may be from a multiple of dt
TINY = 1e-30  # relative: what is less is set to 0, since products of it would be subnormal numbers, which are slow
BALANCE = 1e-12  # of a row of Z_g, relative: what is less is rounding


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """(S,) stretches of intervals, in the order of time: number of the interval, graph and length."""

    interval: IntArray
    graph: IntArray
    length: FloatArray


class IntervalLaw(ABC):
    """The law of m agents over stretches with one graph each."""

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self.agents = experiment.agents
        self.modes = len(experiment.graph_list)
        self.held = np.isinf(experiment.leader_gains)  # (m,) leaders that are always at the reference
        self.reference = experiment.reference
        self.unit = 1.0  # of the lengths of stretches [units of simulated time]

    @abstractmethod
    def drift(self, graph: int) -> FloatArray:
        """(m, m): what the gains of a term weigh: of the rate of change, or of the change in a step."""

    @property
    @abstractmethod
    def noise(self) -> FloatArray:
        """(n, m, m): covariance of the noise per unit of length."""

    @abstractmethod
    def over(self, graph: int, length: FloatArray, apart: bool = True) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(B, m, m) Phi and Q of stretches of lengths (B,), and (B, m, m, m) each agent's part of Q, if wanted."""

    @abstractmethod
    def nodes(self, graph: int, length: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(B, q, m, m) Phi before q times in each stretch (B,) and after these, and (B, q) weights of the times."""

    @abstractmethod
    def stretches(self, times: FloatArray, starts: FloatArray, graphs: IntArray) -> Stretches:
        """Of the intervals between samples at times (N,), given the path."""

    def parts(self) -> FloatArray:
        """(n, m, m, m): the derivative of the noise by the logarithm of each agent's variance."""
        shape = self.modes, self.agents, self.agents, self.agents
        parts, each = np.zeros(shape), np.arange(self.agents)
        parts[:, each, each, :] += self.noise / 2.0
        parts[:, each, :, each] += self.noise.transpose(2, 0, 1) / 2.0
        return parts

    @abstractmethod
    def with_drifts(self, drifts: FloatArray) -> Self:
        """The same law with other drifts (n, m, m)."""

    def changed(self, terms: Sequence[Term], change: FloatArray) -> Self:
        """With the gains of the terms larger by (K,); constants stay as they are."""
        drifts = np.array([self.drift(graph) for graph in range(self.modes)])
        for term, more in zip(terms, change.tolist(), strict=True):
            graphs, i = slice(None) if term.graph is None else term.graph, term.agent
            if term.kind == "pull":
                drifts[graphs, i] *= 1.0 + more
            elif term.kind != "constant":
                drifts[graphs, i, i] += more if term.kind == "lead" else -more
                if term.sender is not None:
                    drifts[graphs, i, term.sender] += more
        return self.with_drifts(drifts)

    def terms(self, most: int = MAX_REGRESSORS) -> list[Term]:
        """Regressors: a constant of every agent, all links, all leaders; without links apart where these are many."""
        m, drifts = self.agents, [self.drift(graph) for graph in range(self.modes)]
        terms = [Term("constant", i) for i in range(m) if not self.held[i]]
        found: list[Term] = []
        for graph, drift in enumerate(drifts):
            pull = drift.sum(axis=1)
            for i in np.flatnonzero(~self.held).tolist():
                senders = np.flatnonzero(drift[i] * (np.arange(m) != i)).tolist()
                found += [Term("link", i, graph, j, float(drift[i, j])) for j in senders]
                if abs(pull[i]) > BALANCE * np.abs(drift[i]).sum():
                    found.append(Term("lead", i, graph, None, float(pull[i])))
        if len(terms) + len(found) > most:
            found = [Term("pull", i, None) for i in np.flatnonzero(~self.held).tolist()]
        return terms + found

    def rows(self, terms: list[Term], graph: int) -> tuple[FloatArray, FloatArray]:
        """(K, m) and (K,): what of x, and which constant, the coefficients of terms add to the drift of its agent."""
        linear, constant = np.zeros((len(terms), self.agents)), np.zeros(len(terms))
        for place, term in enumerate(terms):
            if term.graph not in (None, graph):
                continue
            if term.kind == "constant":
                constant[place] = 1.0
            elif term.kind == "pull":
                linear[place] = self.drift(graph)[term.agent]
            else:
                linear[place, term.agent] = 1.0 if term.kind == "lead" else -1.0
                if term.sender is not None:
                    linear[place, term.sender] = 1.0
        return linear, constant


class ContinuousLaw(IntervalLaw):
    """The differential equation of the paper (Sections 3.1 and 3.2)."""

    def __init__(self, experiment: Experiment) -> None:
        super().__init__(experiment)
        follows = ~self.held
        gains = np.where(follows, experiment.leader_gains, 0.0)
        drift = np.stack([graph.laplacian for graph in experiment.graph_list]) + np.diag(gains)
        self._drift = drift * follows[:, None]  # (n, m, m) Z_g; a held leader does not move
        gain = experiment.noise_gain * follows[:, None]
        self._noise = np.asarray(gain @ gain.transpose(0, 2, 1))
        self._expand()

    def _expand(self) -> None:
        self._norm = np.abs(self._drift).sum(axis=2).max(axis=1)
        parts = self.parts()
        self._series = [self._powers(graph, parts[graph]) for graph in range(self.modes)]

    def with_drifts(self, drifts: FloatArray) -> Self:
        """-Z_g."""
        other = copy.copy(self)
        other._drift = -drifts
        other._expand()
        return other

    def drift(self, graph: int) -> FloatArray:
        """-Z_g."""
        return np.asarray(-self._drift[graph])

    @property
    def noise(self) -> FloatArray:
        """F_g F_g^T."""
        return self._noise

    def _powers(self, graph: int, parts: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(ORDER, ...): coefficients of the series of Phi in s, and of Q / s and its parts."""
        z, m = self._drift[graph], self.agents
        power, stack = np.eye(m), np.concatenate([self._noise[graph][None], parts])
        phi, noise = [power], [stack]
        for k in range(1, ORDER):
            power = -z @ power / k
            stack = -(z @ stack + stack @ z.T) / (k + 1)
            phi.append(power)
            noise.append(stack)
        both = np.array(noise)
        return np.array(phi), both[:, 0], both[:, 1:]

    def over(self, graph: int, length: FloatArray, apart: bool = True) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See ``IntervalLaw.over``."""
        same, back = np.unique(length, return_inverse=True)
        doublings = np.ceil(np.log2(np.maximum(same * self._norm[graph] / NORM, 1.0))).astype(np.int64)
        short = same * 2.0**-doublings
        powers = short[:, None] ** np.arange(ORDER)
        phi, q, parts = (np.tensordot(powers, series, axes=1) for series in self._of(graph, apart))
        q, parts = q * short[:, None, None], parts * short[:, None, None, None]
        for done in range(int(doublings.max(initial=0))):
            at = np.flatnonzero(doublings > done)
            left = phi[at]
            right = left.transpose(0, 2, 1)
            q[at] += left @ q[at] @ right
            parts[at] += left[:, None] @ parts[at] @ right[:, None]
            phi[at] = left @ left
        for array, size in ((phi, 1.0), (q, short.max(initial=0.0) * np.abs(self._noise).max())):
            array[np.abs(array) < TINY * size] = 0.0
        return phi[back], q[back], parts[back]

    def _of(self, graph: int, apart: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
        phi, noise, parts = self._series[graph]
        return phi, noise, parts if apart else parts[:, :0]

    def nodes(self, graph: int, length: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of Gauss and Legendre, which are symmetric: what is before one is after its mirror image."""
        times = length[:, None] * NODES
        before = self._phi(graph, times.reshape(-1)).reshape(*times.shape, self.agents, self.agents)
        return before, before[:, ::-1], length[:, None] * WEIGHTS

    def _phi(self, graph: int, length: FloatArray) -> FloatArray:
        same, back = np.unique(length, return_inverse=True)
        doublings = np.ceil(np.log2(np.maximum(same * self._norm[graph] / NORM, 1.0))).astype(np.int64)
        phi = np.tensordot((same * 2.0**-doublings)[:, None] ** np.arange(ORDER), self._series[graph][0], axes=1)
        for done in range(int(doublings.max(initial=0))):
            at = np.flatnonzero(doublings > done)
            phi[at] = phi[at] @ phi[at]
        return np.asarray(phi[back])

    def stretches(self, times: FloatArray, starts: FloatArray, graphs: IntArray) -> Stretches:
        """Cut at every switch."""
        inside = starts[(starts > times[0]) & (starts < times[-1])]
        cuts = np.unique(np.concatenate([times, inside]))
        interval = np.searchsorted(times, cuts[:-1], side="right") - 1
        graph = graphs[np.searchsorted(starts, cuts[:-1], side="right") - 1]
        return Stretches(interval, graph, np.diff(cuts))


class StepsLaw(IntervalLaw):
    """The steps of a run in lockstep: x -> W_g x + w; lengths are numbers of steps."""

    def __init__(self, experiment: Experiment, step: StepModel | None = None) -> None:
        super().__init__(experiment)
        self._step = step or build_step_model(experiment)
        self.held = self.held & ~self._step.noise.any(axis=(0, 2))
        self.unit = experiment.step_length

    def drift(self, graph: int) -> FloatArray:
        """W_g - I."""
        return np.asarray(self._step.nominal[graph] - np.eye(self.agents)) * ~self.held[:, None]

    def with_drifts(self, drifts: FloatArray) -> Self:
        """W_g - I."""
        other, moved = copy.copy(self), ~self.held[:, None]
        other._step = replace(self._step, nominal=np.where(moved, drifts + np.eye(self.agents), self._step.nominal))
        return other

    @property
    def noise(self) -> FloatArray:
        """N_g."""
        return self._step.noise

    def over(self, graph: int, length: FloatArray, apart: bool = True) -> tuple[FloatArray, FloatArray, FloatArray]:
        """By repeated squaring."""
        left, m = length.astype(np.int64), self.agents
        each = self._step.nominal[graph], self.noise[graph], self.parts()[graph]
        phi, q = np.broadcast_to(np.eye(m), (len(left), m, m)).copy(), np.zeros((len(left), m, m))
        parts = np.zeros((len(left), m * apart, m, m))
        while left.any():
            at = np.flatnonzero(left % 2)
            w, n, p = each
            q[at] = w @ q[at] @ w.T + n
            parts[at] = w @ parts[at] @ w.T + p[: m * apart]
            phi[at] = w @ phi[at]
            left = left // 2
            each = w @ w, n + w @ n @ w.T, p + w @ p @ w.T
        return phi, q, parts

    def nodes(self, graph: int, length: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The steps, or in long stretches some of them."""
        steps = length.astype(np.int64)
        count = int(min(steps.max(initial=1), MOST_NODES))
        at = np.minimum((np.arange(count) * steps[:, None]) // np.minimum(steps, count)[:, None], steps[:, None] - 1)
        weights = np.where(np.arange(count) < steps[:, None], steps[:, None] / np.minimum(steps, count)[:, None], 0.0)
        highest = int(steps.max(initial=1))
        needed, back = np.unique(np.concatenate([at, steps[:, None] - 1 - at]), return_inverse=True)
        found, power, done = [], np.eye(self.agents), 0
        for wanted in needed.tolist():
            power = np.linalg.matrix_power(self._step.nominal[graph], min(wanted, highest) - done) @ power
            done = min(wanted, highest)
            found.append(power)
        both = np.array(found)[back.reshape(2, *at.shape)]
        return both[0], both[1], weights

    def stretches(self, times: FloatArray, starts: FloatArray, graphs: IntArray) -> Stretches:
        """In whole steps; InputError: a sample is not at a multiple of ``dt`` after the first one."""
        exact = (times - times[0]) / self.unit
        steps = np.rint(exact).astype(np.int64)
        off = np.abs(exact - steps)
        worst = int(np.argmax(off))
        if off[worst] > OFF_GRID or (np.diff(steps) < 1).any():
            raise InputError(
                f"law: steps: the sample at {times[worst]:.12g} is {exact[worst]:.6g} steps of {self.unit:g} after the "
                "first: expected whole numbers of steps: use law: continuous, or give `units` and `run.dt` of the log"
            )
        # As in a run: a graph is used from the first step on that is not before it.
        first = np.ceil((starts - times[0]) / self.unit - OFF_GRID).astype(np.int64)
        cuts = np.unique(np.concatenate([steps, first[(first > 0) & (first < steps[-1])]]))
        interval = np.searchsorted(steps, cuts[:-1], side="right") - 1
        graph = graphs[np.maximum(np.searchsorted(first, cuts[:-1], side="right") - 1, 0)]
        return Stretches(interval, graph, np.diff(cuts).astype(float))


def interval_law(experiment: Experiment, sampled: str) -> IntervalLaw:
    """The law of a log. InputError: it has something that a log of states cannot be compared with."""
    noise, others = experiment.noise, []
    others += [f"noise.{key}" for key in ("broadcast", "link", "delay") if getattr(noise, key)]
    others += ["noise.loss"] * noise.loss.any
    if experiment.protocol and not experiment.protocol.linear:
        others.append("protocol (not linear)")
    if others:
        raise InputError(
            f"{experiment.source}: {', '.join(others)}: a log of states does not say which messages were received: "
            "expected none of these: remove them from the law"
        )
    if sampled == "steps":
        return StepsLaw(experiment)
    if experiment.time != "continuous" or experiment.protocol:
        what = "a protocol" if experiment.protocol else "time: discrete"
        raise InputError(f"{experiment.source}: {what}: expected law: steps in the map, since this law has only steps")
    return ContinuousLaw(experiment)


def block_size(law: IntervalLaw, terms: int) -> int:
    """Intervals of which all matrices fit in some ten megabytes."""
    m = law.agents
    return max(16, math.floor(4e6 / (m * m * (m + 4 * len(NODES) + 4) + m * terms)))
