# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Transients: the law of the graph, means and second moments of every mode over time, from any start.

Propositions 1 and 6 of the paper; docs/theory.md, "Transients", says how they are computed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.resources import few_blas_threads
from msg_analysis.common.text import markdown_table, number_text
from msg_analysis.errors import InputError
from msg_analysis.experiment.links import expanded
from msg_analysis.model.step_model import build_run_model, first_graph
from msg_analysis.theory import jump_system as systems
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.first_steps import MomentsAt, Start, known_start, steady_start
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.propagator import Flow
from msg_analysis.theory.rational_krylov import RationalFlow, slowest_rate
from msg_analysis.theory.scheduled import course
from msg_analysis.theory.solvers import mean_propagator, second_moment_propagator

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment


TransientLaw = Literal["emulated", "continuous"]

MAX_UNKNOWNS = 300  # largest n p + n, with p = d (d + 1) / 2, whose matrix is propagated as a whole
MAX_BYTES = 2e9  # largest result
SHOWN_TIMES = 11  # in a notebook's table; the arrays have all of them
MAX_STEPS = 10_000_000  # most single steps (discrete time, beyond MAX_UNKNOWNS)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Transient:
    """Moments over time.

    Attributes
    ----------
    system
        whose moments they are
    times
        (T,) ascending; units of time, or numbers of steps
    laws
        (T, n) pi(t)
    means
        (T, n, d) nu(t), reduced
    moments
        (T, n, d, d) c(t), reduced
    """

    system: JumpSystem
    times: FloatArray
    laws: FloatArray
    means: FloatArray
    moments: FloatArray

    def __repr__(self) -> str:
        errors, times = self.system_error, self.times
        course = f"{errors[0]:.6g} at {times[0]:g} to {errors[-1]:.6g} at {times[-1]:g}"
        return f"<Transient of {len(self.system.output)} agents, {len(times)} times: system error {course}>"

    def _repr_markdown_(self) -> str:
        chosen = np.unique(np.linspace(0, len(self.times) - 1, SHOWN_TIMES).round().astype(int))
        rows = [(number_text(self.times[k]), number_text(self.system_error[k])) for k in chosen.tolist()]
        table = markdown_table(("time", "system error"), rows, names=0)
        return f"Moments of {len(self.system.output)} agents at {len(self.times)} times, of which are shown:\n\n{table}"

    @property
    def mean(self) -> FloatArray:
        """(T, m) mean of the agents, all modes together."""
        return np.asarray(self.means.sum(axis=1) @ self.system.output.T)

    @property
    def node_errors(self) -> FloatArray:
        """(T, m) mean square of each agent's disagreement (deviation); of its state in an unreduced system."""
        output = self.system.output
        return np.asarray(((output @ self.moments.sum(axis=1)) * output).sum(axis=2))

    @property
    def system_error(self) -> FloatArray:
        """(T,) sum of the node errors."""
        return np.asarray(self.node_errors.sum(axis=1))

    @property
    def mode_means(self) -> FloatArray:
        """(T, n, m) E[agents; mode i]."""
        return np.asarray(self.means @ self.system.output.T)

    @property
    def mode_second_moments(self) -> FloatArray:
        """(T, n, m, m) E[agents agents^T; mode i]."""
        return self.system.lifted(self.moments)


def point_start(system: JumpSystem, deviation: FloatArray, law: FloatArray | None = None) -> Start:
    """Agents at a known place (m,), x(0) or its deviation from the reference; ``law``: (n,) of g(0), or stationary."""
    return known_start(system, deviation[None], system.stationary if law is None else law)


def start_of(experiment: Experiment, system: JumpSystem, agents: FloatArray) -> Start:
    """The start that the experiment defines, for one of its laws; ``agents``: (n, m, m) their steady second moments."""
    law = system.stationary
    if experiment.switching.initial != "stationary":
        law = system.of_modes(first_graph(experiment))
    place = experiment.known_start
    if place is None:
        return steady_start(system, agents, law)
    return point_start(system, place - experiment.reference, law)


