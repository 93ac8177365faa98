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

from msg_analysis.model.experiment import memory, protocol_binding, topology, validation
from msg_analysis.model.experiment.problems import problem, translate
from msg_analysis.model.experiment.protocol_binding import ChosenProtocol, ProtocolInfo
from msg_analysis.model.experiment.spec import ExperimentSpec, GraphSpec, RunSpec
from msg_analysis.model.network.graphs import Graph
from msg_analysis.model.network.markov_chain import MarkovChain
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


class Sections:
    """A document that is being checked: a section is None as long as it is not known to be valid.

    ``recorded``: protocol of a recorded run, which need not be installed.
    """

    def __init__(self, mapping: Mapping[Any, Any], recorded: ProtocolInfo | None = None) -> None:
        self.problems: list[str] = []
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
        self._recorded = recorded
        self.protocol: ChosenProtocol | None = None

    def resolve(self, directory: Path) -> None:
        """Check what several keys say together; paths in the document are relative to ``directory``."""
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
        """The number of agents, if every graph is valid; GraphML files are read here."""
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
            wanted = "expected the number of agents, since the graphs do not give it"
            self.problems.append(problem("agents", "missing", wanted, "for example agents: 5"))
        else:
            self.agents = declared or largest

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
        found = [line for name, spec in graphs.items() for line in topology.link_problems(name, spec, self.agents)]
        self.problems += found
        if not found:
            self.graphs = tuple(topology.build_graph(name, spec, self.agents) for name, spec in graphs.items())
