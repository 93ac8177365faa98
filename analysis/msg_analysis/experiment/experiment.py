# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The experiment: a Markov switching network and a run of it, read from a file and checked completely."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.text import markdown_table, number_text
from msg_analysis.errors import NotAvailableError
from msg_analysis.experiment import graph_sources, loading, protocols, validation
from msg_analysis.experiment.graphs import Graph
from msg_analysis.experiment.loading import Sections, other_kind, read_yaml
from msg_analysis.experiment.markov_chain import MarkovChain, Time
from msg_analysis.experiment.network_spec import NoiseSpec, SwitchingSpec
from msg_analysis.experiment.problems import ExperimentError, problem, show
from msg_analysis.experiment.protocols import ChosenProtocol, ProtocolInfo
from msg_analysis.experiment.spec import ExperimentSpec, LeadersSpec, Purpose, RunSpec
from msg_analysis.protocol import Network

__all__ = ["ExperimentError", "Experiment", "json_schema"]

MOST_STATES = 512
"""Of graph and links together, in a prediction with losses in bursts."""

MOST_VALUES = 1500
"""That agents keep from step to step, in a prediction: the last ones heard, and those that a delay makes older."""

SHOWN_GRAPHS = 4
"""Largest number of graphs named in a ``repr``."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Experiment:
    """A valid experiment. Two are equal if their documents are, the order of the graphs included.

    Attributes
    ----------
    spec
        the normalised document: defaults written out, number of agents known, GraphML files read
    graph_list
        the n graphs, in the order of the modes
    chain
        the Markov chain that switches between the graphs
    noise_gain
        (n, m, m) F_i; Q_i = F_i F_i^T
    loss
        (m, m) probability that a message from agent j (column) to agent i (row) is lost; 0 on the diagonal
    source
        where the experiment came from, for messages
    protocol
        the protocol that replaces the built-in law; None for the built-in law
    """

    spec: ExperimentSpec
    graph_list: tuple[Graph, ...]
    chain: MarkovChain
    noise_gain: FloatArray
    loss: FloatArray
    source: str = "experiment"
    protocol: ChosenProtocol | None = None

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Experiment)
            and self.spec == other.spec
            and list(self.spec.graphs) == list(other.spec.graphs)
        )

    __hash__ = None  # type: ignore[assignment]  # the document has lists in it

    def __repr__(self) -> str:
        graphs = ", ".join(graph.name for graph in self.graph_list[:SHOWN_GRAPHS])
        more = ", ..." if len(self.graph_list) > SHOWN_GRAPHS else ""
        kind = f"{self.problem} of {self.agents} agents in {self.time} time"
        return f"<Experiment {self.name!r}: {kind}, graphs {graphs}{more}; {self.steps} steps of {self.step_length:g}>"

    def _repr_markdown_(self) -> str:
        shares = self.chain.stationary
        rows = [
            (graph.name, str(len(graph.edges if graph.symmetric else graph.arcs)), number_text(share))
            for graph, share in zip(self.graph_list, shares, strict=True)
        ]
        run = self.run
        return (
            f"**{self.name}**: {self.problem} of {self.agents} agents in {self.time} time; {self.steps} steps of "
            f"{self.step_length:g}, {run.replicas} replicas, seed {run.seed}, {run.pace}\n\n"
            + markdown_table(("graph", "links", "share of time"), rows)
        )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read an experiment file (YAML, of which JSON is a part).

        Parameters
        ----------
        path
            of the file; paths in it are relative to its directory

        Raises
        ------
        InputError
            the file cannot be read or is not YAML
        ExperimentError
            the experiment is not valid; names every mistake
        """
        path = Path(path)
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
            the document, as a YAML or JSON reader gives it
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
            raise ExperimentError(
                source,
                [problem("experiment", show(mapping), "expected keys with values", "start with `name:`")],
            )
        if instead := other_kind(mapping, "experiment"):
            raise ExperimentError(source, [f"is {instead}"])
        sections = Sections(mapping, recorded)
        sections.resolve(directory or Path())
        if sections.problems:
            raise ExperimentError(source, sections.problems)
        assert sections.chain is not None
        assert sections.noise_gain is not None
        assert sections.loss is not None
        experiment = cls(
            spec=sections.spec(),
            graph_list=sections.graphs,
            chain=sections.chain,
            noise_gain=sections.noise_gain,
            loss=sections.loss,
            source=source,
            protocol=sections.protocol,
        )
        return experiment._with_protocol(sections.protocol, recorded) if sections.protocol else experiment

    def _with_protocol(self, protocol: ChosenProtocol, recorded: ProtocolInfo | None) -> Self:
        """The same with a protocol that knows its network."""
        bound, found = protocols.bind(protocol, self._network(), self.run, self.names, recorded)
        experiment = replace(self, protocol=bound)
        size = experiment.agents, len(self.graph_list), experiment.steps, experiment.width
        found += loading.memory_problems(*size, 0, experiment.truth)
        if found:
            raise ExperimentError(self.source, found)
        return experiment

    def _network(self) -> Network:
        """What a protocol is told of the network."""
        return Network(
            graphs=self.graph_list,
            dt=self.step_length,
            noise_gain=self.step_noise_gain,
            tracking=self.problem == "tracking",
            leader_gains=self.leader_gains,
            reference=self.reference,
        )

    def to_document(self) -> dict[str, Any]:
        """The normalised, self-contained document, ready for JSON; parsed again it gives an equal experiment."""
        document: dict[str, Any] = self.spec.model_dump(mode="json", exclude_none=True)
        if self.spec.protocol:
            # None may differ from the default of a parameter, so it must not be left out.
            document["protocol"] = self.spec.protocol.model_dump(mode="json")
        return document

    def with_run(self, **changes: Any) -> Self:
        """The same experiment with other values of ``run``, checked again.

        Parameters
        ----------
        changes
            keys of ``run`` (seed, duration, pace, ...) and their new values

        Raises
        ------
        ExperimentError
            the new document is not valid; names every mistake
        """
        document = self.to_document()
        document["run"].update(changes)
        return self.parse(document, source=self.source)

    def unavailable(self, purpose: Purpose = "run") -> list[str]:
        """What the experiment asks for that this version cannot do, one line each.

        Parameters
        ----------
        purpose
            "run" (simulate it or run a network) or "predict"
        """
        lines = self._unpredicted() if purpose == "predict" else []
        if self.protocol:
            lines += self.protocol.unavailable(purpose)
        return lines

    def unpredictable(self) -> str | None:
        """Why there is no prediction, as a part of a sentence; None where there is one."""
        reason = self.protocol.unpredictable() if self.protocol else None
        if not reason and (lines := self._unpredicted()):
            reason = lines[0]
        return reason

    def _unpredicted(self) -> list[str]:
        """What has no prediction because it would be too large, apart from protocols that are not linear."""
        noise, lines = self.noise, []
        links = graph_sources.heard_links(self.graph_list, self.time) & np.isfinite(self.leader_gains)[:, None]
        lossy = int((links & (self.loss > 0.0)).sum())
        if noise.burst is not None and len(self.graph_list) * 2.0**lossy > MOST_STATES:
            wanted = f"has no prediction: 2^{lossy} states of {lossy} links that lose messages, expected at most "
            wanted += f"{MOST_STATES} with those of the graph"
            lines.append(problem("noise.burst", noise.burst, wanted, "remove it, or give fewer links a loss"))
        kept = self.agents * (noise.delay + 2) + lossy * (noise.delay + 1) * noise.holds
        by_message = noise.holds or (self.run.pace == "realtime" and noise.steps_only)
        if by_message and kept > MOST_VALUES:
            wanted = f"has no prediction: {kept} values are kept from step to step, expected at most {MOST_VALUES}"
            lines.append(problem("noise.on_loss", noise.on_loss, wanted, "use fewer agents or links, or own values"))
        return lines

    def require_available(self, purpose: Purpose = "run") -> None:
        """Raise an error if the experiment asks for something that this version cannot do.

        Parameters
        ----------
        purpose
            "run" (simulate it or run a network) or "predict"

        Raises
        ------
        NotAvailableError
            lists what is not available
        """
        lines = self.unavailable(purpose)
        if lines and self.protocol and lines == self.protocol.unavailable(purpose):
            raise NotAvailableError(f"{self.source}: {lines[0]}")
        if lines:
            raise NotAvailableError("\n  ".join([f"{self.source}: not available in this version", *lines]))

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.spec.name

    @property
    def problem(self) -> str:
        """Either "consensus" or "tracking"."""
        return self.spec.problem

    @property
    def time(self) -> Time:
        """Either "continuous" or "discrete"."""
        return self.spec.time

    @property
    def agents(self) -> int:
        """Number of agents m."""
        return self.graph_list[0].agents

    @property
    def names(self) -> list[str] | None:
        """Names of the agents, in the order of their numbers; None where they have only numbers."""
        return self.spec.names

    @property
    def switching(self) -> SwitchingSpec:
        """Section ``switching``."""
        return self.spec.switching

    @property
    def noise(self) -> NoiseSpec:
        """Section ``noise``."""
        return self.spec.noise

    @property
    def leaders(self) -> LeadersSpec | None:
        """Section ``leaders``; None in consensus."""
        return self.spec.leaders

    @property
    def run(self) -> RunSpec:
        """Section ``run``."""
        return self.spec.run

    @property
    def steps_only(self) -> bool:
        """Whether the law exists only in steps, not in continuous time: noise on the air, loss, delay or a protocol."""
        return self.noise.steps_only or self.protocol is not None

    @property
    def width(self) -> int:
        """Numbers in an agent's state: the number of replicas, times the numbers in the state of a protocol."""
        protocol = self.protocol
        return self.run.replicas * (protocol.info.states if protocol else 1)

    @property
    def truth(self) -> bool:
        """Whether agents publish something else than their whole state, which then has a topic of its own."""
        protocol = self.protocol
        return self.noise.broadcast > 0 or (protocol is not None and protocol.info.hidden)

    @property
    def leader_gains(self) -> FloatArray:
        """(m,) kappa; 0 for followers, inf for grounded leaders."""
        return validation.leader_gains(self.leaders, self.agents)

    @property
    def reference(self) -> float:
        """The value that tracking agents should reach; 0 for consensus."""
        return self.leaders.reference if self.leaders else 0.0

    @property
    def steps(self) -> int:
        """Number of steps N of a run, which has the states x(0), ..., x(N)."""
        return self.run.steps

    @property
    def step_length(self) -> float:
        """Simulated time of a step, ``run.dt`` [units of simulated time]; 1 in discrete time."""
        return self.run.dt

    @property
    def step_noise_gain(self) -> FloatArray:
        """(n, m, m) sqrt(dt) F_i: the noise that a step of the built-in law adds is this times N(0, I)."""
        return np.asarray(np.sqrt(self.step_length) * self.noise_gain)


def json_schema() -> dict[str, Any]:
    """JSON Schema of the experiment file, for editors."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | ExperimentSpec.model_json_schema()