@dataclass(frozen=True, slots=True, eq=False)
class SolvedTransient:
    """Moments over time, and what they were computed with."""

    course: Transient
    system: JumpSystem  # reduced, also where the course is not
    steady: FloatArray  # (n, d, d) steady second moments of the system
    unit: float | None  # [units of simulated time] of a step; None in continuous time


@few_blas_threads
def solve_transient(
    experiment: Experiment,
    times: FloatArray,  # (T,) ascending [units of simulated time]
    *,
    law: TransientLaw = "emulated",
    unreduced: bool = False,
) -> SolvedTransient:
    """Moments over time from the experiment's start; ``unreduced`` (consensus only): those of the states, which grow.

    InputError: times or a law that do not fit, too large, or no finite steady errors.
    """
    experiment = expanded(experiment)
    system, unit = _system(experiment, law)
    if experiment.schedule:
        return _given(experiment, system, times, unreduced=unreduced)
    steady = MomentSolver(system).steady()
    if not unreduced:
        found = transient(system, start_of(experiment, system, system.lifted(steady)), _steps(times, unit), steady)
        return SolvedTransient(found, system, steady, unit)
    _require_consensus(experiment)
    if unit is None:
        whole = unreduced_consensus(experiment)
    else:
        whole = systems.emulated(build_run_model(experiment), "tracking")
    start = start_of(experiment, whole, system.lifted(steady))
    return SolvedTransient(transient(whole, start, _steps(times, unit)), system, steady, unit)


def _given(experiment: Experiment, system: JumpSystem, times: FloatArray, *, unreduced: bool) -> SolvedTransient:
    """With a schedule, which has no steady state."""
    if unreduced:
        _require_consensus(experiment)
        system = systems.emulated(build_run_model(experiment), "tracking")
    unit = experiment.step_length
    steps = _steps(times, unit)
    _check_times(system, steps)
    last = round(float(steps[-1]))
    if last > experiment.steps:
        raise InputError(f"times: {times[-1]:g}: expected at most {experiment.run.duration:g}, the end of the run")
    place, schedule = experiment.known_start, experiment.schedule
    assert place is not None
    assert schedule is not None
    graphs = schedule.sampled(last + 1, unit)
    states = system.modes // schedule.modes  # of channels
    n, d = system.modes, system.dimension
    found = Transient(
        system, steps, *(np.zeros((len(steps), *shape)) for shape in ((n,), (n, d), (n, d, d)))
    )  # all moments are those of the graph that is active
    for k, (means, moments) in enumerate(course(system, place[:, None], graphs[: max(last, 1)])):
        for row in np.flatnonzero(steps == k).tolist():
            mode = graphs[k] * states
            found.laws[row, mode], found.means[row, mode], found.moments[row, mode] = 1.0, means, moments
    return SolvedTransient(found, system, np.zeros_like(system.matrices), unit)


def _require_consensus(experiment: Experiment) -> None:
    if experiment.problem != "consensus":
        raise InputError("unreduced: expected problem: consensus (tracking has no reduction): leave it out")


def unreduced_consensus(experiment: Experiment) -> JumpSystem:
    """Consensus in continuous time with the mean of the agents, which grows: Proposition 1 of the paper, Z_i = L_i."""
    gain = experiment.noise_gain
    drift = np.stack([graph.laplacian for graph in experiment.graph_list])
    return JumpSystem(
        time="continuous",
        matrices=drift,
        noise=gain @ gain.transpose(0, 2, 1),
        chain=experiment.chain.matrix,
        stationary=experiment.switching_law.stationary,
        lift=np.eye(experiment.agents),
    )


