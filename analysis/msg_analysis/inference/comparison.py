# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The result of a comparison."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.text import (
    agent_text,
    half_width_text,
    listed,
    markdown_table,
    measured_text,
    number_text,
    with_names,
    z_text,
)
from msg_analysis.errors import ExitCode
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.candidates import Cause
from msg_analysis.inference.counts import LossTest, SwitchingTest
from msg_analysis.inference.estimates import CovarianceTest, Estimate, Ranking
from msg_analysis.inference.evidence_sums import AnyTimeEvidence
from msg_analysis.inference.fault_power import RunPower
from msg_analysis.inference.given_path import GivenPath
from msg_analysis.inference.question import Test
from msg_analysis.inference.realtime_laws import Laws
from msg_analysis.inference.received_values import errors_have_digits, state_rounding, without_digits
from msg_analysis.inference.residuals import ResidualTests
from msg_analysis.inference.time_means import TimeMeans, few_switches
from msg_analysis.inference.timing import Timing
from msg_analysis.model.run import Completeness, Run
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import step_law
from msg_analysis.theory.fourth_moments import FourthMoment
from msg_analysis.theory.prediction import SHOWN_AGENTS, Prediction
from msg_analysis.theory.sampling import SampledPrediction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Keys of an experiment that do not change its law
MAY_DIFFER = {"name", "names", "run.seed", "run.duration", "run.processes", "run.speed"}
MAY_DIFFER |= {"run.external", "run.publish", "run.frame"}


def law_keys(experiment: Experiment) -> dict[str, Any]:
    """Every key (nested ones with dots) that defines the law of a run, and its value."""
    found = flat(experiment.to_document())
    # The order of the graphs is that of the modes.
    found["graphs"] = [graph.name for graph in experiment.graph_list]
    if experiment.protocol:
        found["protocol.version"] = experiment.protocol.info.version
    return {key: value for key, value in found.items() if key not in MAY_DIFFER}


