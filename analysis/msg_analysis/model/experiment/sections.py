# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Checks of a document, section by section and then together, so that every mistake is reported at once."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from msg_analysis.common.text.number_words import listed
from msg_analysis.model.experiment import graph_sources, memory, protocol_binding, topology, validation
from msg_analysis.model.experiment.graph_sources import ForeignGraph, GraphError, is_networkx
from msg_analysis.model.experiment.problems import problem, show, translate
from msg_analysis.model.experiment.protocol_binding import ChosenProtocol, ProtocolInfo
from msg_analysis.model.network.graphs import Graph
from msg_analysis.model.network.markov_chain import MarkovChain, Time
from msg_analysis.model.spec.document import ExperimentSpec
from msg_analysis.model.spec.graphs import GraphSpec
from msg_analysis.model.spec.noise import NoiseSpec
from msg_analysis.model.spec.run import RunSpec
from msg_analysis.types import FloatArray


@functools.cache
def _adapter(key: str) -> TypeAdapter[Any]:
    """The validator of one section; cached, since making it takes longer than using it."""
    annotation: Any = ExperimentSpec.model_fields[key].annotation
    return TypeAdapter(annotation)


def _section(key: str, mapping: Mapping[Any, Any]) -> Any:
    """One valid section of a document with mistakes in others."""
    if key in mapping:
        return _adapter(key).validate_python(mapping[key])
    return ExperimentSpec.model_fields[key].get_default(call_default_factory=True, validated_data={})


def _graphs_of_networkx(mapping: Mapping[Any, Any]) -> tuple[dict[str, Any], Mapping[Any, Any]]:
    """The graphs of networkx in a document, by name, and the document with empty graphs in their places."""
    graphs = mapping.get("graphs")
    if not isinstance(graphs, Mapping):
        return {}, mapping
    found = {name: graph for name, graph in graphs.items() if is_networkx(graph)}
    if not found:
        return {}, mapping
    return found, {**mapping, "graphs": {**graphs, **{name: {"edges": []} for name in found}}}


