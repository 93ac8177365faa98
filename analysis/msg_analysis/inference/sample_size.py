# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""How long a run must be, and what it will find."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from msg_analysis.common.text import HALF_WIDTH_95, agent_text, counted, percent
from msg_analysis.errors import InputError
from msg_analysis.experiment.limits import prediction_method
from msg_analysis.inference.fault_power import FaultPower, fault_powers
from msg_analysis.inference.statistics import simultaneous_half_width
from msg_analysis.inference.time_means import expected_switches, few_switches
from msg_analysis.theory.first_steps import simplification
from msg_analysis.theory.prediction import Prediction, predict
from msg_analysis.theory.sampled_variance import sampled_mean_variance, sampled_warm_up
from msg_analysis.theory.sampling import sampled_prediction
from msg_analysis.theory.settling import settling_time
from msg_analysis.theory.time_mean_variance import MeanVariance, mean_variance
from msg_analysis.theory.transient import start_of

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment

REPLICAS: tuple[int, ...] = tuple(2**k for k in range(9))  # that are tried: 1 to 256
HARDLY_WORSE = 1.05  # a half-width up to so many times the least one is as good, if it needs fewer replicas
# Half-width of the 95 % interval that holds at all times at once, in standard errors, at the length it is made for
ANY_TIME_95: float = float(simultaneous_half_width(1.0, 1.0))


@dataclass(frozen=True, slots=True)
class Precision:
    """How precisely a run of any length measures the system error.

    Attributes
    ----------
    error
        predicted system error
    variance
        of its time mean
    warm_up
        steps until the effect of the start is within the precision that is sought; 0 from the stationary start
    any_time
        whether there is an interval that holds at all times at once
    """

    error: float
    variance: MeanVariance
    warm_up: int
    any_time: bool

    def standard_error(self, steps: float, replicas: float) -> float:
        """Standard error of the mean after so many steps, relative to the error; infinite within the warm-up.

        Parameters
        ----------
        steps
            length of the run, with the warm-up
        replicas
            of the run
        """
        counted = max(steps - self.warm_up, 0.0)
        return math.sqrt(self.variance.of(replicas) / counted) / self.error if counted else math.inf

    def steps(self, precision: float, replicas: int, *, any_time: bool = False) -> int:
        """Steps after which the half-width of the 95 % interval, relative to the error, is ``precision``.

        Parameters
        ----------
        precision
            half-width, above 0
        replicas
            of the run
        any_time
            of the interval that holds at all times at once, for a run that is planned for this length
        """
        width = ANY_TIME_95 if any_time else HALF_WIDTH_95
        needed = self.variance.of(replicas) * math.pow(width / (precision * self.error), 2.0)
        return self.warm_up + max(1, math.ceil(needed))

    def best_replicas(self, steps: int) -> int:
        """The fewest of ``REPLICAS`` with nearly the least half-width after so many steps.

        A step of a network takes nearly the same time with 1 and with 256 replicas (docs/planning.md).

        Parameters
        ----------
        steps
            length of the run
        """
        least = self.standard_error(steps, REPLICAS[-1])
        return next(r for r in REPLICAS if self.standard_error(steps, r) <= HARDLY_WORSE * least)


def precision_of(prediction: Prediction, sought: float) -> Precision:
    """Precision of runs; ``sought``: share of the error that the start has after the warm-up."""
    experiment = prediction.experiment
    stationary = experiment.run.start == "stationary" and experiment.switching.initial == "stationary"
    error = prediction.emulated.system_error
    warm_up = 0.0
    if not stationary and error > 0.0:
        start = start_of(experiment, prediction.system, prediction.system.lifted(prediction.steady))
        warm_up = settling_time(prediction.system, prediction.steady, start, sought)
    noise = experiment.noise
    plain = not (noise.on_air or noise.delay or experiment.run.pace == "realtime")
    return Precision(error, mean_variance(prediction), math.ceil(warm_up), plain)


