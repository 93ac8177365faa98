# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Leaders: what a set of them is worth (joint robustness centrality), and which set is best.

After Section 4 of the paper, "Robustness and leadership indices"; docs/leader_theory.md has the proofs and bounds.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
import scipy.sparse.csgraph

from msg_analysis.common.arrays import BoolArray
from msg_analysis.common.resources import few_blas_threads
from msg_analysis.common.text import agent_name, markdown_table, number_text, with_names
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.spec import LeadersSpec
from msg_analysis.model.step_model import build_run_model
from msg_analysis.theory import jump_system as systems
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.leader_search import Leaders, LeaderSearch, SearchProgress
from msg_analysis.theory.moments import MomentSolver

SelectionLaw = Literal["continuous", "emulated", "discrete"]
SearchMethod = Literal["auto", "exhaustive", "greedy", "swap"]

AUTO_SETS = 1000  # number of sets up to which "auto" evaluates them all
MOST_SETS = 1_000_000  # number of sets beyond which enumeration is refused


@dataclass(frozen=True, eq=False)
class LeaderProblem:
    """System error as a function of the set of leaders of an experiment, whose own leaders are ignored."""

    experiment: Experiment
    law: SelectionLaw  # "continuous" (the paper's), "emulated" (steps of the run) or "discrete" (the paper's appendix)
    gain: float = math.inf  # kappa of the leaders [1 / unit of time]; inf holds them at the reference

    @property
    def agents(self) -> int:
        """Number of agents m."""
        return self.experiment.agents

    @property
    def supermodular(self) -> bool:
        """Whether E is known to be non-increasing and supermodular."""
        return self.doubt is None

    @cached_property
    def doubt(self) -> str | None:
        """Why supermodularity is not known; None where it is (docs/leader_theory.md, "Supermodularity").

        E(S) sums, over pairs of walkers that start at one agent and see the same graphs, the noise covariance between
        the agents where they are, until a leader absorbs one of them. With entries >= 0 in every factor this is a
        mixture, with weights >= 0, of products over the leaders of numbers in [0, 1], and so supermodular.
        """
        step = self._system(frozenset({0}), 1.0)
        if step.noise.min() < -1e-12 * np.abs(step.noise).max():
            return "the noise of some agents is negatively correlated"
        if self.experiment.protocol:
            all_agents = self._system(frozenset(range(self.agents)), self.gain if math.isfinite(self.gain) else 0.0)
            if all_agents.matrices.min() < 0.0:
                return "some weights of the protocol are negative"
        elif self.law == "emulated":
            pull = self.gain if math.isfinite(self.gain) else 0.0
            degree = max(float(graph.adjacency.sum(axis=1).max()) for graph in self.experiment.graph_list)
            if self.experiment.step_length * (degree + pull) > 1.0:
                return "run.dt times the largest sum of an agent's weights (and its gain) is above 1"
        return None

    @cached_property
    def _reach(self) -> BoolArray:
        """(m, m): whether a leader i reaches agent j in the union of all graphs."""
        union = np.sum([graph.adjacency for graph in self.experiment.graph_list], axis=0).T
        distances = scipy.sparse.csgraph.shortest_path(scipy.sparse.csr_array(union), unweighted=True)
        return np.asarray(np.isfinite(distances))

    def unreached(self, leaders: Leaders) -> int:
        """Number of agents that no leader (from 0) reaches in the union of all graphs; E is finite only if it is 0."""
        return int((~self._reach[sorted(leaders)].any(axis=0)).sum())

    def system_error(self, leaders: Leaders) -> float:
        """E(S), the sum of the mean-square deviations from the reference; inf where S does not reach all agents."""
        if not leaders or self.unreached(leaders):
            return math.inf
        system = self._system(leaders, self.gain)
        if system.dimension == 0:
            return 0.0
        steady = MomentSolver(system).steady()
        return float(np.trace(system.lifted(steady.sum(axis=0))))

    def _system(self, leaders: Leaders, gain: float) -> JumpSystem:
        """The reduced system with these leaders; infinite gain deletes them (continuous time) or zeroes their rows."""
        spec = LeadersSpec.model_construct(agents=[agent + 1 for agent in sorted(leaders)], gain=gain, reference=0.0)
        changes = {"problem": "tracking", "leaders": spec}
        led = dataclasses.replace(self.experiment, spec=self.experiment.spec.model_copy(update=changes))
        if self.law == "continuous":
            return systems.continuous(led)
        return systems.emulated(build_run_model(led), "tracking")


