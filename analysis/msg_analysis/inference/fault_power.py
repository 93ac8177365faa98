# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Power of the tests of a run for named faults, from the information that a step is expected to give.

A test's statistic is noncentral chi-square under the fault, with the noncentrality parameter N times that of a step:
twice the Kullback-Leibler divergence of the faulty law from the law (noise, switching), or the Fisher information of
the gain times the square of its change. The states have the steady moments of the law without the fault. Only the test
of what is wrong counts, at the level over the number of tests, the first bound of Holm's method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import special

from msg_analysis.common.text import HALF_WIDTH_95
from msg_analysis.experiment.markov_chain import MarkovChain, Schedule
from msg_analysis.inference.estimates import Estimate
from msg_analysis.inference.evidence_sums import EvidenceSums
from msg_analysis.inference.graphs import Switching
from msg_analysis.inference.messages import CommonGain, Gains
from msg_analysis.inference.noise import Noise
from msg_analysis.inference.question import Diagnostic
from msg_analysis.inference.received_values import Correlations
from msg_analysis.inference.regression import MAX_REGRESSORS, terms_of
from msg_analysis.inference.statistics import chi2_quantile
from msg_analysis.model.step_model import StepModel
from msg_analysis.theory.prediction import Prediction

POWER = 0.99  # for which lengths are given

Kind = Literal["noise", "gain", "switching"]


@dataclass(frozen=True, slots=True)
class Fault:
    """A part of the law that is multiplied by a factor."""

    kind: Kind  # noise variance of an agent, gain of a link in all graphs, all rates of switching
    factor: float
    agent: int | None = None  # from 0: whose noise, or who receives; None: where the fault is hardest to find
    sender: int | None = None


FAULTS = (
    *(Fault("noise", factor) for factor in (1.05, 1.1)),
    *(Fault("gain", factor) for factor in (0.8, 0.5)),
    *(Fault("switching", factor) for factor in (1.4, 0.7)),
)


@dataclass(frozen=True, slots=True)
class StepInformation:
    """What a test of a fault has in one step."""

    name: str
    dof: int
    noncentrality: float  # of a step, all replicas together


@dataclass(frozen=True, slots=True)
class FaultPower:
    """How surely a fault is found, at one agent or link."""

    fault: Fault
    agent: int | None  # from 0: whose noise, or who receives with this gain
    sender: int | None
    tests: Sequence[StepInformation]  # those of the fault
    level: float  # of each test
    log_price: float  # log evidence that the fault alone must bring to pass 1 / level, all questions together

    def power(self, steps: float) -> float:
        """Probability that the most powerful of the tests rejects after so many steps."""
        return max(self.power_of(test, steps) for test in self.tests)

    def power_of(self, test: StepInformation, steps: float) -> float:
        """The same of one of the tests."""
        x = chi2_quantile(self.level, test.dof)
        return float(1.0 - special.chndtr(x, test.dof, steps * test.noncentrality))

    def steps(self, power: float = POWER) -> float:
        """Steps after which a test has this power; infinite: never."""
        needed = [special.chndtrinc(chi2_quantile(self.level, test.dof), test.dof, 1.0 - power) for test in self.tests]
        each = zip(needed, self.tests, strict=True)
        return min(float(n) / test.noncentrality if test.noncentrality > 0.0 else math.inf for n, test in each)

    def evidence_steps(self) -> float:
        """Steps after which the evidence at any time is expected to pass: half of the runs stop before, about."""
        # The mixed likelihood ratio of a coefficient with the noncentrality L is exp(L^2 / (2 (1 + L))) / sqrt(1 + L),
        # for a prior of the size of the fault.
        information = max(test.noncentrality for test in self.tests)
        if not information > 0.0 or math.isinf(self.log_price):
            return math.inf
        low, high = 0.0, 4.0 * self.log_price + 100.0
        for _ in range(60):
            middle = (low + high) / 2.0
            found = 0.5 * middle**2 / (1.0 + middle) - 0.5 * math.log1p(middle)
            low, high = (middle, high) if found < self.log_price else (low, middle)
        return high / information


@dataclass(frozen=True, slots=True)
class RunPower:
    """What a run could have found."""

    half_width: float | None  # of the 95 % interval of the system error, relative to the prediction; None: unknown
    steps: int
    fault: FaultPower | None  # the first of ``EXAMPLES`` that the law can have

    def to_json(self) -> dict[str, Any]:
        """The document; agents from 1."""
        found = self.fault
        return {
            "half_width": self.half_width,
            "kind": found and found.fault.kind,
            "factor": found and found.fault.factor,
            "agent": None if found is None or found.agent is None else found.agent + 1,
            "sender": None if found is None or found.sender is None else found.sender + 1,
            "power": found and found.power(self.steps),
        }


EXAMPLES = Fault("noise", 1.1), Fault("gain", 0.5), Fault("switching", 1.4)


def run_power(prediction: Prediction, sums: EvidenceSums, steps: int, level: float, error: Estimate | None) -> RunPower:
    """Of a run of so many steps, with this system ``error``; the ``sums`` are its own."""
    scale, half_width = prediction.emulated.system_error, None
    if error and error.standard_error is not None and scale > 0.0:
        half_width = HALF_WIDTH_95 * error.standard_error / scale
    replicas = prediction.experiment.run.replicas
    found = (power for one in EXAMPLES for power in fault_powers(prediction, replicas, level, [one], sums))
    return RunPower(half_width, steps, next(found, None))


