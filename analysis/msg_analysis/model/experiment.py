"""The experiment: a Markov switching network and a run of it, read from a file and checked completely."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from msg_analysis.errors import NotAvailableError
from msg_analysis.model import protocols, topology, validation
from msg_analysis.model.chain import MarkovChain, Time
from msg_analysis.model.document import read_yaml
from msg_analysis.model.graphs import Graph
from msg_analysis.model.problems import ExperimentError, problem, show, translate
from msg_analysis.model.protocols import ChosenProtocol, ProtocolInfo
from msg_analysis.model.spec import (
    ExperimentSpec,
    GraphSpec,
    LeadersSpec,
    NoiseSpec,
    Purpose,
    RunSpec,
    SwitchingSpec,
)
from msg_analysis.types import FloatArray

__all__ = ["Experiment", "ExperimentError", "json_schema"]


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """A valid experiment. Two are equal if their documents are, the order of the graphs included.

    Attributes
    ----------
    spec : the document, normalised: defaults written out, number of agents known, GraphML files read
    graph_list : the n graphs, in the order of the modes
    chain : the Markov chain that switches between them
    noise_gain : (n, m, m) F_i; Q_i = F_i F_i^T
    source : where it came from, for messages
    protocol : what the agents do instead of the built-in law, if anything
    """

    spec: ExperimentSpec
    graph_list: tuple[Graph, ...] = field(repr=False)
    chain: MarkovChain = field(repr=False)
    noise_gain: FloatArray = field(repr=False)
    source: str = "experiment"
    protocol: ChosenProtocol | None = field(default=None, repr=False)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Experiment)
            and self.spec == other.spec
            and list(self.spec.graphs) == list(other.spec.graphs)
        )

    __hash__ = None  # type: ignore[assignment]  # the document has lists in it

    @classmethod
    def load(cls, path: str | Path) -> Experiment:
        """Read an experiment file (YAML; JSON is YAML too).

        Raises
        ------
        InputError : the file cannot be read or is not YAML
        ExperimentError : the experiment is not valid; names every mistake
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
    ) -> Experiment:
        """Check a document and make it an experiment.

        Parameters
        ----------
        mapping : the document, as a YAML or JSON reader gives it
        source : where it came from, for messages
        directory : what the paths in it are relative to; by default the current directory
        recorded : of a recorded run, the protocol that was used, which need not be installed

        Raises
        ------
        ExperimentError : names every mistake in the document
        """
        if not isinstance(mapping, Mapping):
            raise ExperimentError(
                source,
                [problem("experiment", show(mapping), "expected keys with values", "start with `name:`")],
            )
        sections = _Sections(mapping, recorded)
        sections.resolve(directory or Path())
        if sections.problems:
            raise ExperimentError(source, sections.problems)
        experiment = sections.experiment(source)
        if sections.problems:
            raise ExperimentError(source, sections.problems)
        return experiment

    def to_document(self) -> dict[str, Any]:
        """The normalised document: self-contained, fit for JSON; parsed again it gives an equal one."""
        document: dict[str, Any] = self.spec.model_dump(mode="json", exclude_none=True)
        if self.spec.protocol:
            # A parameter that is None need not be so by default.
            document["protocol"] = self.spec.protocol.model_dump(mode="json")
        return document

    def with_run(self, **changes: Any) -> Experiment:
        """The same experiment with other values of ``run``, checked again.

        Parameters
        ----------
        changes : keys of ``run`` (seed, duration, pace, ...) and their new values

        Raises
        ------
        ExperimentError : names the key
        """
        document = self.to_document()
        document["run"].update(changes)
        return Experiment.parse(document, source=self.source)

    def unavailable(self, purpose: Purpose = "run") -> list[str]:
        """What the experiment asks for that this version does not do yet, one line each.

        Parameters
        ----------
        purpose : "run" (simulate or run it) or "predict" (exact for any noise)
        """
        lines = []
        if self.run.pace == "realtime":
            lines += self._unavailable_in_real_time()
        elif purpose == "run" and self.noise.delay > 0:
            lines.append(problem("noise.delay", self.noise.delay, "not available in runs yet", "use 0"))
        if self.protocol:
            lines += self.protocol.unavailable(purpose)
        return lines

    def _unavailable_in_real_time(self) -> list[str]:
        noise = self.noise
        lines = [
            problem(f"noise.{key}", value, "not available in real time yet", "use 0, or run.pace: lockstep")
            for key in ("broadcast", "link", "loss", "delay")
            if (value := getattr(noise, key))
        ]
        if self.protocol and not self.protocol.linear:
            name = show(self.protocol.info.name)
            lines.append(problem("protocol.name", name, "in real time expected a linear one", "use run.pace: lockstep"))
        return lines

    def require_available(self, purpose: Purpose = "run") -> None:
        """Refuse what this version does not do yet.

        Raises
        ------
        NotAvailableError : lists it
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
        """Whether only its steps are defined, and no law in continuous time."""
        return self.noise.steps_only or self.protocol is not None

    @property
    def width(self) -> int:
        """Numbers of an agent's whole state: one per replica, or as many for each as its protocol has."""
        protocol = self.protocol
        return self.run.replicas * (protocol.info.states if protocol else 1)

    @property
    def truth(self) -> bool:
        """Whether others hear something else than the whole state, which then goes on a topic of its own."""
        protocol = self.protocol
        return self.noise.broadcast > 0 or (protocol is not None and protocol.info.hidden)

    @property
    def leader_gains(self) -> FloatArray:
        """(m,) kappa; 0 for followers, inf for grounded leaders."""
        return _leader_gains(self.leaders, self.agents)

    @property
    def reference(self) -> float:
        """What tracking agents should hold; 0 for consensus."""
        return self.leaders.reference if self.leaders else 0.0

    @property
    def steps(self) -> int:
        """Steps N of a run; it logs the states 0..N."""
        return round(self.run.duration / self.run.dt)

    @property
    def step_length(self) -> float:
        """Simulated time of a step: run.dt, which is 1 in discrete time."""
        return self.run.dt