class Sections:
    """A document that is being checked: a section is None as long as it is not known to be valid.

    ``recorded``: protocol of a recorded run, which need not be installed.
    """

    def __init__(self, mapping: Mapping[Any, Any], recorded: ProtocolInfo | None = None) -> None:
        self.problems: list[str] = []
        self._networkx, mapping = _graphs_of_networkx(mapping)
        self._foreign: dict[str, ForeignGraph] = {}  # read, but not numbered yet
        self._named_by_files = False
        self.keys: dict[str, str] = {}  # of the graphs, for messages
        bad: set[str] = set()
        try:
            spec = ExperimentSpec.model_validate(dict(mapping))
            self.values = {key: getattr(spec, key) for key in ExperimentSpec.model_fields}
        except ValidationError as error:
            self.problems += [translate(detail) for detail in error.errors(include_url=False)]
            bad = {str(detail["loc"][0]) for detail in error.errors(include_url=False)}
            self.values = {key: None if key in bad else _section(key, mapping) for key in ExperimentSpec.model_fields}
        self.known = set(self.values) - bad
        run = self.values["run"]
        if run is not None and self.values["time"] == "discrete" and "dt" not in run.model_fields_set:
            self.values["run"] = run.model_copy(update={"dt": 1.0})
        self.agents: int | None = None
        self.graphs: tuple[Graph, ...] = ()
        self.chain: MarkovChain | None = None
        self.noise_gain: FloatArray | None = None
        self.loss: FloatArray | None = None
        self._recorded = recorded
        self.protocol: ChosenProtocol | None = None

    def resolve(self, directory: Path) -> None:
        """Check what several keys say together; paths in the document are relative to ``directory``."""
        time, run = self.values["time"], self.values["run"]
        self._find_protocol()
        self._count_agents(directory)
        self._name_leaders()
        leaders = self.values["leaders"]
        leaders_good = self.values["problem"] is not None and "leaders" in self.known
        if leaders_good:
            found = validation.leader_problems(self.values["problem"], leaders, self.agents, self.values["names"])
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
        self.problems += validation.connection_problems(self.graphs, leaders, self.values["names"])
        if self.values["noise"] and time:
            self._resolve_losses(self.values["noise"], time)
        built_in = "protocol" in self.known and self.values["protocol"] is None
        if time == "continuous" and run and built_in:
            gains = validation.leader_gains(leaders, self.agents)
            self.problems += validation.stability_problems(self.graphs, gains, run.dt)

    def spec(self) -> ExperimentSpec:
        """The whole document with everything resolved. Only valid once there are no problems."""
        return ExperimentSpec.model_construct(**(self.values | {"agents": self.agents}))

    def _find_protocol(self) -> None:
        """The protocol and its parameters, with their defaults written out."""
        spec = self.values["protocol"]
        if spec is None:
            return
        self.protocol, found = protocol_binding.find(spec, self._recorded)
        self.problems += found
        if self.protocol and self.protocol.parameters is not None:
            parameters = self.protocol.parameters.model_dump(mode="json")
            self.values["protocol"] = type(spec).model_validate({"name": spec.name, **parameters})

    def _count_agents(self, directory: Path) -> None:
        """The number of agents and their names, if every graph is valid; files with graphs are read here."""
        graphs: dict[str, GraphSpec] | None = self.values["graphs"]
        if graphs is None or not {"agents", "names"} <= self.known:
            return
        before = len(self.problems)
        for name, spec in graphs.items():
            if name == "stationary":
                wanted = "expected another name, since switching.initial uses this one"
                self.problems.append(problem("graphs", "'stationary'", wanted, "rename the graph"))
            if len(spec.kinds) != 1:
                given = " and ".join(spec.kinds) or "nothing"
                wanted = f"expected one of {', '.join(GraphSpec.model_fields)}"
                self.problems.append(problem(f"graphs.{name}", given, wanted, "give exactly one"))
                continue
            self.keys[name] = key = f"graphs.{name}" if name in self._networkx else f"graphs.{name}.{spec.kinds[0]}"
            try:
                self._read(name, key, spec, directory)
            except GraphError as error:
                self.problems.append(str(error))
        if len(self.problems) > before or not self._number_nodes(graphs):
            return
        declared, names = self.values["agents"], self.values["names"]
        largest = max(map(topology.largest_label, graphs.values()))
        untold = all(spec.complete or spec.star for spec in graphs.values())
        if declared is None and names is None and (untold or largest < 2):
            wanted = "expected the number of agents, since the graphs do not give it"
            self.problems.append(problem("agents", "missing", wanted, "for example agents: 5"))
        elif names is not None and len(names) != (declared or max(largest, len(names))):
            shown = f"{len(names)} names" if len(names) > 1 else "1 name"
            whose = " from the files of the graphs" if self._named_by_files else ""
            wanted = f"expected one for each of the {declared or largest} agents"
            self.problems.append(problem("names", shown + whose, wanted, "name the others, or correct `agents`"))
        else:
            self.agents = declared or (len(names) if names else largest)

    def _read(self, name: str, key: str, spec: GraphSpec, directory: Path) -> None:
        """Read a graph that is not given by numbers of agents. GraphError: its mistake."""
        if name in self._networkx:
            self._foreign[name] = graph_sources.from_networkx(key, self._networkx[name])
        elif spec.graphml is not None:
            self._foreign[name] = graph_sources.read_graphml(key, directory / spec.graphml)
        elif spec.csv is not None:
            self._foreign[name] = graph_sources.read_csv(key, directory / spec.csv)
        elif spec.adjacency is not None:
            self.values["graphs"][name] = graph_sources.from_adjacency(key, spec.adjacency)

    def _number_nodes(self, graphs: dict[str, GraphSpec]) -> bool:
        """Numbers instead of nodes in ``graphs``, and the names of the agents; False where these have mistakes."""
        given: list[str] | None = self.values["names"]
        twice = sorted({name for name in given or [] if (given or []).count(name) > 1})
        if twice:
            self.problems.append(problem("names", show(twice[0]), "expected different names", "rename one"))
            return False
        if not self._foreign:
            return True
        try:
            numbers, names = graph_sources.numbered(self._foreign.values(), given)
        except KeyError as error:
            wanted = f"expected one of the names {listed(given or [])}"
            place = next(self.keys[name] for name, graph in self._foreign.items() if error.args[0] in graph.nodes)
            self.problems.append(
                problem(place, f"node {show(error.args[0])}", wanted, "correct it, or add it to `names`")
            )
            return False
        graphs |= {name: graph_sources.as_spec(graph, numbers) for name, graph in self._foreign.items()}
        self._named_by_files = given is None
        self.values["names"] = names
        return True

    def _name_leaders(self) -> None:
        """Numbers instead of names in ``leaders``; what is not a name of an agent is a mistake."""
        leaders = self.values["leaders"]
        if leaders is None or not any(isinstance(agent, str) for agent in leaders.agents):
            return
        names: list[str] = self.values["names"] or []
        numbers = [names.index(agent) + 1 if agent in names else agent for agent in leaders.agents]
        unknown = [agent for agent in numbers if isinstance(agent, str)]
        if unknown and self.agents is not None:
            wanted = (
                f"expected one of the names {listed(names)}" if names else "expected a number, since no agent is named"
            )
            self.problems += [problem("leaders.agents", show(agent), wanted, "correct it") for agent in unknown]
        known = [agent for agent in numbers if not isinstance(agent, str)]
        self.values["leaders"] = leaders.model_copy(update={"agents": known})
        if unknown:
            self.known.discard("leaders")

    def _resolve_losses(self, noise: NoiseSpec, time: Time) -> None:
        """Numbers instead of names in ``noise.loss``, and the probability of every link."""
        names: list[str] | None = self.values["names"]
        loss, found = topology.numbered_losses(noise.loss, names)
        if not found:
            self.values["noise"] = noise.model_copy(update={"loss": loss})
            self.loss, found = topology.loss_matrix(loss, self.graphs, time, names)
        self.problems += found
        if noise.burst is not None and not found:
            self.problems += validation.burst_problems(noise.burst, loss)

    def _fits(self, run: RunSpec | None) -> bool:
        assert self.agents is not None
        steps = run.steps if run else 1
        replicas = run.replicas if run else 1
        noise = self.values["noise"]
        delay, truth = (noise.delay, noise.broadcast > 0) if noise else (0, False)
        modes = len(self.values["graphs"])
        found = memory.memory_problems(self.agents, modes, steps, replicas, delay, truth)
        self.problems += found
        return not found

    def _build_graphs(self) -> None:
        assert self.agents is not None
        graphs: dict[str, GraphSpec] = self.values["graphs"]
        names: list[str] | None = self.values["names"]
        found = [
            line
            for name, spec in graphs.items()
            for line in topology.link_problems(self.keys[name], spec, self.agents, names)
        ]
        self.problems += found
        if not found:
            self.graphs = tuple(topology.build_graph(name, spec, self.agents) for name, spec in graphs.items())
