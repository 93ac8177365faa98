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

"""The experiment file as data: every key, its type, its default and what it means.

Only what one value can tell by itself is checked here; what needs several keys is checked in ``experiment.validation``.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from msg_analysis.model.spec.graphs import GraphSpec, SwitchingSpec
from msg_analysis.model.spec.noise import NoiseSpec
from msg_analysis.model.spec.run import LeadersSpec, ProtocolSpec, RunSpec
from msg_analysis.model.spec.values import AgentName, GraphName, Section

Purpose = Literal["predict", "run"]


class ExperimentSpec(Section):
    """A Markov switching network and a run of it."""

    name: str = Field(
        pattern="^[a-z][a-z0-9_]*$",
        description="a name for bags and topics, [a-z][a-z0-9_]*",
        examples=["line_ring"],
    )
    problem: Literal["consensus", "tracking"] = Field(
        "consensus", description="agree with each other, or follow leaders", examples=["consensus"]
    )
    time: Literal["continuous", "discrete"] = Field(
        "continuous",
        description="continuous: Euler steps of run.dt; discrete: W = exp(-Z), one step = 1",
        examples=["continuous"],
    )
    agents: Annotated[int, Field(strict=True, ge=2)] | None = Field(
        None, description="number of agents; by default the largest number in any graph", examples=[5]
    )
    names: list[AgentName] | None = Field(
        None,
        min_length=2,
        description="names of the agents in the order of their numbers, shown instead of these; by default those of "
        "the nodes in graph files",
        examples=[["north", "south"]],
    )
    graphs: dict[GraphName, GraphSpec] = Field(
        min_length=1,
        description="named graphs; their order is the order of the modes",
        examples=[{"line": {"path": [1, 2, 3]}}],
    )
    switching: SwitchingSpec = Field(
        default_factory=SwitchingSpec, examples=[{"generator": [[-0.5, 0.5], [0.5, -0.5]]}]
    )
    noise: NoiseSpec = Field(default_factory=NoiseSpec, examples=[{"process": 1.0}])
    protocol: ProtocolSpec | None = Field(
        None,
        description="what agents do, from an installed package, with parameters of its own; default: the built-in law",
        examples=[{"name": "metropolis"}],
    )
    leaders: LeadersSpec | None = Field(None, examples=[{"agents": [3], "gain": 1.0, "reference": 0.0}])
    run: RunSpec = Field(default_factory=RunSpec, examples=[{"dt": 0.05, "duration": 400}])
