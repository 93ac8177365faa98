# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The experiment: a Markov switching network and a run of it, read from a file and checked completely."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.text import listed, markdown_table, number_text
from msg_analysis.errors import NotAvailableError
from msg_analysis.experiment import limits, protocols, validation
from msg_analysis.experiment.examples import find
from msg_analysis.experiment.graphs import Graph
from msg_analysis.experiment.links import IndependentLinks, LinkSchedule, expanded
from msg_analysis.experiment.loading import Sections, other_kind, read_yaml
from msg_analysis.experiment.markov_chain import MarkovChain, Schedule, require_chain
from msg_analysis.experiment.problems import ExperimentError, problem, show
from msg_analysis.experiment.protocols import ChosenProtocol, ProtocolInfo
from msg_analysis.experiment.spec import ExperimentSpec, Purpose, json_schema
from msg_analysis.experiment.variants import Variants
from msg_analysis.protocol import Network

if TYPE_CHECKING:
    from msg_analysis.inference.sample_size import RunPlan
    from msg_analysis.model.run import Run
    from msg_analysis.model.run_record import RunRecord
    from msg_analysis.theory.leader_search import SearchProgress
    from msg_analysis.theory.leaders import SearchMethod, Selection, SelectionLaw
    from msg_analysis.theory.prediction import Prediction
    from msg_analysis.theory.spectrum import Spectrum
    from msg_analysis.theory.transient import Transient, TransientLaw

__all__ = ["Experiment", "ExperimentError", "json_schema"]

