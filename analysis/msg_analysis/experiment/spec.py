# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The keys of the experiment file: every key, its type, its default and what it means.

Only what one value can tell by itself is checked here; ``validation`` checks what needs several keys.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import PydanticCustomError

from msg_analysis.experiment.values import (
    LARGEST_COUNT,
    Agent,
    AgentName,
    Count,
    End,
    GraphName,
    Loss,
    LossSpec,
    Matrix,
    NonNegative,
    Number,
    Positive,
    Rate,
    Section,
    WrittenLink,
    expected,
    is_agent,
    is_count,
    is_number,
    parts,
)


def _link(value: object) -> WrittenLink:
    wanted = "[agent, agent] or [agent, agent, weight], agents by number from 1 or name, the weight a number > 0"
    first, second, weight = (*parts(value, (2, 3), wanted), 1.0)[:3]
    if not is_number(weight) or weight <= 0:
        raise expected("a weight > 0 as the third entry")
    return (first, second, float(weight))


def _grid(value: object) -> object:
    sizes = value if isinstance(value, list | tuple) else ()
    if len(sizes) != 2 or not all(is_count(size) for size in sizes):
        raise expected("[rows, columns], two whole numbers >= 1")
    return value


_WrittenLinks = tuple[End, End] | tuple[End, End, Positive]
Links = list[Annotated[WrittenLink, BeforeValidator(_link, json_schema_input_type=_WrittenLinks)]]


class Star(Section):
    """A star: every agent is connected with the centre."""

    center: Agent = Field(description="the agent in the middle", examples=[1])


def _matrix(value: object, rows: ValidatorFunctionWrapHandler) -> Any:
    """The rows of a matrix, or the name of a file with them."""
    if isinstance(value, str):
        if value.endswith(MATRIX_FILES):
            return value
        raise expected("a square matrix, or a file .csv or .npy with one")
    return rows(value)


MATRIX_FILES = (".csv", ".npy")
Rows = Annotated[list[list[NonNegative]], Field(min_length=2)]


BESIDE = {"weight": ("path", "cycle", "star", "grid", "complete"), "parallel": ("graphml", "csv")}
"""Keys of a graph that may stand beside some of its kinds."""


class GraphSpec(Section):
    """One graph, given in one of these ways. Agents are numbered from 1, or have names."""

    model_config = ConfigDict(json_schema_extra={"minProperties": 1, "maxProperties": 2})

    path: list[Agent] | None = Field(None, min_length=2, description="agents along a line", examples=[[1, 2, 3]])
    cycle: list[Agent] | None = Field(None, min_length=3, description="agents around a ring", examples=[[1, 2, 3]])
    edges: Links | None = Field(
        None, description="undirected: [i, j] or [i, j, weight], weight 1 by default", examples=[[[1, 2], [2, 3, 0.5]]]
    )
    arcs: Links | None = Field(
        None,
        description="directed: [1, 2, 0.5] means that agent 2 listens to agent 1",
        examples=[[[1, 2], [2, 3, 0.5]]],
    )
    star: Star | None = Field(None, description="a star with its centre", examples=[{"center": 1}])
    complete: Literal[True] | None = Field(None, description="every agent with every other agent", examples=[True])
    grid: Annotated[tuple[Count, Count], BeforeValidator(_grid)] | None = Field(
        None, description="[rows, columns], agents row by row", examples=[[3, 4]]
    )
    graphml: str | None = Field(
        None,
        min_length=1,
        description="a GraphML file, relative to the experiment file; nodes are called by their names, labels or ids: "
        "whole numbers from 1 or 0 are the agents' numbers, others names; edge attribute 'weight', default 1",
        examples=["network.graphml"],
    )
    csv: str | None = Field(
        None,
        min_length=1,
        description="a CSV file, relative to the experiment file, with the columns source,target[,weight][,type], or "
        "from,to; target listens to source; nodes as with graphml; type directed (default) or undirected",
        examples=["edges.csv"],
    )
    adjacency: Annotated[Rows, WrapValidator(_matrix, json_schema_input_type=Rows | str)] | None = Field(
        None,
        description="square matrix: row i has the weights with which agent i listens to the others, 0: not at all; or "
        "a file with it, .csv or .npy, relative to the experiment file",
        examples=[[[0, 1], [1, 0]]],
    )
    weight: Positive | None = Field(
        None, description="of all links of path, cycle, star, grid or complete; 1 by default", examples=[0.5]
    )
    parallel: Literal["sum", "first"] | None = Field(
        None,
        description="with graphml or csv: parallel links are one, with the sum of their weights or with the first; by "
        "default they are an error",
        examples=["sum"],
    )

    @property
    def kinds(self) -> list[str]:
        """Ways in which this graph is given (one, in a valid file)."""
        given = [key for key in type(self).model_fields if getattr(self, key) is not None]
        return [key for key in given if key not in BESIDE]


