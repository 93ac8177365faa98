# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What theory says about an experiment: in continuous time, for the run's steps, and without switching.

Propositions 2 and 3 of the paper, 7 and 8 in discrete time; for the steps of a run, docs/theory.md.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray
from msg_analysis.common.resources import blas_threads, few_blas_threads, one_blas_thread
from msg_analysis.common.text import agent_text, finite, markdown_table, number_text
from msg_analysis.errors import InputError, NotAvailableError
from msg_analysis.experiment.graphs import hops, widest_reaching
from msg_analysis.experiment.links import expanded
from msg_analysis.model.step_model import StepLaw, StepModel, build_run_model, build_step_model, step_law
from msg_analysis.theory import jump_system as systems
from msg_analysis.theory.coupled_equations import SolverReport
from msg_analysis.theory.first_steps import simplification
from msg_analysis.theory.fourth_moments import FourthMoment, fourth_moment
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.scheduled import Matrices, Outages, PathMoments, given_path, outages, without_stacks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from msg_analysis.experiment.experiment import Experiment


ERROR_ROUNDING = 1e-14  # node errors below this, relative to the largest one, are rounding
LAW_NAMES = {
    "continuous": "continuous time",
    "emulated": "steps of the run",
    "discrete": "discrete time",
    "static": "graphs held fixed",
    "sequential": "sequential steps",
    "pattern": "logged pattern",
}  # of laws in texts
OUTAGES = 5  # in a document
CHEAP = 100_000  # steps times agents, up to which a prediction without some of the steps takes a second
SHOWN_AGENTS = 30  # most agents in a notebook's table; the arrays have all of them
WEAK_NOISE = 1e-6  # directions with less noise, relative to the noisiest one, do not show whether steps are stable


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Moments:
    """Steady second moments of the agents.

    Node errors below the rounding of the largest one count as 0: an agent without noise may have none.

    Attributes
    ----------
    covariance
        (m, m) of the disagreement (consensus) or of the deviation from the reference (tracking)
    by_mode
        (n, m, m) E[.; mode i], which sum to ``covariance``; None for the static baseline
    solver
        how they were computed; None for the static baseline
    law
        of the run's steps: "synchronous", or "sequential" in real time; None for other laws
    names
        of the agents, for tables; None where they have only numbers
    """

    covariance: FloatArray
    by_mode: FloatArray | None = None
    solver: SolverReport | None = None
    law: StepLaw | None = None
    names: Sequence[str] | None = None

    def __repr__(self) -> str:
        return f"<Moments of {len(self.covariance)} agents: system error {self.system_error:.6g}>"

    def _repr_markdown_(self) -> str:
        errors, certainty = self.node_errors, self.node_certainty
        rows = [("**system**", number_text(self.system_error), number_text(self.system_certainty))]
        shown = range(min(len(errors), SHOWN_AGENTS))
        rows += [(agent_text(i + 1, self.names), number_text(errors[i]), number_text(certainty[i])) for i in shown]
        rows += [("...", "", "")] * (len(shown) < len(errors))
        return markdown_table(("", "mean-square error", "certainty"), rows)

    @property
    def node_errors(self) -> FloatArray:
        """(m,) E_i."""
        errors = np.diag(self.covariance)
        return np.where(errors > ERROR_ROUNDING * errors.max(initial=0.0), errors, 0.0)

    @property
    def system_error(self) -> float:
        """E, the sum of the node errors."""
        return float(np.trace(self.covariance))

    @property
    def system_certainty(self) -> float:
        """1/E, inf without noise (the paper's system certainty index, Section 4)."""
        return 1.0 / self.system_error if self.system_error > 0.0 else math.inf

    @property
    def node_certainty(self) -> FloatArray:
        """(m,) 1/E_i, inf where there is no error (the paper's node certainty index, Section 4)."""
        errors = self.node_errors
        return np.asarray(np.divide(1.0, errors, out=np.full(len(errors), math.inf), where=errors > 0.0))

    def to_json(self) -> dict[str, Any]:
        """The document of one law; what is infinite or undefined is None."""
        document: dict[str, Any] = {
            "system_error": finite(float(self.system_error)),
            "node_errors": finite(self.node_errors.tolist()),
            "system_certainty": finite(float(self.system_certainty)),
            "node_certainty": finite(self.node_certainty.tolist()),
            "covariance": self.covariance.tolist(),
        }
        if self.law is not None:
            document = {"law": self.law, **document}
        if self.by_mode is not None:
            document["mode_second_moments"] = self.by_mode.tolist()
        if self.solver is not None:
            document["solver"] = self.solver.to_json()
        return document