def law_identity(experiment: Experiment) -> str:
    """A text of 16 hexadecimal digits, the same for runs of the same law."""
    text = json.dumps(law_keys(experiment), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def first_difference(one: Experiment, other: Experiment) -> tuple[str, Any, Any] | None:
    """Key and both values of the first difference, by name; None where the law is the same."""
    a, b = law_keys(one), law_keys(other)
    for key in sorted(a.keys() | b.keys()):
        if a.get(key) != b.get(key):
            return key, a.get(key), b.get(key)
    return None


def flat(document: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Every key of nested mappings, joined by dots, and its value."""
    found: dict[str, Any] = {}
    for key, value in document.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found


Reason = Literal["few_digits", "heavy_tails", "kept_values", "short_run", "few_switches"]


@dataclass(frozen=True, slots=True)
class Trust:
    """Which errors to trust, and why not the others; ``errors`` is None where no errors have valid intervals."""

    errors: Literal["all_paths", "given_path"] | None
    reason: Reason | None = None
    words: str | None = None


def few_digits(prediction: Prediction) -> Trust | None:
    """What cannot be tested because the digits of the states end above the noise; None where nothing is left out."""
    agents = (without_digits(prediction) + 1).tolist()
    if not agents:
        return None
    known = errors_have_digits(prediction)
    who = "all agents" if len(agents) == prediction.step.agents else f"agent {listed(agents)}"
    return Trust(
        "all_paths" if known else None,
        "few_digits",
        f"The states are so large that their last digit is worth {number_text(2.0 * state_rounding(prediction), 2)}, "
        f"not small against the noise of {who} in a step. This noise {'is' if known else 'and the errors are'} not "
        "tested. Subtract a common number from x(0) and the reference.",
    )


def trusted(prediction: Prediction, means: TimeMeans, *, given: bool) -> Trust:
    """Which errors in lockstep to trust, from means over all paths; ``given``: whether there are corrected ones."""
    doubt = _doubt(prediction, means)
    if doubt is None:
        return Trust("all_paths")
    instead = "Trust the tests of residuals and switching, which do not depend on this."
    if given:
        instead = "Trust the errors corrected for the graph sequence, and the tests, which do not depend on this."
    return Trust("given_path" if given else None, doubt[0], f"{doubt[1]} {instead}")


def _doubt(prediction: Prediction, means: TimeMeans) -> tuple[Reason, str] | None:
    """What makes the intervals of the errors over all paths wrong, in words."""
    if prediction.path and means.long_enough:
        return None
    if means.heavy:
        return "heavy_tails", (
            f"The fourth moments of the states {_infinite(prediction.fourth_moment)}: rare large values make a large "
            "part of the mean error, so most runs measure less than the prediction, and the errors over all paths of "
            "the graphs have no standard error and no interval."
        )
    if prediction.system.readout is not None:
        return "kept_values", (
            "Agents keep values from step to step, so the standard errors over all paths of the graphs depend on more "
            "than the log and are not known."
        )
    if not means.long_enough:
        return "short_run", "The run is too short for intervals of the errors over all paths of the graphs."
    few = few_switches(means.switches)
    if few is None:
        return None
    return "few_switches", (
        f"This run {few}, so the errors over all paths of the graphs depend on a few random lengths: they are far from "
        "normal, and their intervals are too wide."
    )


def _infinite(fourth: FourthMoment) -> str:
    if fourth.finite is None:
        return "may be infinite (their growth is not known exactly)"
    radius = fourth.radius if fourth.radius is not None else fourth.lower
    least = "" if fourth.radius is not None else "at least "
    return f"are infinite (they grow {least}{number_text(radius, 3)} times per step)"


Verdict = Literal["agrees", "disagrees", "late", "incomplete", "unpredicted"]

MAX_MISSED = 0.05  # share of the deadlines of a run in real time, above which its verdict is "late"

EXIT_CODES: dict[Verdict, ExitCode] = {
    "agrees": ExitCode.FINE,
    "disagrees": ExitCode.DISAGREES,
    "late": ExitCode.LATE,
    "incomplete": ExitCode.INCOMPLETE,
    "unpredicted": ExitCode.FINE,
}


@dataclass(frozen=True, slots=True, eq=False)
class PooledRun:
    """One of the runs."""

    name: str  # of its bag
    record: RunRecord
    steps: int  # used: all, or those before the first gap; 0 where these are too few
    completeness: Completeness
    system_error: Estimate
    tested: Estimate  # the same, corrected for the path of the graphs where that is known
    verdict: str  # on this run alone

    def to_json(self) -> dict[str, Any]:
        """The document of one row."""
        count = self.completeness
        return {
            "bag": self.name,
            "run": str(self.record.run),
            "seed": self.record.experiment.run.seed,
            "steps": self.steps,
            "simulated_time": self.steps * self.record.experiment.step_length,
            "complete": count.complete,
            "missing": count.missing,
            "missing_modes": count.missing_modes,
            "verdict": self.verdict,
            "system_error": self.system_error,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Pool:
    """The runs of a comparison, and Cochran's Q test of whether their system errors differ; None without."""

    members: tuple[PooledRun, ...]
    chi2: float | None = None
    dof: int | None = None
    p: float | None = None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Comparison:
    """The result of ``msg-analysis compare``.

    Attributes
    ----------
    trajectory
        what was compared; of several runs it has no data, but the completeness of all
    level
        probability of a false "disagrees", at most
    steps
        steps used: all, or those before the first gap
    system_error, node_errors, covariance, innovations, switching
        estimates and tests; ``switching`` is None where too few steps arrived. The errors have standard errors over all
        paths of the graphs, if the run is long enough for these
    continuous_error
        the paper's continuous-time system error; None where it has none
    batch
        (low, high), the 95 % interval of batch means for the system error; None for short runs
    tests
        the family, in the order of the report
    running
        "time" [units of simulated time], and the mean of the system error up to then with its standard error (0 without
        a prediction, and in runs that are too short for it): "system_error", "standard_error"; (T,) each, T at most 400
    loss
        test of the lost messages; None where none can be lost
    p_broadcast
        of the noise in published values; None without
    unpredicted
        why there is no prediction; None where there is one
    sampled
        the steady errors by sampling, where only their exact prediction is too large; the verdict does not use them
    transient
        steps at the start that are left out of the measured errors; None with a prediction, which includes them
    timing, laws
        in real time: how time was kept, and which laws the log supports; None in lockstep. The errors and the
        covariance are compared with the logged-pattern law where it is available, else with the sequential law
    given
        errors given the path of the graphs; None where they are not computed
    order
        which agents have smaller errors than which; None where the run is too short to know
    causes
        what is wrong, where the verdict is "disagrees"
    pool
        the runs, where there are several
    any_time
        evidence that holds at any time; None where too few steps arrived, or without a prediction
    trust
        in lockstep: which errors have valid intervals, and why; None where too few steps arrived, or without a
        prediction
    max_missed
        in real time: share of missed deadlines above which the verdict is "late"
    power
        what the run could have found; None where too few steps arrived, or without a prediction
    """

    trajectory: Run
    level: float
    steps: int
    system_error: Estimate
    node_errors: list[Estimate]
    covariance: CovarianceTest
    running: dict[str, FloatArray]
    innovations: ResidualTests = field(default_factory=ResidualTests)
    switching: SwitchingTest | None = None
    continuous_error: float | None = None
    batch: tuple[float, float] | None = None
    tests: list[Test] = field(default_factory=list)
    loss: LossTest | None = None
    p_broadcast: float | None = None
    unpredicted: str | None = None
    sampled: SampledPrediction | None = None
    transient: int | None = None
    timing: Timing | None = None
    laws: Laws | None = None
    given: GivenPath | None = None
    order: Ranking | None = None
    causes: Sequence[Cause] = ()
    pool: Pool | None = None
    any_time: AnyTimeEvidence | None = None
    trust: Trust | None = None
    max_missed: float = MAX_MISSED
    power: RunPower | None = None

    def __repr__(self) -> str:
        total, runs = self.system_error, f"{len(self.pool.members)} runs" if self.pool else "run"
        numbers = f"measured {measured_text(total.measured, total.interval)}, predicted {number_text(total.predicted)}"
        name = self.trajectory.record.experiment.name
        return f"<Comparison, {runs} of {name!r}: {self.verdict}; system error {numbers}>"

    def _repr_markdown_(self) -> str:
        names = self.trajectory.record.experiment.names
        rows = [
            (
                name,
                number_text(error.measured),
                half_width_text(error.interval),
                number_text(error.predicted),
                z_text(error.z),
            )
            for name, error in [
                ("**system**", self.system_error),
                *((agent_text(i, names), node) for i, node in enumerate(self.node_errors[:SHOWN_AGENTS], start=1)),
            ]
        ]
        rows += [("...", "", "", "", "")] * (len(self.node_errors) > SHOWN_AGENTS)
        table = markdown_table(("mean-square error", "measured", "± (95 %)", "predicted", "z"), rows)
        causes = "".join(f"- {with_names(cause.words, names)}\n" for cause in self.causes)
        return f"**{self.verdict}**\n\n{table}" + (f"\n{causes}" if causes else "")

    @property
    def verdict(self) -> Verdict:
        """Verdict: "incomplete" if data are missing, else "disagrees" if a test of the family is rejected.

        Else a run in real time is "late" if it missed more deadlines than ``max_missed``: its agents follow the model
        given what they received, but what was predicted before the run was never put to the test.
        A run that was to end as soon as its evidence disagrees (``--until decided``) disagrees when that has happened.
        Without a prediction the remaining tests cannot show that a run agrees: "unpredicted".
        """
        if not self.trajectory.completeness.complete:
            return "incomplete"
        until = self.trajectory.record.until
        decided = until is not None and until.decided and self.any_time is not None and self.any_time.exceeded
        if decided or any(test.rejected for test in self.tests):
            return "disagrees"
        if self.timing and self.timing.missed_share > self.max_missed:
            return "late"
        if self.pool and any(member.verdict == "late" for member in self.pool.members):
            return "late"
        return "unpredicted" if self.unpredicted else "agrees"

    @property
    def exit_code(self) -> int:
        """0 agrees or unpredicted, 1 disagrees, 3 incomplete, 4 late."""
        return EXIT_CODES[self.verdict]

    def plot(self) -> Figure:
        """Draw the system error up to each time and the agents' errors, with 95 % intervals, beside the prediction.

        Returns
        -------
        matplotlib.figure.Figure
            notebooks show it; ``figure.savefig("comparison.png")`` writes it
        """
        from msg_analysis.report.figures import comparison_figure

        return comparison_figure(self)

    def _real_time(self) -> dict[str, Any] | None:
        """In real time: what is said of the agents given the log, and of the prediction made before the run."""
        if self.laws is None or self.timing is None:
            return None
        return {
            "follows_model": not any(test.rejected for test in self.tests),
            "prediction": self.laws.sequential.supported,
            "missed": self.timing.missed_share,
            "max_missed": self.max_missed,
        }

    @property
    def _law(self) -> str:
        """The law that the errors are compared with."""
        if self.laws:
            return self.laws.measured_against
        tested = any(test.name == "system error" for test in self.tests)
        real_time = self.trajectory.record.experiment.run.pace == "realtime"
        return "pattern" if self.pool and real_time and tested else step_law(self.trajectory.record.experiment)

    def to_json(self) -> dict[str, Any]:
        """The document of ``msg-analysis compare --json``; every number is finite or None."""
        record, until = self.trajectory.record, None
        if record.until is not None:
            until = {
                "rule": str(record.until),
                "planned_steps": record.planned_steps,
                "ended_early": record.planned is not None,
            }
        document = {
            "verdict": self.verdict,
            "unpredicted": self.unpredicted,
            "sampled": self.sampled
            and {"system_error": self.sampled.system_error, "interval": list(self.sampled.interval)},
            "transient": self.transient,
            "run": None if self.pool else str(record.run),
            "experiment": record.experiment.name,
            "experiment_identity": law_identity(record.experiment),
            "names": record.experiment.names,
            "leaders": (np.flatnonzero(record.experiment.leader_gains) + 1).tolist(),
            "external": sorted(agent + 1 for agent in record.experiment.external),
            "seed": None if self.pool else record.experiment.run.seed,
            "level": self.level,
            "until": until,
            "completeness": asdict(self.trajectory.completeness) | {"stretch": self.trajectory.stretch},
            "steps": self.steps,
            "simulated_time": self.steps * record.experiment.step_length,
            "law": self._law,
            "bags": self.pool and self.pool.members,
            "homogeneity": {key: getattr(self.pool, key, None) for key in ("chi2", "dof", "p")},
            "system_error": self.system_error,
            "node_errors": self.node_errors,
            "covariance": self.covariance,
            "innovations": self.innovations,
            "switching": self.switching or dict.fromkeys(("counts", "expected", "p")),
            "loss": self.loss or dict.fromkeys(("lost", "expected", "p")),
            "broadcast": {"p": self.p_broadcast},
            "timing": self.timing,
            "laws": self.laws,
            "real_time": self._real_time(),
            "given_path": self.given,
            "order": self.order,
            "causes": self.causes,
            "continuous": {"system_error": self.continuous_error},
            "batch_means": {"interval": self.batch or (None, None)},
            "tests": self.tests,
            "any_time": self.any_time,
            "trust": self.trust,
            "power": self.power,
        }
        return {key: _plain(value) for key, value in document.items()}


def _plain(value: Any) -> Any:
    """JSON-able: arrays become lists, objects dictionaries, and numbers that are not finite None."""
    if hasattr(value, "to_json"):
        value = value.to_json()
    elif is_dataclass(value) and not isinstance(value, type):
        value = {each.name: getattr(value, each.name) for each in fields(value)}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