class ErlangSpec(Section):
    """Holding times that are sums of exponential ones; in discrete time of geometric ones."""

    shape: Count = Field(description="how many of them; the larger, the more alike are the holding times", examples=[3])


class LinksSpec(Section):
    """Links that switch independently of each other: each of them is up or down, a Markov chain of its own."""

    up: Rate = Field(description="rate at which a link that is down comes up; a number, or by link", examples=[2.0])
    down: Rate = Field(description="rate at which a link that is up goes down; a number, or by link", examples=[0.5])


class SwitchingSpec(Section):
    """What switches the graphs: a chain, links by themselves, or a schedule. May be left out with one graph."""

    generator: Matrix | None = Field(
        None, description="continuous time: rates in file order; rows sum to 0", examples=[[[-0.5, 0.5], [0.5, -0.5]]]
    )
    rates: dict[str, dict[str, NonNegative]] | None = Field(
        None, description="continuous time: rates by name, from: {to: rate}", examples=[{"line": {"ring": 1.0}}]
    )
    scale: Positive = Field(1.0, description="multiplies the rates", examples=[0.5])
    transition: Matrix | None = Field(
        None, description="discrete time: probabilities; rows sum to 1", examples=[[[0.9, 0.1], [0.2, 0.8]]]
    )
    sojourn: dict[GraphName, ErlangSpec] | None = Field(
        None,
        min_length=1,
        description="graphs whose holding times are Erlang and not exponential, with the same means",
        examples=[{"line": {"shape": 3}}],
    )
    initial: str = Field("stationary", description="'stationary' or a graph's name", examples=["stationary"])
    links: LinksSpec | None = Field(
        None,
        description="instead of a chain: the links of the one graph switch independently; in discrete time the values "
        "are probabilities of a step",
        examples=[{"up": 2.0, "down": 0.5}],
    )
    schedule: list[tuple[NonNegative, GraphName]] | None = Field(
        None, min_length=1, description="instead of a chain: when each graph begins", examples=[[[0, "line"]]]
    )
    end: Positive | None = Field(None, description="when the last graph ends; by default with the run", examples=[10])
    repeat: bool | None = Field(None, description="whether the schedule then begins again", examples=[True])
    trace: str | None = Field(
        None,
        min_length=1,
        description="a CSV file of contacts, intervals, positions or times of graphs; or a bag with positions",
        examples=["c.csv"],
    )
    map: str | None = Field(
        None,
        min_length=1,
        description="of a trace that is a bag: file that says where in it the positions are",
        examples=["map.yaml"],
    )
    hold: Positive | None = Field(None, description="how long a contact, position or last graph is valid", examples=[1])
    radius: Positive | None = Field(None, description="distance up to which agents are linked", examples=[2.5])
    undirected: bool | None = Field(None, description="whether the source of a link listens, too", examples=[True])
    weight: Positive | None = Field(None, description="multiplies the weights of all links", examples=[0.2])


LARGEST_BURST = 1e6  # messages: what an agent that restarts has to draw again grows with it
NoiseGain = float | list[float] | list[list[float]]


def _process(value: object) -> NoiseGain | dict[str, NoiseGain]:
    if not isinstance(value, dict):
        return _noise_gain(value)
    gains, faults = {}, []
    for name, gain in value.items():
        try:
            gains[str(name)] = _noise_gain(gain)
        except PydanticCustomError as error:
            faults.append(f"for graph {name} {error.message().removeprefix('expected ')}")
    if faults:
        raise expected(" and ".join(faults))
    return gains