@dataclass(frozen=True, eq=False, repr=False)
class Prediction:
    """The result of ``predict``.

    Attributes
    ----------
    experiment
        what is predicted
    matrices
        what has a matrix for every graph: ``step``, ``system`` and ``steady``
    emulated
        exact moments of the run's steps ("discrete" in the document of a discrete-time experiment); in real time if no
        agent is late
    continuous_moments
        ``continuous``; None in discrete time, with a protocol, or with noise on the air, loss, delay or activation
    paper
        the system of the paper: in continuous time where there is ``continuous``, else the steps; None with noise on
        the air, loss or delay, or with a schedule
    path
        of a schedule: the moments given its graphs, of which ``emulated`` and ``steady`` are the means over time; else
        None
    chain_solver
        of the equations of ``system``; None with a schedule
    """

    experiment: Experiment
    matrices: Matrices
    emulated: Moments
    continuous_moments: Moments | None
    paper: JumpSystem | None
    path: PathMoments | None = None
    chain_solver: MomentSolver | None = None

    @property
    def step(self) -> StepModel:
        """The experiment compiled to one step of an agent."""
        return self.matrices.step

    @property
    def system(self) -> JumpSystem:
        """The reduced system of the run's steps, in real time of its sequential law."""
        return self.matrices.system

    @property
    def steady(self) -> FloatArray:
        """(n, d, d) steady second moments of ``system``; of a schedule, means over time."""
        return self.matrices.steady

    @property
    def continuous(self) -> Moments:
        """Exact moments of the paper's continuous-time system; NotAvailableError, with the reason, if it has none."""
        if self.continuous_moments is None:
            raise NotAvailableError(
                f"continuous: the law of the paper in continuous time does not exist {_why_no_paper(self.experiment)}: "
                "use emulated, the law of the run's steps"
            )
        return self.continuous_moments

    @property
    def static(self) -> Moments:
        """The pi-weighted mean over the graphs held fixed; NotAvailableError, with the reason, if there is none."""
        if self.static_moments is None:
            why = "where a graph held fixed does not keep the agents together"
            if self.paper is None:
                why = _why_no_paper(self.experiment)
            raise NotAvailableError(
                f"static: there is no mean over the graphs held fixed {why}: use emulated, the law of the run's steps"
            )
        return self.static_moments

    @cached_property
    def static_moments(self) -> Moments | None:
        """``static``; None without ``paper``, or where one of the graphs cannot keep the agents together."""
        if self.paper is None or self.disconnected:
            return None
        return _static(self.paper, self.experiment.names)

    @cached_property
    def disconnected(self) -> list[str]:
        """The graphs that, held fixed, cannot keep the agents together; none of a schedule, which holds none fixed."""
        if self.path:
            return []
        held = enumerate(self.experiment.graph_list)
        return [graph.name for mode, graph in held if not _holds_together(self.experiment, mode)]

    def laws(self) -> dict[str, Moments]:
        """Those moments that there are, by the name that texts give them."""
        steps = "sequential" if self.emulated.law == "sequential" else "emulated"
        laws = {steps: self.emulated, "continuous": self.continuous_moments, "static": self.static_moments}
        return {LAW_NAMES[key]: law for key, law in laws.items() if law is not None}

    def __repr__(self) -> str:
        errors = ", ".join(f"{law.system_error:.6g} ({name})" for name, law in self.laws().items())
        return f"<Prediction of {self.experiment.name!r}: system error {errors}>"

    def _repr_markdown_(self) -> str:
        laws = self.laws()
        rows = [("**system**", *(number_text(law.system_error) for law in laws.values()))]
        agents, names = self.experiment.agents, self.experiment.names
        for i in range(min(agents, SHOWN_AGENTS)):
            rows.append((agent_text(i + 1, names), *(number_text(law.node_errors[i]) for law in laws.values())))
        rows += [("...", *("" for _ in laws))] * (agents > SHOWN_AGENTS)
        return "Mean-square error in the steady state\n\n" + markdown_table(("", *laws), rows)

    def plot(self) -> Figure:
        """Draw the agents' errors in the steady state, by every law that there is.

        Returns
        -------
        matplotlib.figure.Figure
            notebooks show it; ``figure.savefig("prediction.png")`` writes it
        """
        from msg_analysis.report.figures import prediction_figure

        return prediction_figure(self)

    @property
    def solver(self) -> MomentSolver:
        """Of the equations of the steady second moments; NotAvailableError with a schedule, which has none."""
        if self.chain_solver is None:
            raise NotAvailableError("switching.schedule: there is no steady state: expected a Markov chain for this")
        return self.chain_solver

    @cached_property
    def fourth_moment(self) -> FourthMoment:
        """Whether the fourth moments of the run's steps are finite: without, errors have no standard errors."""
        if self.path:
            return FourthMoment(None, None, None, finite=True)  # of a given sequence of graphs they always are
        with blas_threads(self.experiment.agents):
            return fourth_moment(build_run_model(self.experiment, self.step), self.system)

    def outages(self, most: int = OUTAGES) -> Outages:
        """Of a schedule, its longest outages, and what they cost; NotAvailableError with a chain.

        Parameters
        ----------
        most
            how many of the longest ones
        """
        if self.path is None:
            raise NotAvailableError("outages: expected a given sequence of graphs, not a Markov chain: leave it out")

        experiment = self.matrices.experiment

        def error(steps: BoolArray) -> float | None:
            if steps.all():
                return self.emulated.system_error
            path = self.matrices.path(steps) if steps.any() else None
            return float(np.trace(path.covariance)) if path and path.counted else None

        with blas_threads(experiment.agents):
            return outages(experiment, given_path(experiment)[1], most, error)

    def for_run(self, experiment: Experiment) -> Prediction:
        """The same for another run, with what was computed before.

        Parameters
        ----------
        experiment
            differs from that of the prediction in the seed and the duration at most
        """
        other = copy.copy(self)
        object.__setattr__(other, "experiment", experiment)
        return other

    def to_json(self, outages: int | None = None) -> dict[str, Any]:
        """The document of ``msg-analysis predict --json``.

        Parameters
        ----------
        outages
            of a schedule: how many of the longest ones it has. None: as many as commonly, or, where these would take
            much longer than the prediction, none
        """
        document: dict[str, Any] = {
            "agents": self.experiment.agents,
            "names": self.experiment.names,
            "modes": [graph.name for graph in self.experiment.graph_list],
            "stationary": self.experiment.switching_law.stationary.tolist(),
        }
        if self.experiment.time == "discrete":
            document["discrete"] = self.emulated.to_json()
        else:
            document["continuous"] = self.continuous_moments.to_json() if self.continuous_moments else None
            document["emulated"] = self.emulated.to_json()
        if self.path:
            largest, k = self.path.largest
            key = "discrete" if self.experiment.time == "discrete" else "emulated"
            document[key] |= {"largest": largest, "largest_time": k * self.experiment.step_length}
        if outages is None:
            size = self.experiment.steps * self.experiment.agents
            outages = OUTAGES if self.path and size <= CHEAP and without_stacks(self.experiment) else 0
        if outages:
            document["outages"] = self.outages(outages).to_json()
        document["static"] = self.static_moments.to_json() if self.static_moments else None
        document["disconnected"] = self.disconnected
        document["fourth_moment"] = self.fourth_moment.to_json()
        start = simplification(self.system) if self.experiment.noise.delay else None
        document["notes"] = [*self.experiment.notes, *([start] if start else [])]
        return document