def transient(
    system: JumpSystem,
    start: Start,
    times: FloatArray,
    steady: FloatArray | None = None,
    *,
    most_unknowns: int = MAX_UNKNOWNS,
) -> Transient:
    """Exact moments at the given times (Propositions 1 and 6 of the paper).

        continuous: d/dt nu = -N nu,   d/dt c = -M c + pi(t) (x) Q,       d/dt pi = Gamma^T pi
        discrete:   nu(k+1) = H nu(k), C_i(k+1) = sum_j P_ji (K_j[C_j] + pi_j(k) N_j),   pi(k+1) = P^T pi(k)

    With a steady state the distance to it is propagated, so that it is reached exactly, however long the time.
    ``times``: (T,) >= 0, ascending; units of time, or whole numbers of steps. ``steady``: (n, d, d); None: there is
    none. ``most_unknowns``: up to which the joint equations are propagated as a whole. InputError: wrong times, or too
    large.
    """
    times = np.asarray(times, dtype=float)
    _check_times(system, times)
    begin = len(start) - 1  # the step from which the equations hold
    rest = np.maximum(times - begin, 0.0)
    if unknowns(system) > most_unknowns and system.time == "discrete":
        found = _stepped(system, start[-1], rest, steady)
    else:
        found = _powered(system, start[-1], rest, steady, most_unknowns)
    for row in np.flatnonzero(times < begin).tolist():
        now = start[round(times[row])]
        found.laws[row], found.means[row], found.moments[row] = now.law, now.means, now.moments
    return replace(found, times=times)


def unknowns(system: JumpSystem) -> int:
    """Size n p + n of the joint equations of second moments and graph law."""
    return system.modes * (packed_symmetric.size(system.dimension) + 1)


def joint_flow(
    system: JumpSystem, stack: FloatArray, slow: Callable[[], float], *, decays: bool, most_unknowns: int = MAX_UNKNOWNS
) -> Flow:
    """The flow of the joint equations for one ``joint_stack`` (n, p + 1): reduced for it where they are large."""
    # slow gives the slowest rate of interest [1 / unit of time]; decays: the stack is a distance from the steady state.
    if unknowns(system) <= most_unknowns:
        return second_moment_propagator(system)
    return RationalFlow(system, stack, slow(), decays=decays)


def _powered(
    system: JumpSystem, start: MomentsAt, times: FloatArray, steady: FloatArray | None, most_unknowns: int
) -> Transient:
    """By powers of matrices."""
    longest = float(times[-1]) or 1.0

    def slow() -> float:
        return 1.0 / longest if steady is None else max(1.0 / longest, slowest_rate(system, steady))

    def course(snapshot: MomentsAt, when: FloatArray, *, decays: bool) -> tuple[FloatArray, FloatArray]:
        stack = joint_stack(snapshot)
        joint = joint_flow(system, stack, slow, decays=decays, most_unknowns=most_unknowns).grid(stack, when)
        return joint[:, :, :-1], joint[:, :, -1]

    means = np.zeros((len(times), *start.means.shape))
    if start.means.any():
        means = mean_propagator(system).grid(start.means, times)
    if steady is None:
        packed, laws = course(start, times, decays=False)
    else:
        limit = packed_symmetric.pack(steady)
        away, laws = course(distance(system, start, steady), times, decays=True)
        packed, laws = limit + away, laws + system.stationary
        # The distance is exact for long times. For short ones it may cancel with the limit; what has grown does not.
        left = np.linalg.norm(away, axis=(1, 2))
        early = np.flatnonzero(left > 0.5 * np.linalg.norm(limit))
        if early.size:
            grown, _ = course(start, times[early], decays=False)
            better = np.linalg.norm(grown, axis=(1, 2)) < left[early]
            packed[early[better]] = grown[better]
    return Transient(system, times, laws, means, packed_symmetric.unpack(packed, system.dimension))


def distance(system: JumpSystem, snapshot: MomentsAt, steady: FloatArray) -> MomentsAt:
    """The distance of the snapshot from the steady state, which obeys the same equations."""
    return MomentsAt(snapshot.law - system.stationary, snapshot.means, snapshot.moments - steady)