def sampled_precision(experiment: Experiment, sought: float) -> Precision:
    """The same, sampled, where the errors are."""
    error = sampled_prediction(experiment).system_error
    variance, warm_up = sampled_mean_variance(experiment), sampled_warm_up(experiment, sought)
    return Precision(error, variance, warm_up, any_time=False)


@dataclass(frozen=True, slots=True)
class RunPlan:
    """What runs of an experiment will show.

    Attributes
    ----------
    experiment
        that is planned
    sought
        half-width of the 95 % interval of the system error, relative to the predicted one
    precision
        that a run of any length reaches
    level
        probability of a false "disagrees" of the tests
    seconds
        time budget [s], or None
    rate
        steps per second of wall time, or None where it is not known
    powers
        one for each fault
    notes
        what limits the plan, in words
    """

    experiment: Experiment
    sought: float
    precision: Precision
    level: float
    seconds: float | None
    rate: float | None
    powers: Sequence[FaultPower]
    notes: Sequence[str]

    def __repr__(self) -> str:
        experiment = self.experiment
        steps = self.precision.steps(self.sought, experiment.run.replicas)
        return f"<Plan of {experiment.name!r}: {steps} steps for {self.sought:.3g} of the system error>"

    def to_json(self) -> dict[str, Any]:
        """The document of ``msg-analysis plan --json``."""
        experiment, precision = self.experiment, self.precision
        replicas, variance = experiment.run.replicas, precision.variance
        return {
            "experiment": experiment.name,
            "names": experiment.names,
            "precision": self.sought,
            "system_error": precision.error,
            "pace": experiment.run.pace,
            "rate": self.rate,
            "variance": {"path": variance.path, "replica": variance.replica, "path_followed": variance.exact},
            "sampling_error": variance.error(replicas),
            "warm_up": precision.warm_up,
            "file": self._run(experiment.steps, replicas),
            "lengths": [self._lengths(r) for r in sorted({replicas, *REPLICAS})],
            "budget": self._budget(),
            "level": self.level,
            "faults": [self._fault(power) for power in self.powers],
            "notes": list(self.notes),
        }

    def _length(self, steps: int | None) -> dict[str, float | None]:
        if steps is None:
            return dict.fromkeys(("steps", "duration", "wall_time"))
        wall_time = steps / self.rate if self.rate else None
        return {"steps": steps, "duration": steps * self.experiment.step_length, "wall_time": wall_time}

    def _run(self, steps: int, replicas: int) -> dict[str, float | None]:
        error = self.precision.standard_error(steps, replicas)
        return {
            "replicas": replicas,
            **self._length(steps),
            "standard_error": error,
            "half_width": HALF_WIDTH_95 * error,
            "any_time_half_width": ANY_TIME_95 * error if self.precision.any_time else None,
        }

    def _lengths(self, replicas: int) -> dict[str, float | None]:
        precision, sought = self.precision, self.sought
        at_any_time = precision.steps(sought, replicas, any_time=True) if precision.any_time else None
        any_time = {f"any_time_{key}": value for key, value in self._length(at_any_time).items()}
        return {"replicas": replicas, **self._length(precision.steps(sought, replicas)), **any_time}

    def _budget(self) -> dict[str, Any] | None:
        if self.seconds is None or self.rate is None:
            return None
        steps = math.floor(self.seconds * self.rate)
        return {"time": self.seconds} | self._run(steps, self.precision.best_replicas(steps))

    def _fault(self, power: FaultPower) -> dict[str, Any]:
        steps = self.experiment.steps
        best = max(power.tests, key=lambda test: power.power_of(test, steps))
        return {
            "fault": self._fault_words(power),
            "kind": power.fault.kind,
            "factor": power.fault.factor,
            "agent": None if power.agent is None else power.agent + 1,
            "sender": None if power.sender is None else power.sender + 1,
            "test": best.name,
            "power": power.power(steps),
            "steps": power.steps(),
            "any_time_steps": power.evidence_steps(),
        }

    def _fault_words(self, power: FaultPower) -> str:
        names, factor = self.experiment.names, power.fault.factor
        if power.fault.kind == "switching":
            return f"all rates x {factor:g}"
        assert power.agent is not None
        agent = agent_text(power.agent + 1, names)
        if power.fault.kind == "noise":
            return f"noise variance of {agent} x {factor:g}"
        assert power.sender is not None
        return f"gain of {agent} on {agent_text(power.sender + 1, names)} x {factor:g}"