def _why_no_paper(experiment: Experiment) -> str:
    if experiment.noise.steps_only:
        return "with noise on the air, loss, delay or activation"
    return "in discrete time" if experiment.time == "discrete" else "with a protocol"


@few_blas_threads
def predict(experiment: Experiment, step: StepModel | None = None, *, start: float = 0.0) -> Prediction:
    """Steady-state prediction of an experiment (Propositions 2 and 3 of the paper, 7 and 8 in discrete time).

    Of a schedule, the means over the times after ``start`` [units of simulated time], given its graphs. ``step``: its
    step model, if it is known. InputError: too large, or without finite steady errors.
    """
    experiment = expanded(experiment)
    if experiment.schedule:
        return _given(experiment, step, start)
    step = step or build_step_model(experiment)
    if start:
        raise InputError(f"from: {start:g}: expected with a schedule; a steady state has no time: leave it out")
    continuous = paper = None
    if not experiment.noise.steps_only:
        if experiment.time == "continuous" and not experiment.protocol:
            paper = systems.continuous(experiment)
            exact = MomentSolver(paper)
            continuous = _moments(exact, exact.steady(), experiment.names)
        else:
            paper = systems.emulated(step, experiment.problem)
    solver, steady = _steady(step, build_run_model(experiment, step), experiment.problem)
    emulated = dataclasses.replace(_moments(solver, steady, experiment.names), law=step_law(experiment))
    matrices = Matrices(experiment, step, solver.system, steady)
    return Prediction(experiment, matrices, emulated, continuous, paper, chain_solver=solver)