SHOWN_GRAPHS = 4  # most graphs named in a ``repr``


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Experiment(Variants):
    """A valid experiment. Two are equal if their documents are, the order of the graphs included.

    Attributes
    ----------
    spec
        the normalised document: defaults written out, number of agents known, GraphML files read
    graph_list
        the n graphs, in the order of the modes
    switching_law
        what switches between the graphs: a Markov chain, or a schedule, which may be drawn from the seed
    noise_gain
        (n, m, m) F_i; Q_i = F_i F_i^T
    loss
        (m, m) probability that a message from agent j (column) to agent i (row) is lost; 0 on the diagonal
    source
        where the experiment came from, for messages
    protocol
        the protocol that replaces the built-in law; None for the built-in law
    notes
        what was not read of the files with graphs, or might be understood in another way, one line each
    """

    spec: ExperimentSpec
    graph_list: tuple[Graph, ...]
    switching_law: MarkovChain | Schedule
    noise_gain: FloatArray
    loss: FloatArray
    source: str = "experiment"
    protocol: ChosenProtocol | None = None
    notes: tuple[str, ...] = ()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Experiment):
            return False
        return self.spec == other.spec and list(self.spec.graphs) == list(other.spec.graphs)

    __hash__ = None  # type: ignore[assignment]  # the document has lists in it

    def __repr__(self) -> str:
        graphs = listed([graph.name for graph in self.graph_list], SHOWN_GRAPHS)
        what = f"{self.name!r}: {self.problem} of {self.agents} agents in {self.time} time"
        return f"<Experiment {what}, graphs {graphs}; {self.steps} steps of {self.step_length:g}>"

    def _repr_markdown_(self) -> str:
        rows = [
            (graph.name, str(graph.links), number_text(share))
            for graph, share in zip(self.graph_list, self.switching_law.stationary, strict=True)
        ]
        run = self.run
        return (
            f"**{self.name}**: {self.problem} of {self.agents} agents in {self.time} time; {self.steps} steps of "
            f"{self.step_length:g}, {run.replicas} replicas, seed {run.seed}, {run.pace}\n\n"
            + markdown_table(("graph", "links", "share of time"), rows)
        )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read an experiment file (YAML, of which JSON is a part), or an installed example.

        Parameters
        ----------
        path
            of the file, or the name of an example, such as ``line_ring``; a file of that name, with or without
            ``.yaml``, wins. Paths in a file are relative to its directory

        Raises
        ------
        InputError
            neither a file nor an example, or not YAML
        ExperimentError
            the experiment is not valid; names every mistake
        """
        path = find(path)
        return cls.parse(read_yaml(path), source=str(path), directory=path.parent)

    @classmethod
    def parse(
        cls,
        mapping: Any,
        *,
        source: str = "experiment",
        directory: Path | None = None,
        recorded: ProtocolInfo | None = None,
    ) -> Self:
        """Check a document and make an experiment of it.

        Parameters
        ----------
        mapping
            the document, as a YAML or JSON reader gives it; numbers of numpy, arrays, tuples and matrices of
            scipy.sparse may stand for numbers and lists, and matrices and graphs of networkx for graphs
        source
            where it came from, for messages
        directory
            base of the relative paths in it; by default the current directory
        recorded
            the protocol that a recorded run used, which need not be installed

        Raises
        ------
        ExperimentError
            the document is not valid; names every mistake
        """
        if not isinstance(mapping, Mapping):
            line = problem("experiment", show(mapping), "expected keys with values", "start with `name:`")
            raise ExperimentError(source, [line])
        if instead := other_kind(mapping, "experiment"):
            raise ExperimentError(source, [f"is {instead}"])
        sections = Sections(mapping, recorded)
        sections.resolve(directory or Path())
        if sections.problems:
            raise ExperimentError(source, sections.problems)
        experiment = cls(**sections.parts(), source=source, notes=tuple(sections.notes))
        return experiment.bound(recorded) if experiment.protocol else experiment

    def bound(self, recorded: ProtocolInfo | None) -> Self:
        """The same with a protocol that knows its network; ExperimentError: it does not fit, or is too large."""
        assert self.protocol is not None
        network = Network(
            graphs=self.graph_list,
            dt=self.step_length,
            noise_gain=np.asarray(np.sqrt(self.step_length) * self.noise_gain),
            tracking=self.problem == "tracking",
            leader_gains=self.leader_gains,
            reference=self.reference,
        )
        bound, found = protocols.bind(self.protocol, network, self.run, self.names, recorded)
        experiment = replace(self, protocol=bound)
        size = 1 if self.schedule else len(self.graph_list), self.steps, experiment.width
        found += limits.memory_problems(self.agents, *size, 0, experiment.truth)
        if found:
            raise ExperimentError(self.source, found)
        return experiment

    def to_document(self) -> dict[str, Any]:
        """The normalised, self-contained document, ready for JSON; parsed again it gives an equal experiment."""
        document: dict[str, Any] = self.spec.model_dump(mode="json", exclude_none=True)
        if self.spec.protocol:  # None may differ from the default of a parameter, so it must not be left out
            document["protocol"] = self.spec.protocol.model_dump(mode="json")
        return document

    def predict(self, *, start: float = 0.0) -> Prediction:
        """The exact steady second moments, of a schedule means over time; each law has errors, certainty, covariance.

        Parameters
        ----------
        start
            with a schedule: only times after this one count [units of simulated time]; else 0

        Returns
        -------
        Prediction
            ``emulated`` (the steps of the run), ``continuous`` (the paper's law), ``static`` (each graph held fixed)

        Raises
        ------
        NotAvailableError
            the experiment asks for something that cannot be predicted
        InputError
            too large, without finite steady errors, or a ``start`` that is not in the run
        """
        from msg_analysis.theory.prediction import predict

        self.require_available("predict")
        return predict(self, start=start)

    def transient(self, times: ArrayLike, *, law: TransientLaw = "emulated", unreduced: bool = False) -> Transient:
        """The exact moments over time from the experiment's own start.

        Parameters
        ----------
        times
            (T,) ascending, >= 0 [units of simulated time]; multiples of ``run.dt`` in the emulated law
        law
            "emulated" (the steps of the run) or "continuous" (the paper's)
        unreduced
            consensus only: moments of the states themselves, which grow without bound, not of the disagreement

        Returns
        -------
        Transient
            ``times`` as given, ``system_error`` (T,), ``node_errors`` (T, m), ``mean`` (T, m)

        Raises
        ------
        NotAvailableError
            the experiment asks for something that cannot be predicted
        InputError
            invalid times, a law or ``unreduced`` that does not exist here, too large, or no finite steady errors
        """
        from msg_analysis.theory.transient import solve_transient

        self.require_available("predict")
        given = np.asarray(times, dtype=float)
        return replace(solve_transient(self, given, law=law, unreduced=unreduced).course, times=given)

    def simulate(
        self, *, seed: int | None = None, duration: float | None = None, record: RunRecord | None = None
    ) -> Run:
        """Run the experiment without ROS: the offline twin of a network.

        Parameters
        ----------
        seed
            replaces ``run.seed``
        duration
            replaces ``run.duration`` [units of simulated time]
        record
            of a run to repeat; its experiment, seed and duration are then used instead of these. By default a new run

        Returns
        -------
        Run
            equal, to the last bit, to a network run in lockstep; in real time, to one with ideal timers and no delay

        Raises
        ------
        ExperimentError
            the seed or the duration is not valid
        NotAvailableError
            the experiment asks for something that runs do not have yet
        InputError
            the stationary start cannot be computed: too large, or no finite steady errors
        """
        from msg_analysis.twin.simulate import simulate

        changes = {key: value for key, value in (("seed", seed), ("duration", duration)) if value is not None}
        experiment = self.with_run(**changes) if changes else self
        experiment.require_available()
        return simulate(experiment, record=record)

    def plan(
        self, precision: float = 0.01, *, seconds: float | None = None, rate: float | None = None, level: float = 0.01
    ) -> RunPlan:
        """What runs will show, before any run: length and replicas for a precision, time, power for faults.

        Parameters
        ----------
        precision
            half-width of the 95 % interval of the system error that is sought, relative to the predicted error; above
            0, below 1
        seconds
            time budget [s] for which the best number of replicas is sought; None: none
        rate
            steps per second of a run in lockstep, such as ``msg-agents run`` prints; None: not known, or in real time,
            where the clock says it
        level
            probability of a false "disagrees", all tests together; above 0, at most 0.5

        Returns
        -------
        RunPlan
            ``precision`` (standard error of any length, and the reverse), ``powers`` (one per fault), ``to_json()``

        Raises
        ------
        NotAvailableError
            the experiment asks for something that cannot be predicted
        InputError
            an argument that is not valid, a system error of 0, or one whose variance is not finite
        """
        from msg_analysis.inference.sample_size import plan

        return plan(self, precision, seconds=seconds, rate=rate, level=level)

    def spectrum(self, lags: ArrayLike | None = None, frequencies: ArrayLike | None = None) -> Spectrum:
        """Autocovariance and spectral density of the errors in the steady state, exactly.

        Parameters
        ----------
        lags
            (L,) ascending, >= 0 [steps]; None: up to 200, from 0 to where 1 % of lag 0 is left
        frequencies
            (F,) ascending, from 0 to 1 / (2 dt) [cycles per unit of simulated time]; None: 200, equally spaced on a
            logarithmic axis

        Returns
        -------
        Spectrum
            ``covariances`` (L, m, m), ``system_autocovariance`` (L,), ``system_density`` (F,), ``node_densities``
            (F, m)

        Raises
        ------
        NotAvailableError
            the experiment asks for something that cannot be predicted
        InputError
            lags or frequencies that are not valid, too large, or without finite steady errors
        """
        from msg_analysis.theory.spectrum import spectrum

        self.require_available("steady")
        wanted = None if lags is None else np.asarray(lags, dtype=np.int64)
        return spectrum(self.predict(), wanted, None if frequencies is None else np.asarray(frequencies, dtype=float))

    def leaders(
        self,
        count: int | None = None,
        *,
        method: SearchMethod = "auto",
        law: SelectionLaw | None = None,
        gain: float | None = None,
        top: int = 10,
        watch: SearchProgress | None = None,
    ) -> Selection:
        """The sets of leaders with the least system error (at infinite gain, the largest joint robustness centrality).

        Parameters
        ----------
        count
            number of leaders; None: as many as the experiment has
        method
            "exhaustive" (every set), "greedy" or "swap" (good sets), or "auto": exhaustive up to 1000 sets, else swap
        law
            "continuous" (the paper's), "emulated" (the steps of the run) or "discrete"; by default the paper's where
            there is one, else that of the steps
        gain
            pull of the leaders [1 / unit of simulated time]; inf holds them at the reference; None: that of the
            experiment's leaders, inf in consensus
        top
            most sets in the result
        watch
            called during the search with its stage, evaluations done, of how many, and the least system error so far

        Returns
        -------
        Selection
            ``sets``: (system error, agents from 1), best first; ``present``: that of the experiment's own leaders

        Raises
        ------
        NotAvailableError
            the experiment asks for something that cannot be predicted
        InputError
            an impossible count, gain or law; no count in consensus; too many sets; no set that reaches all agents
        """
        from msg_analysis.theory.leaders import select_leaders

        self.require_available("steady")
        return select_leaders(expanded(self), count, method=method, law=law, gain=gain, top=top, watch=watch)

    def require_available(self, purpose: Purpose = "run") -> None:
        """Refuse an experiment that asks for something that this version cannot do.

        Parameters
        ----------
        purpose
            "run" (simulate it or run a network), "predict", or "steady" (what only a chain has)

        Raises
        ------
        NotAvailableError
            lists it
        """
        lines = limits.unavailable(self, purpose)
        if lines and self.protocol and lines == self.protocol.unavailable(purpose):
            raise NotAvailableError(f"{self.source}: {lines[0]}")
        if lines:
            raise NotAvailableError("\n  ".join([f"{self.source}: not available in this version", *lines]))

    @property
    def chain(self) -> MarkovChain:
        """The Markov chain that switches between the graphs; NotAvailableError where they have a schedule."""
        return require_chain(self.switching_law)

    @property
    def schedule(self) -> Schedule | None:
        """The given sequence of the graphs; None where a chain switches between them."""
        return self.switching_law if isinstance(self.switching_law, Schedule) else None

    @property
    def links(self) -> IndependentLinks | None:
        """The law of links that switch by themselves, from which the schedule was drawn; None where there is none."""
        return self.switching_law.law if isinstance(self.switching_law, LinkSchedule) else None

    @property
    def written_graphs(self) -> tuple[Graph, ...]:
        """The graphs of the file: where links switch by themselves, the one with all links, else all n."""
        if self.links is None:
            return self.graph_list
        return (replace(self.links.mesh, name=next(iter(self.spec.graphs))),)

    @property
    def agents(self) -> int:
        """Number of agents m."""
        return self.graph_list[0].agents

    @property
    def width(self) -> int:
        """Numbers in an agent's state: the number of replicas, times the numbers in the state of a protocol."""
        return self.run.replicas * (self.protocol.info.states if self.protocol else 1)

    @property
    def truth(self) -> bool:
        """Whether agents publish something else than their whole state, which then has a topic of its own."""
        return self.noise.broadcast > 0 or (self.protocol is not None and self.protocol.info.hidden)

    @property
    def leader_gains(self) -> FloatArray:
        """(m,) kappa; 0 for followers, inf for grounded leaders."""
        return validation.leader_gains(self.spec.leaders, self.agents)

    @property
    def external(self) -> frozenset[int]:
        """Agents (indices from 0) that are programs or robots of the user: a run does not start them."""
        return frozenset(agent - 1 for agent in self.run.external or ())

    @property
    def known_start(self) -> FloatArray | None:
        """(m,) x(0); None where it is drawn from the steady state."""
        start = self.run.start
        if start == "stationary":
            return None
        return np.zeros(self.agents) if start == "zero" else np.array(start, dtype=float)

    @property
    def holding_times(self) -> list[float | None]:
        """Mean time in each graph before it is left [units of simulated time]; None where it is never left."""
        unit = self.step_length if self.time == "discrete" and not self.schedule else 1.0
        return [None if time is None else unit * time for time in self.switching_law.holding_times]