def joint_stack(snapshot: MomentsAt) -> FloatArray:
    """(n, p + 1) packed second moments and probability of every mode."""
    return np.concatenate([packed_symmetric.pack(snapshot.moments), snapshot.law[:, None]], axis=1)


def advance(system: JumpSystem, snapshot: MomentsAt) -> MomentsAt:
    """One step, of a snapshot or of its distance from the steady state. Discrete time."""
    moments, law = system.advance(snapshot.moments, snapshot.law)
    moved = np.einsum("nab,nb->na", system.matrices, snapshot.means)
    return MomentsAt(law, system.chain.T @ moved, moments)


def _stepped(system: JumpSystem, start: MomentsAt, times: FloatArray, steady: FloatArray | None) -> Transient:
    """By single steps, which need no matrix of the whole. Discrete time."""
    n, d = system.modes, system.dimension
    now = start if steady is None else distance(system, start, steady)
    laws, means, moments = np.zeros((len(times), n)), np.zeros((len(times), n, d)), np.zeros((len(times), n, d, d))
    step = 0
    for row, then in enumerate(times):
        while step < then and (now.moments.any() or now.law.any() or now.means.any()):
            now = advance(system, now)
            step += 1
        laws[row], means[row], moments[row] = now.law, now.means, now.moments
    if steady is not None:
        laws += system.stationary
        moments += steady
    return Transient(system, times, laws, means, moments)


def _check_times(system: JumpSystem, times: FloatArray) -> None:
    if times.ndim != 1 or not times.size or not np.isfinite(times).all() or (np.diff(times, prepend=0.0) < 0.0).any():
        wanted = "expected numbers >= 0 in ascending order"
        raise InputError(f"times: {times.tolist()!r:.80}: {wanted}: give at least one")
    if system.time == "discrete":
        if (times != np.round(times)).any():
            raise InputError("times: expected whole numbers of steps in discrete time")
        if unknowns(system) > MAX_UNKNOWNS and times[-1] > MAX_STEPS:
            raise InputError(f"times: {times[-1]:.3g} steps, expected at most {MAX_STEPS} with so many agents")
    size = 8.0 * len(times) * system.modes * system.dimension**2
    if size > MAX_BYTES:
        raise InputError(
            f"times: {len(times)} second moments of {system.modes} graphs of {len(system.output)} agents need "
            f"{size / 1e9:.1f} GB, expected at most {MAX_BYTES / 1e9:.0f} GB: give fewer times"
        )


def _system(experiment: Experiment, law: TransientLaw) -> tuple[JumpSystem, float | None]:
    """The reduced system of a law, and the time of a step (None in continuous time)."""
    if law == "emulated":
        return systems.emulated(build_run_model(experiment), experiment.problem), experiment.step_length
    if experiment.time == "discrete":
        raise InputError("law continuous: expected an experiment in continuous time: leave it out")
    noise = experiment.noise
    if experiment.protocol:
        raise InputError(f"law continuous: {experiment.protocol.info} has steps only: leave it out")
    if noise.steps_only:
        belong = "noise.broadcast, link, loss, delay and activation belong to steps, expected none of them"
        raise InputError(f"law continuous: {belong}: leave it out")
    return systems.continuous(experiment), None


def _steps(times: FloatArray, unit: float | None) -> FloatArray:
    """Times in the unit of the system: in the emulated law, whole numbers of steps."""
    if unit is None:
        return times
    steps = np.round(times / unit)
    wrong = np.abs(times - steps * unit) > 1e-9 * np.maximum(np.abs(times), unit)
    if wrong.any():
        place = f"{times[wrong][0]:g} is not a multiple of the step {unit:g}"
        raise InputError(f"times: {place}: correct it, or use the law continuous")
    return np.asarray(steps)