@few_blas_threads
def predict_run(experiment: Experiment, step: StepModel) -> Prediction:
    """The same for a run with this ``step``: given its graphs, where these are not those of one chain."""
    return _given(experiment, step, 0.0) if experiment.schedule else predict(experiment, step)


def _given(experiment: Experiment, step: StepModel | None, start: float) -> Prediction:
    """Of a schedule."""
    first = round(start / experiment.step_length) if math.isfinite(start) else -1
    if not 0 <= first < experiment.steps:
        wanted = f"expected a time from 0 to below {experiment.run.duration:g}, the end of the run"
        raise InputError(f"from: {start:g}: {wanted}: correct it")
    matrices = Matrices(experiment, step, first=first)
    path = matrices.path()
    emulated = Moments(path.covariance, names=experiment.names, law=step_law(experiment))
    return Prediction(experiment, matrices, emulated, None, None, path)


def stationary_start_factor(experiment: Experiment, mode: int) -> FloatArray:
    """(m, m) square root S of the law of x(0) given g(0) = mode (from 0) in the steady state: S S^T = C_g0 / pi_g0.

    C are the steady second moments of the run's steps; S is the symmetric positive semidefinite root, which is unique.
    """
    step = build_step_model(experiment)
    with one_blas_thread():  # so that its last bits do not depend on the number of threads
        solver, steady = _steady(step, build_run_model(experiment, step), experiment.problem)
        system = solver.system
        moments = system.by_graph(steady)[mode] / step.stationary[mode]
        if system.readout is not None:  # the agents are some of the numbers of the system
            return _root(system.lifted(moments))
        return system.lifted(_root(moments))


def _root(moments: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(moments)
    return np.asarray((vectors * np.sqrt(np.clip(values, 0.0, None))) @ vectors.T)


def _steady(step: StepModel, run: StepModel, problem: str) -> tuple[MomentSolver, FloatArray]:
    """Solver and steady moments of the run's steps."""
    limit = _safe_step(step)  # stochastic weights stay so if agents step one after the other
    try:
        solver = MomentSolver(systems.emulated(run, problem))
        steady = solver.steady()
        if step.dt >= limit:
            _require_stability(solver)
    except InputError as error:
        if step.dt < limit or not limit:
            raise
        raise InputError(f"{error}; every dt below {limit:.4g} is stable, whatever the switching and delay") from error
    return solver, steady


def _require_stability(solver: MomentSolver) -> None:
    """Refuse unstable steps that the noise does not show, because it does not reach what grows."""
    system = solver.system
    sizes = np.linalg.eigvalsh(system.noise)
    if not sizes.size or sizes.min() > WEAK_NOISE * sizes.max():
        return
    # A positive solution of Y_i = I + K_i^*[sum_j P_ij Y_j] exists only where every second moment stays bounded.
    dual = solver.dual(np.eye(system.dimension)[None])[0]
    if np.linalg.eigvalsh(dual).min() < 0.0:
        raise InputError(
            "second moments: the steps are unstable, although this noise does not show it: from another start the "
            "errors grow without bound: lower run.dt"
        )


def _safe_step(step: StepModel) -> float:
    """The dt below which no agent overshoots what it hears: W is stochastic then, and stable with any delay."""
    own = np.diagonal(step.nominal, axis1=1, axis2=2)
    if (step.nominal < 0.0).sum() > (own < 0.0).sum():
        return 0.0  # a protocol that subtracts what it hears: no dt is known to be safe
    pull = 1.0 - own  # on what is heard, and on the reference
    return float(step.dt / pull[:, ~step.grounded].max())


def _moments(solver: MomentSolver, steady: FloatArray, names: Sequence[str] | None) -> Moments:
    system = solver.system
    moments = system.lifted(steady.sum(axis=0))
    return Moments(moments, system.lifted(system.by_graph(steady)), solver.report, names=names)


def _static(system: JumpSystem, names: Sequence[str] | None) -> Moments | None:
    covariance = np.zeros((len(system.lift), len(system.lift)))
    for mode, share in enumerate(system.stationary):
        alone = systems.held(system, mode)
        try:
            covariance += share * alone.lifted(MomentSolver(alone).steady()[0])
        except InputError:  # a connected graph whose connection is lost to rounding
            return None
    return Moments(covariance, names=names)


def _holds_together(experiment: Experiment, mode: int) -> bool:
    """Whether one graph held fixed bounds the errors: one agent, or the reference, reaches all others."""
    leads = experiment.graph_list[mode].adjacency.T > 0
    leaders = np.flatnonzero(experiment.leader_gains).tolist()
    sources = leaders if experiment.problem == "tracking" else widest_reaching(leads)
    return bool((hops(leads, sources) >= 0).all())