def fault_powers(
    prediction: Prediction,
    replicas: int,
    level: float,
    faults: Sequence[Fault] = FAULTS,
    sums: EvidenceSums | None = None,
) -> list[FaultPower]:
    """One for each of the ``faults`` that the law can have, not those without noise, links or switching."""
    step, sums = prediction.step, sums or EvidenceSums(prediction, replicas, in_detail=True)
    # While a run goes on, diagnostics are not asked.
    families = {name: logs.size for name, logs in sums.families().items()}
    questions = {name: size for name, size in families.items() if not isinstance(sums.questions[name], Diagnostic)}
    weights = dict(zip(questions, sums.weights(questions).tolist(), strict=True))
    share = level / sum(question.number_of_tests() for question in sums.questions.values())
    found = []
    for fault in faults:
        if fault.kind == "noise":
            name, informations = Noise.name, _noise(step, fault.factor, replicas)
        elif fault.kind == "gain":
            name, informations = Gains.name, _gain(prediction, fault.factor, replicas)
        else:
            name, informations = Switching.name, _switching(step, fault.factor)
        if fault.agent is not None:
            place = fault.agent, fault.sender
            informations = {key: tests for key, tests in informations.items() if key == place}
        if not informations:
            continue
        (agent, sender), tests = min(
            informations.items(), key=lambda entry: float(f"{max(test.noncentrality for test in entry[1]):.9g}")
        )
        price = math.log(questions[name] / (weights[name] * level)) if name in questions else math.inf
        found.append(FaultPower(fault, agent, sender, tests, share, price))
    return found


_Informations = dict[tuple[int | None, int | None], list[StepInformation]]


def _noise(step: StepModel, factor: float, replicas: int) -> _Informations:
    """Per agent with noise: the likelihood ratio of the covariance of the residuals."""
    same = bool((step.noise == step.noise[0]).all() and (step.noise_gain == step.noise_gain[0]).all())
    found: _Informations = {}
    graphs = slice(1 if same else step.modes)
    bases, shares = [Correlations(noise, 0.0).whitener() for noise in step.noise[graphs]], step.stationary
    dof = sum(rank * (rank + 1) // 2 for rank in (len(base) for base in (bases[:1] if same else bases)))
    larger = math.sqrt(factor) - 1.0
    for agent in range(step.agents):
        divergence = 0.0
        for share, whitener, gain in zip([1.0] if same else shares, bases, step.noise_gain[graphs], strict=True):
            # The covariance changes by c (e w^T + w e^T) + c^2 w_a e e^T, with c = larger, e a unit vector, w = own.
            own = gain @ gain[agent]
            pair = np.stack([whitener[:, agent], whitener @ own])
            change = np.array([[larger**2 * own[agent], larger], [larger, 0.0]]) @ (pair @ pair.T)
            values = np.linalg.eigvals(change).real
            divergence += float(share * (values - np.log1p(values)).sum())
        if divergence > 0.0:
            found[agent, None] = [StepInformation(Noise.name, dof, replicas * divergence)]
    return found


def _gain(prediction: Prediction, factor: float, replicas: int) -> _Informations:
    """Per link: the regression of the residuals on all that is received, and on their sum."""
    step, system = prediction.step, prediction.system
    covariances = system.lifted(system.by_graph(prediction.steady))  # (n, m, m), times pi
    reception = step.link**2 + step.broadcast**2
    terms = terms_of(step, MAX_REGRESSORS)
    links: dict[tuple[int, int], tuple[float, float]] = {}
    total = 0.0
    for mode, covariance in enumerate(covariances):
        law = float(step.stationary[mode])
        for i in range(step.agents):
            variance = float(step.noise[mode, i, i])
            if not variance > 0.0:
                continue
            row = step.nominal[mode, i].copy()
            row[i] = step.nominal[mode, i, i] - 1.0  # the whole pull on the agent, leaders included
            total += float(row @ covariance @ row) / variance
            for j in step.neighbours(mode, i).tolist():
                received, weight = 1.0 - float(step.losses[i, j]), float(step.nominal[mode, i, j])
                difference = np.zeros(step.agents)
                difference[i], difference[j] = -weight, weight
                own = float(difference @ covariance @ difference) + law * weight**2 * reception
                with_all = float(difference @ covariance @ row) + law * weight**2 * reception
                before = links.get((i, j), (0.0, 0.0))
                links[i, j] = before[0] + received * own / variance, before[1] + received * with_all / variance
                total += law * weight**2 * reception * received / variance
    change = (factor - 1.0) ** 2 * replicas
    return {
        link: [
            StepInformation(Gains.name, len(terms), change * own),
            StepInformation(CommonGain.name, 1, change * with_all**2 / total),
        ]
        for link, (own, with_all) in links.items()
        if own > 0.0
    }


def _switching(step: StepModel, factor: float) -> _Informations:
    """The likelihood ratio of the counted switches, with every rate away from a graph times the factor."""
    if step.modes == 1 or isinstance(step.switching, Schedule):
        return {}
    law = step.transition
    chain = step.chain
    if chain.time == "continuous":
        wrong = MarkovChain(chain.time, factor * chain.matrix).transition(step.dt)
    else:
        wrong = np.eye(chain.modes) + factor * (chain.matrix - np.eye(chain.modes))
    if (wrong < 0.0).any():  # the probabilities of leaving would pass 1
        return {}
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(wrong > 0.0, wrong * np.log(wrong / law), 0.0)
    divergence = 2.0 * float(step.stationary @ terms.sum(axis=1))
    dof = int((law > 0.0).sum()) - step.modes
    return {(None, None): [StepInformation(Switching.name, dof, divergence)]} if divergence > 0.0 else {}
