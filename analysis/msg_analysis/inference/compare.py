"""A run against its prediction: the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from msg_analysis.inference.air import LossTest, loss_test
from msg_analysis.inference.batch import batch_interval
from msg_analysis.inference.blame import Accused, Cause, find_causes
from msg_analysis.inference.estimates import CovarianceTest, Estimate, covariance_test, estimates
from msg_analysis.inference.evidence import Evidence
from msg_analysis.inference.given_path import GivenPath
from msg_analysis.inference.identity import law_identity
from msg_analysis.inference.innovations import InnovationTests
from msg_analysis.inference.laws import Laws
from msg_analysis.inference.martingale import TimeMeans
from msg_analysis.inference.measurement import Measurement
from msg_analysis.inference.multiplicity import holm
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.order import Order, order_of_nodes
from msg_analysis.inference.switching import SwitchingTest, switching_test
from msg_analysis.inference.timing import Timing
from msg_analysis.markdown import markdown_table, number_text
from msg_analysis.model.sequential import step_law
from msg_analysis.model.trajectory import Trajectory
from msg_analysis.theory.prediction import SHOWN_AGENTS, Prediction, predict
from msg_analysis.types import FloatArray, IntArray

if TYPE_CHECKING:
    from msg_analysis.inference.pool import Pool

Verdict = Literal["agrees", "disagrees", "incomplete", "unpredicted"]

EXIT_CODES: dict[Verdict, int] = {"agrees": 0, "disagrees": 1, "incomplete": 3, "unpredicted": 0}
MIN_STEPS = 100
"""Fewest steps for which numbers are given."""
RUNNING_POINTS = 400


@dataclass(frozen=True, slots=True)
class Test:
    """One member of the family that the verdict is about; ``p_adjusted`` is Holm's, over the family.

    Attributes
    ----------
    name
        what is tested
    p
        of this test alone
    p_adjusted
        Holm's, over the family
    rejected
        whether ``p_adjusted`` is at most the level
    """

    name: str
    p: float
    p_adjusted: float
    rejected: bool


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Comparison:
    """What ``msg-analysis compare`` says.

    Attributes
    ----------
    trajectory
        what was compared
    level
        chance of a false "disagrees"
    steps
        steps used: all, or those before the first gap
    system_error, node_errors, covariance, innovations, switching
        one test or several each
    continuous_error
        the paper's continuous-time system error; None where it has none
    batch
        model-free interval for the system error
    tests
        the family, in the order of the report
    running
        "time" [units of simulated time], "system_error" and "standard_error" of the mean up to then, (400,) each, fewer
        for short runs
    loss
        of the messages that were lost; None where none can be
    p_broadcast
        of the noise in what was published; None without
    unpredicted
        why there is no prediction; None where there is one
    transient
        steps at the start that are left out of the measured errors; None with a prediction, which knows them
    timing, laws
        in real time: how time was kept, and which laws the log supports; None in lockstep. The errors and the
        covariance are then held against the first of the laws that there is
    given
        errors given the path of the graphs; None where they are not had
    order
        which agents are more certain than which; None where that is not known
    blame
        what is wrong, where the verdict is "disagrees"
    pool
        the runs, where they are several; ``trajectory`` has then no data, but the account of what is missing
    """

    trajectory: Trajectory
    level: float
    steps: int
    system_error: Estimate
    node_errors: list[Estimate]
    covariance: CovarianceTest
    innovations: InnovationTests
    switching: SwitchingTest | None
    continuous_error: float | None
    batch: tuple[float, float] | None
    tests: list[Test]
    running: dict[str, FloatArray]
    loss: LossTest | None = None
    p_broadcast: float | None = None
    unpredicted: str | None = None
    transient: int | None = None
    timing: Timing | None = None
    laws: Laws | None = None
    given: GivenPath | None = None
    order: Order | None = None
    blame: Sequence[Cause] = ()
    pool: Pool | None = None

    def __repr__(self) -> str:
        total, runs = self.system_error, f"{len(self.pool.members)} runs" if self.pool else "run"
        numbers = f"measured {number_text(total.measured)} +- {number_text(total.standard_error)}"
        numbers += f", predicted {number_text(total.predicted)}"
        name = self.trajectory.record.experiment.name
        return f"<Comparison, {runs} of {name!r}: {self.verdict}; system error {numbers}>"

    def _repr_markdown_(self) -> str:
        rows = [
            (
                name,
                *map(number_text, (error.measured, error.standard_error, error.predicted)),
                "-" if error.z is None else f"{error.z:+.2f}",
            )
            for name, error in [
                ("**system**", self.system_error),
                *((f"agent {i}", node) for i, node in enumerate(self.node_errors[:SHOWN_AGENTS], start=1)),
            ]
        ]
        rows += [("...", "", "", "", "")] * (len(self.node_errors) > SHOWN_AGENTS)
        table = markdown_table(("mean-square error", "measured", "standard error", "predicted", "z"), rows)
        blame = "".join(f"- {cause.words}\n" for cause in self.blame)
        return f"**{self.verdict}**\n\n{table}" + (f"\n{blame}" if blame else "")

    @property
    def verdict(self) -> Verdict:
        """Incomplete data get no verdict; else one rejected test of the family is a disagreement.

        Without a prediction, what is left of the family cannot say that a run agrees with it.
        """
        if not self.trajectory.completeness.complete:
            return "incomplete"
        if any(test.rejected for test in self.tests):
            return "disagrees"
        return "unpredicted" if self.unpredicted else "agrees"

    @property
    def exit_code(self) -> int:
        """0 agrees or unpredicted, 1 disagrees, 3 incomplete."""
        return EXIT_CODES[self.verdict]

    @property
    def _law(self) -> str:
        """That the errors are held against."""
        if self.laws:
            return self.laws.measured_against
        tested = any(test.name == "system error" for test in self.tests)
        real_time = self.trajectory.record.experiment.run.pace == "realtime"
        return "pattern" if self.pool and real_time and tested else step_law(self.trajectory.record.experiment)

    def to_json(self) -> dict[str, Any]:
        """The document of ``msg-analysis compare --json``; every number is finite or None."""
        record, covariance, switching = self.trajectory.record, self.covariance, self.switching
        document = {
            "verdict": self.verdict,
            "unpredicted": self.unpredicted,
            "transient": self.transient,
            "run": None if self.pool else str(record.run),
            "experiment": record.experiment.name,
            "experiment_identity": law_identity(record.experiment),
            "leaders": (np.flatnonzero(record.experiment.leader_gains) + 1).tolist(),
            "seed": None if self.pool else record.experiment.run.seed,
            "level": self.level,
            "completeness": asdict(self.trajectory.completeness) | {"stretch": self.trajectory.stretch},
            "steps": self.steps,
            "simulated_time": self.steps * record.experiment.step_length,
            "law": self._law,
            "bags": self.pool.to_json() if self.pool else None,
            "homogeneity": {key: getattr(self.pool, key, None) for key in ("chi2", "dof", "p")},
            "system_error": self.system_error.to_json(),
            "node_errors": [estimate.to_json() for estimate in self.node_errors],
            "covariance": {
                "measured": covariance.measured,
                "predicted": covariance.predicted,
                "chi2": covariance.chi2,
                "dof": covariance.dof,
                "p": covariance.p,
                "note": covariance.note,
            },
            "innovations": asdict(self.innovations),
            "switching": {
                "counts": switching.counts if switching else None,
                "expected": switching.expected if switching else None,
                "p": switching.p if switching else None,
            },
            "loss": asdict(self.loss) if self.loss else dict.fromkeys(("lost", "expected", "p")),
            "broadcast": {"p": self.p_broadcast},
            "timing": self.timing.to_json() if self.timing else None,
            "laws": self.laws.to_json() if self.laws else None,
            "given_path": self.given.to_json() if self.given else None,
            "order": self.order.to_json() if self.order else None,
            "blame": [cause.to_json() for cause in self.blame],
            "continuous": {"system_error": self.continuous_error},
            "batch_means": {"interval": self.batch or (None, None)},
            "tests": [asdict(test) for test in self.tests],
        }
        return {key: _plain(value) for key, value in document.items()}


def compare(trajectory: Trajectory, *, level: float = 0.01) -> Comparison:
    """Compare a run with what theory predicts for it.

    Every test assumes exactly the law that the record says was run; the family of all of them is wrong with
    probability at most ``level`` (Holm). A test with nothing to test (no noise, one graph, no loss) is left out. In
    real time, the family is what is exact whatever the timing was.

    Where the law has no prediction (a protocol that is not linear, or not here), the run is measured, and only its
    graphs and losses are tested.

    Parameters
    ----------
    trajectory
        from a bag or from the twin. If something is missing, the numbers are those of the complete beginning
    level
        chance of calling a run that follows its law one that disagrees

    Raises
    ------
    InputError
        no prediction (too large, unbounded), or a log that does not say what is needed
    """
    protocol = trajectory.record.experiment.protocol
    unpredicted = protocol.unpredictable() if protocol else None
    if unpredicted:
        return _measured(trajectory, level, unpredicted)
    prediction = predict(trajectory.record.experiment)
    if trajectory.prefix < MIN_STEPS and not trajectory.completeness.complete:
        return without_numbers(trajectory, level, prediction, max(trajectory.prefix, 0))
    observation = Observation.of(trajectory, prediction)
    if observation.steps < MIN_STEPS and not trajectory.completeness.complete:
        return without_numbers(trajectory, level, prediction, max(trajectory.prefix, 0))
    return judge(trajectory, prediction, Evidence.of(observation, level), level)


def judge(
    trajectory: Trajectory,
    prediction: Prediction,
    evidence: Evidence,
    level: float,
    more: Sequence[tuple[str, float | None]] = (),
) -> Comparison:
    """The verdict on what a run, or several, add up to.

    Parameters
    ----------
    trajectory
        of the run; of several runs, one that has the account of what is missing
    prediction
        of their experiment
    evidence
        of all of them
    level
        chance of a false "disagrees"
    more
        names and p-values of further tests of the same law
    """
    means = evidence.means
    system_error, node_errors = estimates(means, prediction.system)
    covariance = covariance_test(means, prediction.system)
    innovations = evidence.innovations.tests()
    switching = evidence.transitions.test(prediction.step.transition)
    loss = evidence.loss.test() if evidence.loss else None
    p_broadcast = evidence.broadcast.p_value() if evidence.broadcast else None
    errors = [("system error", system_error.p)]
    errors += [(f"error of agent {i}", node.p) for i, node in enumerate(node_errors, start=1)]
    errors += [("covariance", covariance.p)]
    family = errors if evidence.decisive else []
    family += [
        ("innovations: covariance", innovations.p_covariance),
        ("innovations: whiteness", innovations.p_whiteness),
        ("innovations: gains", innovations.p_gain),
        ("innovations: common gain", innovations.p_common_gain),
        ("switching", switching.p),
        ("loss", loss.p if loss else None),
        ("broadcast", p_broadcast),
        *more,
    ]
    tests = _judge(family, level)
    rejected = [test.name for test in tests if test.rejected]
    blame: list[Cause] = []
    if rejected and trajectory.completeness.complete:
        blame = find_causes(_accused(prediction, evidence), level, rejected)
    return Comparison(
        trajectory=trajectory,
        level=level,
        steps=evidence.steps,
        system_error=system_error,
        node_errors=node_errors,
        covariance=covariance,
        innovations=innovations,
        switching=switching,
        continuous_error=prediction.continuous.system_error if prediction.continuous else None,
        batch=batch_interval(means.system_series),
        tests=tests,
        running=_running(means, prediction.step.dt),
        loss=loss,
        p_broadcast=p_broadcast,
        timing=evidence.timing,
        laws=evidence.laws,
        given=evidence.given,
        order=order_of_nodes(means, level),
        blame=blame,
    )


def _accused(prediction: Prediction, evidence: Evidence) -> Accused:
    experiment = prediction.experiment
    return Accused(
        names=[graph.name for graph in experiment.graph_list],
        chain=experiment.chain,
        dt=experiment.step_length,
        reference=experiment.reference,
        innovations=evidence.innovations,
        transitions=evidence.transitions,
        loss=evidence.loss,
        broadcast=evidence.broadcast,
    )


def _measured(trajectory: Trajectory, level: float, unpredicted: str) -> Comparison:
    """What can be said without a prediction."""
    measurement = Measurement.of(trajectory)
    agents, enough = measurement.step.agents, True
    if measurement.steps < MIN_STEPS and not trajectory.completeness.complete:
        enough = False
    series, covariance = measurement.system_series, measurement.covariance if enough else None
    switching = switching_test(measurement.modes, measurement.step.transition) if enough else None
    loss = loss_test(measurement) if enough else None
    family = [("switching", switching.p if switching else None), ("loss", loss.p if loss else None)]
    nodes = [Estimate()] * agents if covariance is None else [Estimate(float(error)) for error in np.diag(covariance)]
    counts = _spaced(len(series)) if enough else np.empty(0, np.int64)
    return Comparison(
        trajectory=trajectory,
        level=level,
        steps=measurement.steps,
        system_error=Estimate() if covariance is None else Estimate(float(np.trace(covariance))),
        node_errors=nodes,
        covariance=CovarianceTest(measured=covariance, note="there is no prediction"),
        innovations=InnovationTests(None, None, None),
        switching=switching,
        continuous_error=None,
        batch=batch_interval(series) if enough else None,
        tests=_judge(family, level),
        running={
            "time": np.asarray((measurement.first + counts) * measurement.step.dt, dtype=float),
            "system_error": np.cumsum(series)[counts - 1] / counts if enough else np.empty(0),
            "standard_error": np.zeros(len(counts)),
        },
        loss=loss,
        unpredicted=unpredicted,
        transient=measurement.first if enough else None,
    )


def without_numbers(trajectory: Trajectory, level: float, prediction: Prediction, steps: int) -> Comparison:
    """Too little came: only what was expected.

    Parameters
    ----------
    trajectory
        with the account of what is missing
    level
        chance of a false "disagrees"
    prediction
        of its experiment
    steps
        that came whole
    """
    predicted = prediction.emulated
    return Comparison(
        trajectory=trajectory,
        level=level,
        steps=steps,
        system_error=Estimate(predicted=predicted.system_error),
        node_errors=[Estimate(predicted=float(error)) for error in predicted.node_errors],
        covariance=CovarianceTest(predicted=predicted.covariance),
        innovations=InnovationTests(None, None, None),
        switching=None,
        continuous_error=prediction.continuous.system_error if prediction.continuous else None,
        batch=None,
        tests=[],
        running={key: np.empty(0) for key in ("time", "system_error", "standard_error")},
    )


def _judge(family: list[tuple[str, float | None]], level: float) -> list[Test]:
    # A statistic that is no number, from a log that nobody can compute with, is none that the law gives.
    tested = [(name, 0.0 if math.isnan(p) else p) for name, p in family if p is not None]
    adjusted = holm(np.array([p for _, p in tested], dtype=float))
    return [Test(name, p, float(a), bool(a < level)) for (name, p), a in zip(tested, adjusted, strict=True)]


def _running(means: TimeMeans, dt: float) -> dict[str, FloatArray]:
    """Mean of the system error up to some steps, denser at the beginning, and its standard error."""
    counts = _spaced(len(means.system_series))
    return {
        "time": np.asarray(counts * dt, dtype=float),
        "system_error": np.cumsum(means.system_series)[counts - 1] / counts,
        "standard_error": np.sqrt(np.cumsum(means.system_variances)[counts - 1]) / counts,
    }


def _spaced(steps: int) -> IntArray:
    """Numbers of steps up to all of them, denser at the beginning."""
    spaced = np.concatenate([np.geomspace(1, steps, RUNNING_POINTS // 2), np.linspace(1, steps, RUNNING_POINTS // 2)])
    return np.unique(np.rint(spaced).astype(np.int64))


def _plain(value: Any) -> Any:
    """JSON-able: arrays become lists, numbers that are not finite become None."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