def _notes(prediction: Prediction, sought: float, precision: Precision) -> list[str]:
    notes, replicas = [], prediction.experiment.run.replicas
    if not precision.variance.exact:
        notes.append(f"the network is large, so the scatter of the mean is sampled: {_known_to(precision, replicas)}")
    for steps in sorted({prediction.experiment.steps, precision.steps(sought, replicas)}):
        if few := few_switches(expected_switches(prediction.step, steps)):
            notes.append(f"a run of {steps} steps {few}: its standard error is not yet that of a long run")
    if precision.warm_up and (note := simplification(prediction.system)):
        notes.append(note)
    if not precision.any_time:
        notes.append(
            "with noise, losses or delay of messages and in real time there is no interval that holds at all times"
        )
    return notes


def _known_to(precision: Precision, replicas: int) -> str:
    share = percent(precision.variance.error(replicas))
    return f"standard errors and half-widths with {counted(replicas, 'replica')} are known to {share} (standard error)"


def plan(
    experiment: Experiment,
    precision: float = 0.01,
    *,
    seconds: float | None = None,
    rate: float | None = None,
    level: float = 0.01,
) -> RunPlan:
    """Plan runs of an experiment, see ``Experiment.plan``; nothing is simulated."""
    run, dt = experiment.run, experiment.step_length
    if not 0.0 < precision < 1.0:
        raise InputError(f"precision: {precision:g}: expected a share of the error above 0, below 1: for example 0.01")
    if not 0.0 < level <= 0.5:
        raise InputError(f"level: {level:g}: expected a probability above 0, at most 0.5")
    if seconds is not None and not 0.0 < seconds < math.inf:
        raise InputError(f"budget: {seconds:g} s: expected a number above 0")
    if rate is not None and not 0.0 < rate < math.inf:
        raise InputError(f"speed: {rate:g} steps per second: expected a number above 0")
    if run.pace == "realtime":
        if rate is not None:
            raise InputError(
                f"speed: {rate:g} steps per second: in real time these are run.speed / run.dt, {run.speed / dt:g}: "
                "leave it out"
            )
        rate = run.speed / dt
    if seconds is not None and rate is None:
        raise InputError(
            "budget: a run in lockstep is as fast as the machine: give its speed in steps per second too, which "
            "`msg-agents run` prints"
        )
    zero = "precision: the predicted system error is 0, expected noise: set noise.process"
    if prediction_method(experiment)[0] == "sampled":
        experiment.require_available()
        if not experiment.noise_gain.any():
            raise InputError(zero)
        found = sampled_precision(experiment, precision)
        notes = [
            f"the errors are sampled, since there is no exact prediction: {_known_to(found, run.replicas)}",
            "without an exact prediction nothing is known of the power of the tests, nor an interval that holds at all "
            "times",
        ]
        return RunPlan(experiment, precision, found, level, seconds, rate, (), notes)
    experiment.require_available("steady")
    prediction = predict(experiment)
    if not prediction.emulated.system_error > 0.0:
        raise InputError(zero)
    found = precision_of(prediction, precision)
    powers = fault_powers(prediction, run.replicas, level)
    notes = _notes(prediction, precision, found)
    return RunPlan(experiment, precision, found, level, seconds, rate, powers, notes)