def json_schema() -> dict[str, Any]:
    """JSON Schema of the experiment file, for editors."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | ExperimentSpec.model_json_schema()


def _leader_gains(leaders: LeadersSpec | None, agents: int) -> FloatArray:
    gains = np.zeros(agents)
    if leaders:
        gains[np.array(leaders.agents) - 1] = leaders.gain
    return gains


class _Sections:
    """A document on its way: each section is None as long as it is not known to be good.

    So a mistake in one section does not hide those in the others.
    """

    def __init__(self, mapping: Mapping[Any, Any], recorded: ProtocolInfo | None = None) -> None:
        self.problems: list[str] = []
        bad: set[str] = set()
        try:
            ExperimentSpec.model_validate(dict(mapping))
        except ValidationError as error:
            self.problems += [translate(detail) for detail in error.errors(include_url=False)]
            bad = {str(detail["loc"][0]) for detail in error.errors(include_url=False)}

        def section(key: str) -> Any:
            if key in bad:
                return None
            info = ExperimentSpec.model_fields[key]
            if key not in mapping:
                return info.get_default(call_default_factory=True, validated_data={})
            annotation: Any = info.annotation
            return TypeAdapter(annotation).validate_python(mapping[key])

        self.values = {key: section(key) for key in ExperimentSpec.model_fields}
        self.known = set(self.values) - bad
        run = self.values["run"]
        if run is not None and self.values["time"] == "discrete" and "dt" not in run.model_fields_set:
            self.values["run"] = run.model_copy(update={"dt": 1.0})
        self.agents: int | None = None
        self.graphs: tuple[Graph, ...] = ()
        self.chain: MarkovChain | None = None
        self.noise_gain: FloatArray | None = None
        self._recorded = recorded
        self._protocol: ChosenProtocol | None = None

    def resolve(self, directory: Path) -> None:
        """Find everything that several keys say together, and every mistake in it."""
        time, run, leaders = self.values["time"], self.values["run"], self.values["leaders"]
        self._find_protocol()
        self._count_agents(directory)
        leaders_good = self.values["problem"] is not None and "leaders" in self.known
        if leaders_good:
            found = validation.leader_problems(self.values["problem"], leaders, self.agents)
            leaders_good = not found
            self.problems += found
        if self.values["graphs"] and self.values["switching"] and time:
            self.chain, found = validation.chain_of(self.values["switching"], list(self.values["graphs"]), time)
            self.problems += found
        whole_steps = False
        if run and time:
            found = validation.run_problems(run, time, self.agents)
            whole_steps = not found
            self.problems += found
        if self.agents is None or not self._fits(run if whole_steps else None):
            return
        if self.values["noise"]:
            names = list(self.values["graphs"])
            self.noise_gain, found = validation.noise_gain_of(self.values["noise"], names, self.agents)
            self.problems += found
        self._build_graphs()
        if not self.graphs or not leaders_good:
            return
        self.problems += validation.connection_problems(self.graphs, leaders)
        built_in = "protocol" in self.known and self.values["protocol"] is None
        if time == "continuous" and run and built_in:
            gains = _leader_gains(leaders, self.agents)
            self.problems += validation.stability_problems(self.graphs, gains, run.dt)

    def experiment(self, source: str) -> Experiment:
        """The experiment, once there are no problems."""
        assert self.chain is not None
        assert self.noise_gain is not None
        spec = ExperimentSpec.model_construct(**(self.values | {"agents": self.agents}))
        experiment = Experiment(spec, self.graphs, self.chain, self.noise_gain, source, self._protocol)
        return self._with_protocol(experiment, self._protocol) if self._protocol else experiment

    def _find_protocol(self) -> None:
        """The protocol and its parameters, with their defaults written out."""
        spec = self.values["protocol"]
        if spec is None:
            return
        self._protocol, found = protocols.find(spec, self._recorded)
        self.problems += found
        if self._protocol and self._protocol.parameters is not None:
            parameters = self._protocol.parameters.model_dump(mode="json")
            self.values["protocol"] = type(spec).model_validate({"name": spec.name, **parameters})

    def _with_protocol(self, experiment: Experiment, protocol: ChosenProtocol) -> Experiment:
        """The same with a protocol that knows its network."""
        bound, found = protocols.bind(protocol, experiment, self._recorded)
        self.problems += found
        experiment = replace(experiment, protocol=bound)
        size = experiment.agents, len(self.graphs), experiment.steps, experiment.width
        self.problems += validation.memory_problems(*size, 0, experiment.truth)
        return experiment

    def _count_agents(self, directory: Path) -> None:
        """The number of agents, once every graph says which it needs; GraphML files are read here."""
        graphs: dict[str, GraphSpec] | None = self.values["graphs"]
        if graphs is None or "agents" not in self.known:
            return
        declared = self.values["agents"]
        largest = 0
        before = len(self.problems)
        for name, spec in list(graphs.items()):
            if name == "stationary":
                wanted = "expected another name, since switching.initial uses this one"
                self.problems.append(problem("graphs", "'stationary'", wanted, "rename the graph"))
            if len(spec.kinds) != 1:
                given = " and ".join(spec.kinds) or "nothing"
                wanted = f"expected one of {', '.join(GraphSpec.model_fields)}"
                self.problems.append(problem(f"graphs.{name}", given, wanted, "give exactly one"))
            elif spec.graphml is not None:
                resolved, count, found = topology.read_graphml(name, directory / spec.graphml)
                graphs[name] = resolved
                largest = max(largest, count)
                self.problems += found
            else:
                largest = max(largest, topology.largest_label(spec))
        if len(self.problems) > before:
            return
        untold = all(spec.complete or spec.star for spec in graphs.values())
        if declared is None and (untold or largest < 2):
            wanted = "expected the number of agents, since no graph tells it"
            self.problems.append(problem("agents", "missing", wanted, "for example agents: 5"))
        else:
            self.agents = declared or largest

    def _fits(self, run: RunSpec | None) -> bool:
        assert self.agents is not None
        steps = round(run.duration / run.dt) if run else 1
        replicas = run.replicas if run else 1
        noise = self.values["noise"]
        delay, truth = (noise.delay, noise.broadcast > 0) if noise else (0, False)
        modes = len(self.values["graphs"])
        found = validation.memory_problems(self.agents, modes, steps, replicas, delay, truth)
        self.problems += found
        return not found

    def _build_graphs(self) -> None:
        assert self.agents is not None
        graphs: dict[str, GraphSpec] = self.values["graphs"]
        found = [line for name, spec in graphs.items() for line in topology.link_problems(name, spec, self.agents)]
        self.problems += found
        if not found:
            self.graphs = tuple(topology.build_graph(name, spec, self.agents) for name, spec in graphs.items())