@dataclass(frozen=True, slots=True, repr=False)
class Selection:
    """Result of a leader selection; agents count from 1.

    Attributes
    ----------
    problem
        experiment, law and gain
    method
        "exhaustive", "greedy" or "swap"
    sets
        (E, agents), best first; for greedy and swap, the best of those that were evaluated
    order
        agents in the order of the greedy choice, with exchanged ones in place of the replaced; () if exhaustive
    evaluations
        number of system errors that were solved for
    bound
        no set of this size has a smaller system error; None where no bound is known
    present
        (E, agents) of the experiment's own leaders, with the same gain; None if it has none
    """

    problem: LeaderProblem
    method: str
    sets: list[tuple[float, tuple[int, ...]]]
    order: tuple[int, ...]
    evaluations: int
    bound: float | None
    present: tuple[float, tuple[int, ...]] | None = None

    def __repr__(self) -> str:
        error, agents = self.sets[0]
        best = f"agents {self._named(agents)} with system error {error:.6g}"
        return f"<Selection for {self.problem.experiment.name!r}: {best}; {self.method}, {self.evaluations} evaluated>"

    def _repr_markdown_(self) -> str:
        rows = [(self._named(agents), number_text(error)) for error, agents in self.sets]
        return markdown_table(("leaders", "system error"), rows)

    def _named(self, agents: tuple[int, ...]) -> str:
        return ", ".join(agent_name(agent, self.problem.experiment.names) for agent in agents)

    def to_json(self) -> dict[str, Any]:
        """The document of ``msg-analysis leaders --json``; agents count from 1."""
        best = self.sets[0][0]
        gap = best / self.bound - 1.0 if self.bound else None
        return {
            "experiment": self.problem.experiment.name,
            "names": self.problem.experiment.names,
            "law": self.problem.law,
            "gain": "inf" if math.isinf(self.problem.gain) else self.problem.gain,
            "count": len(self.sets[0][1]),
            "method": self.method,
            "sets": [
                {
                    "agents": list(agents),
                    "system_error": error,
                    "joint_centrality": 1.0 / error if error > 0.0 else None,
                }
                for error, agents in self.sets
            ],
            "order": list(self.order),
            "evaluations": self.evaluations,
            "bound": {"system_error": self.bound, "gap": gap},
            "present": self.present and {"agents": list(self.present[1]), "system_error": self.present[0]},
            "supermodular": self.problem.supermodular,
            "note": self.problem.doubt,
        }


def resolve_law(experiment: Experiment, law: SelectionLaw | None = None) -> SelectionLaw:
    """``law`` if the experiment has it, else InputError; None stands for the paper's law, or else that of the steps."""
    if experiment.time == "discrete":
        possible: list[SelectionLaw] = ["discrete"]
    elif experiment.noise.steps_only or experiment.protocol:
        possible = ["emulated"]
    else:
        possible = ["continuous", "emulated"]
    if law is None:
        return possible[0]
    if law not in possible:
        reason = "discrete time" if experiment.time == "discrete" else "continuous time"
        if law == "continuous" and experiment.time == "continuous":
            reason += " with a protocol, noise on the air, loss, delay or activation, which belong to steps"
        raise InputError(f"law {law}: {experiment.source} is in {reason}: use {' or '.join(possible)}")
    return law