def _noise_gain(value: object) -> NoiseGain:
    if is_number(value):
        if value < 0:
            raise expected("a standard deviation >= 0")
        return float(value)
    if isinstance(value, list) and value and all(is_number(entry) for entry in value):
        if min(value) < 0:
            raise expected("standard deviations >= 0")
        return [float(entry) for entry in value]
    rows = value if isinstance(value, list) else []
    if rows and all(isinstance(row, list) and all(is_number(entry) for entry in row) for row in rows):
        return [[float(entry) for entry in row] for row in rows]
    raise expected("a finite number, one per agent, or a square matrix F (Q = F F^T)")


_Gain = NonNegative | list[NonNegative] | Matrix


class NoiseSpec(Section):
    """What is random besides the graphs."""

    process: Annotated[
        NoiseGain | dict[str, NoiseGain],
        PlainValidator(_process, json_schema_input_type=_Gain | dict[GraphName, _Gain]),
    ] = Field(
        1.0,
        description="noise gain: a number, one per agent, or the matrix F with Q = F F^T; or one of these for every "
        "graph by name",
        examples=[1.0],
    )
    broadcast: NonNegative = Field(0.0, description="standard deviation added to each published value", examples=[0.0])
    link: NonNegative = Field(0.0, description="standard deviation added by each receiver", examples=[0.0])
    loss: Loss = Field(
        LossSpec(), description="probability that a directed message is lost; a number, or by link", examples=[0.0]
    )
    on_loss: Literal["own", "hold"] = Field(
        "own",
        description="what an agent uses in place of a lost value: its own, or the last value that it heard",
        examples=["hold"],
    )
    burst: Annotated[Number, Field(ge=1, le=LARGEST_BURST)] | None = Field(
        None,
        description="mean number of messages of a link that are lost in a row; by default losses are independent",
        examples=[5],
    )
    whole_link: bool | None = Field(
        None,
        description="whether a loss takes both directions of a link; by default each direction by itself",
        examples=[True],
    )
    activation: Annotated[Number, Field(gt=0, le=1)] | None = Field(
        None,
        description="probability that an agent makes its step; else it keeps its state, without noise; by default 1",
        examples=[0.7],
    )
    delay: Annotated[int, Field(strict=True, ge=0, le=LARGEST_COUNT)] = Field(
        0, description="age, in steps, of the values of others that a step uses", examples=[0]
    )

    @property
    def on_air(self) -> bool:
        """Whether there is broadcast noise, link noise or loss between the agents."""
        return bool(self.broadcast or self.link or self.loss.any)

    @property
    def holds(self) -> bool:
        """Whether messages can be lost, and the last value heard takes the place of a lost one."""
        return self.loss.any and self.on_loss == "hold"

    @property
    def sure_messages(self) -> int:
        """Steps at the beginning that say nothing about losses: those that use the message with x(0) but the last.

        Where values are held it is never lost, so the last does not either.
        """
        return self.delay + (1 if self.holds else 0)

    @property
    def on_messages(self) -> bool:
        """Whether messages are noisy, lost or late."""
        return self.on_air or self.delay > 0

    @property
    def leaves_out_steps(self) -> bool:
        """Whether agents leave out steps."""
        return self.activation not in (None, 1.0)

    @property
    def steps_only(self) -> bool:
        """Whether there is noise on the air, loss, delay or activation, which only steps can have."""
        return self.on_messages or self.leaves_out_steps


def _start(value: object) -> str | list[float] | dict[int | str, float]:
    if isinstance(value, str) and value in ("stationary", "zero"):
        return value
    if isinstance(value, list) and all(is_number(entry) for entry in value):
        return [float(entry) for entry in value]
    if isinstance(value, dict) and value and all(map(is_agent, value)) and all(map(is_number, value.values())):
        return {agent: float(entry) for agent, entry in value.items()}
    raise expected("'stationary', 'zero' or a list of one finite number per agent, or numbers by agent")