@few_blas_threads
def system_error(
    experiment: Experiment, agents: Iterable[int | str], *, law: SelectionLaw | None = None, gain: float = math.inf
) -> float:
    """E(S) with the given agents as leaders; inf where S does not reach all agents.

    Parameters
    ----------
    experiment
        consensus or tracking; its own leaders are ignored
    agents
        the leaders S, by number from 1 or name
    law
        "continuous", "emulated" or "discrete"; None for the paper's where the experiment has it, else that of its steps
    gain
        kappa [1 / unit of time]

    Raises
    ------
    InputError
        the experiment does not have this law, or E(S) cannot be computed
    """
    problem = LeaderProblem(experiment, resolve_law(experiment, law), gain)
    return problem.system_error(frozenset(experiment.indices(agents)))


def joint_robustness_centrality(
    experiment: Experiment, agents: Iterable[int | str], *, law: SelectionLaw | None = None
) -> float:
    """1/E(S) in the exact limit of infinite gain (the paper's definition, Section 4); inf where E(S) is 0.

    Parameters
    ----------
    experiment, agents, law
        see ``system_error``
    """
    error = system_error(experiment, agents, law=law)
    return 1.0 / error if error > 0.0 else math.inf


@few_blas_threads
def select_leaders(
    experiment: Experiment,
    count: int | None = None,
    *,
    method: SearchMethod = "auto",
    law: SelectionLaw | None = None,
    gain: float | None = None,
    top: int = 10,
    watch: SearchProgress | None = None,
) -> Selection:
    """The set of leaders with the least system error, or a good one; arguments and errors of ``Experiment.leaders``."""
    _check(method in get_args(SearchMethod), f"method {method}: expected one of {', '.join(get_args(SearchMethod))}")
    own = experiment.spec.leaders
    leading = tuple(int(agent) for agent in np.flatnonzero(experiment.leader_gains))
    gain = gain if gain is not None else own.gain if own else math.inf
    _check(count is not None or bool(own), f"count: {experiment.source} has no leaders: give their number")
    count = len(leading) if count is None else count
    _check(gain > 0.0, f"gain {gain}: expected a number > 0, or inf for leaders held at the reference")
    most = experiment.agents - (1 if math.isinf(gain) else 0)
    _check(
        1 <= count <= most,
        f"count {count}: expected 1 to {most}, since {experiment.source} has {experiment.agents} agents"
        + (" and at least one agent must follow" if math.isinf(gain) else ""),
    )
    _check(top >= 1, f"top {top}: expected a number >= 1")
    problem = LeaderProblem(experiment, resolve_law(experiment, law), gain)
    sets = math.comb(experiment.agents, count)
    chosen_method = method if method != "auto" else "exhaustive" if sets <= AUTO_SETS else "swap"
    search = LeaderSearch(problem, watch and (lambda stage, *rest: watch(with_names(stage, experiment.names), *rest)))
    order: list[int] = []
    bound: float | None = None
    if chosen_method == "exhaustive":
        _check(sets <= MOST_SETS, f"method exhaustive: {sets} sets of {count} leaders: use swap")
        found = search.exhaustive(count, top)
    else:
        order = search.greedy(count) if chosen_method == "greedy" else search.swap(count)
        if count > 1 and problem.supermodular and not problem.unreached(frozenset(order)):
            bound = search.bound(frozenset(order))
        found = search.evaluated(count, top)
    unreached = f"count {count}: no set of {count} reaches all agents in the union of all graphs: use more leaders"
    _check(bool(found), unreached)
    if chosen_method == "exhaustive" or count == 1:  # a single leader: all of them were evaluated
        bound = found[0][0]
    result = [(error, _numbers(sorted(agents))) for error, agents in found]
    present = (problem.system_error(frozenset(leading)), _numbers(leading)) if leading else None
    return Selection(problem, chosen_method, result, _numbers(order), search.evaluations, bound, present)


def _numbers(agents: Iterable[int]) -> tuple[int, ...]:
    """Numbers from 1 of agents from 0."""
    return tuple(int(agent) + 1 for agent in agents)


def _check(condition: bool, complaint: str) -> None:
    if not condition:
        raise InputError(complaint)