def _processes(value: object) -> str | int:
    if isinstance(value, str) and value in ("auto", "one_per_agent"):
        return value
    if isinstance(value, int) and is_count(value):
        return value
    raise expected("'auto', 'one_per_agent' or a whole number >= 1")


def _gain(value: object) -> float:
    if value in ("inf", ".inf") or (isinstance(value, float) and value == math.inf):
        return math.inf
    if is_number(value) and value > 0:
        return float(value)
    raise expected("a number > 0, or inf for leaders held at the reference")


class LeadersSpec(Section):
    """The agents that know the reference (tracking only)."""

    agents: list[Agent] = Field(min_length=1, description="the leaders, by number or name", examples=[[3]])
    gain: Annotated[
        float,
        PlainValidator(_gain, json_schema_input_type=Positive | Literal["inf"]),
        PlainSerializer(lambda gain: "inf" if math.isinf(gain) else gain, return_type=Any),
    ] = Field(1.0, description="pull towards the reference; inf = held at it", examples=[1.0])
    reference: Number = Field(0.0, description="the value to track", examples=[0.0])


class ProtocolSpec(Section):
    """A law of agents that a package offers, instead of the built-in one. Keys next to its name are its parameters."""

    model_config = ConfigDict(frozen=True, extra="allow")

    name: str = Field(min_length=1, description="the name under which the package offers it", examples=["metropolis"])


class RunSpec(Section):
    """How long, how often and how to run."""

    dt: Positive = Field(
        0.05, description="simulated time of a step; 0.05 by default, always 1 in discrete time", examples=[0.05]
    )
    duration: Positive = Field(100.0, description="simulated time units, a whole number of steps", examples=[400.0])
    replicas: Count = Field(1, description="independent copies of every state under the same graphs", examples=[16])
    seed: Annotated[int, Field(strict=True, ge=0)] = Field(
        0, description="of everything random in the run", examples=[7]
    )
    start: Annotated[
        str | list[float] | dict[int | str, float],
        PlainValidator(
            _start, json_schema_input_type=Literal["stationary", "zero"] | list[Number] | dict[AgentName, Number]
        ),
    ] = Field(
        "stationary",
        description="'stationary', 'zero', one value per agent, or values by agent (others 0)",
        examples=["stationary"],
    )
    pace: Literal["lockstep", "realtime"] = Field(
        "lockstep",
        description="lockstep: as fast as it goes, deterministic; realtime: every agent on its own timer",
        examples=["lockstep"],
    )
    speed: Positive = Field(1.0, description="realtime: simulated time units per second of the clock", examples=[1.0])
    delivery: Literal["reliable", "best_effort"] | None = Field(
        None,
        description="realtime: how agents hear each other. best_effort, the default: what is lost is not sent again; "
        "reliable: it is, and later values wait for it. In lockstep always reliable",
        examples=["best_effort"],
    )
    processes: Annotated[
        str | int, PlainValidator(_processes, json_schema_input_type=Literal["auto", "one_per_agent"] | Count)
    ] = Field("auto", description="'auto', 'one_per_agent' or a number of processes", examples=["auto"])
    external: list[Agent] | None = Field(
        None, min_length=1, description="agents that are programs or robots of yours, by number or name", examples=[[3]]
    )
    publish: list[Literal["pose"]] | None = Field(
        None,
        min_length=1,
        description="what agents publish for programs of yours, beside their states. pose: "
        "geometry_msgs/msg/PoseStamped on agent_<i>/pose, with x = the state",
        examples=[["pose"]],
    )
    frame: str | None = Field(None, min_length=1, description="frame of the poses, by default map", examples=["odom"])

    @property
    def steps(self) -> int:
        """Number of steps."""
        return round(self.duration / self.dt)


Purpose = Literal["predict", "steady", "run"]


class ExperimentSpec(Section):
    """A Markov switching network and a run of it."""

    name: str = Field(
        pattern="^[a-z][a-z0-9_]*$", description="a name for bags and topics, [a-z][a-z0-9_]*", examples=["line_ring"]
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
        {},
        description="named graphs; their order is the order of the modes. None with a trace that has them",
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


def json_schema() -> dict[str, Any]:
    """JSON Schema of the experiment file, for editors."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | ExperimentSpec.model_json_schema()
