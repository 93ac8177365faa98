# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Links, or steps of agents, that are there or not independently of each other, and the graphs that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from msg_analysis.arithmetic.reproducible import Stream, generator
from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.common.text import agent_name
from msg_analysis.experiment.graphs import Graph
from msg_analysis.experiment.markov_chain import (
    DrawnSchedule,
    MarkovChain,
    Schedule,
    SemiMarkovChain,
    SojournSchedule,
    Time,
)
from msg_analysis.experiment.problems import problem, show
from msg_analysis.experiment.spec import LinksSpec, NoiseSpec, RunSpec, SwitchingSpec
from msg_analysis.experiment.values import RateSpec

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment


@dataclass(frozen=True, eq=False)
class IndependentLinks:
    """The law of E links, each of which is up or down, a Markov chain of its own (Gilbert 1960).

    Attributes
    ----------
    mesh
        the graph in which all links are up, with l arcs
    link_of
        (l,) link of every arc, from 0; the two arcs of agents that hear each other with one weight are one link
    up, down
        (E,) rates [1 / unit of time] at which a link that is down comes up, and the reverse; in discrete time
        probabilities of a step
    time, dt
        of these; simulated time of a step
    """

    mesh: Graph
    link_of: IntArray
    up: FloatArray
    down: FloatArray
    time: Time
    dt: float

    noun: ClassVar[str] = "link"

    def __len__(self) -> int:
        return len(self.up)

    @cached_property
    def ends(self) -> list[tuple[int, int, bool]]:
        """Of every link, the agents (from 0) source and target, and whether both hear each other."""
        found: dict[int, tuple[int, int, bool]] = {}
        arcs = zip(self.link_of.tolist(), self.mesh.sources.tolist(), self.mesh.targets.tolist(), strict=True)
        for link, source, target in arcs:
            twice = link in found
            found[link] = (min(source, target), max(source, target), True) if twice else (source, target, False)
        return [found[link] for link in range(len(self))]

    def words(self, link: int, names: Sequence[str] | None) -> str:
        """A link in words."""
        source, target, both = self.ends[link]
        return ("-" if both else " to ").join(agent_name(agent + 1, names) for agent in (source, target))

    def to_json(self) -> list[dict[str, Any]]:
        """What ``info`` says of each link."""
        rows = zip(self.ends, self.up.tolist(), self.down.tolist(), self.shares.tolist(), strict=True)
        return [
            {"agents": [source + 1, target + 1], "directed": not both, "up": up, "down": down, "share": share}
            for (source, target, both), up, down, share in rows
        ]

    def chain(self, link: int) -> MarkovChain:
        """The chain of one link: state 0 is down, 1 is up."""
        up, down = float(self.up[link]), float(self.down[link])
        if self.time == "discrete":
            return MarkovChain("discrete", np.array([[1.0 - up, up], [down, 1.0 - down]]))
        return MarkovChain("continuous", np.array([[-up, up], [down, -down]]))

    @cached_property
    def _steps(self) -> FloatArray:
        """(E, 2) probabilities of a step that a link that is down comes up, and the reverse."""
        chains = [self.chain(link) for link in range(len(self))]
        steps = [chain.matrix if self.time == "discrete" else chain.sampled(self.dt).matrix for chain in chains]
        return np.array([[step[0, 1], step[1, 0]] for step in steps])

    @property
    def rise(self) -> FloatArray:
        """(E,) probability that a link that is down is up a step later."""
        return np.asarray(self._steps[:, 0])

    @property
    def fall(self) -> FloatArray:
        """(E,) the reverse."""
        return np.asarray(self._steps[:, 1])

    @property
    def shares(self) -> FloatArray:
        """(E,) of time in which each link is up."""
        return np.asarray(self.up / (self.up + self.down))

    def graph(self, there: BoolArray) -> Graph:
        """The graph in which the links ``there`` (E,) are up; its name has a digit for every link."""
        arcs = there[self.link_of]
        name = "".join(map(str, there.astype(int).tolist()))
        mesh = self.mesh
        return Graph(name, mesh.agents, mesh.targets[arcs], mesh.sources[arcs], mesh.weights[arcs])

    def logged(self, name: str, arcs: Sequence[tuple[int, int, float]]) -> Graph:
        """A graph as a message describes it."""
        return Graph.of_arcs(name, self.mesh.agents, arcs)

    def _there(self, graph: Graph, found: IntArray) -> BoolArray:
        """(E,) which links are up in a graph; ``found``: the links of its arcs, E for one of no link."""
        del graph
        return np.bincount(found, minlength=len(self) + 1)[:-1] > 0

    def schedule(self, graphs: Sequence[Graph], starts: FloatArray, order: IntArray) -> LinkSchedule:
        """A path of graphs, of which it looks up the links."""
        number = np.full((self.mesh.agents, self.mesh.agents), len(self))
        number[self.mesh.targets, self.mesh.sources] = self.link_of
        there, foreign = np.zeros((len(graphs), len(self)), dtype=np.bool_), {}
        for mode, graph in enumerate(graphs):
            found = number[graph.targets, graph.sources]
            there[mode] = self._there(graph, found)
            for arc in np.flatnonzero(found == len(self))[:1].tolist():
                foreign[mode] = int(graph.sources[arc]), int(graph.targets[arc])
        return LinkSchedule(starts, order, len(graphs), np.inf, False, self, there, foreign)

    def drawn(self, seed: int, steps: int) -> tuple[list[Graph], LinkSchedule]:
        """The graphs of a run, numbered in the order in which they come, and when each of them is active."""
        there = np.empty((steps, len(self)), dtype=np.bool_)
        for link, ((rise, fall), share) in enumerate(zip(self._steps.tolist(), self.shares.tolist(), strict=True)):
            random = generator(seed, Stream.SWITCHING, link)
            there[:, link] = _path(rise, fall, share, steps, random)
        changes = np.append(0, 1 + np.flatnonzero((there[1:] != there[:-1]).any(axis=1)))
        numbers: dict[bytes, int] = {}
        order = [numbers.setdefault(row.tobytes(), len(numbers)) for row in there[changes]]
        graphs = [self.graph(np.frombuffer(row, dtype=np.bool_)) for row in numbers]
        return graphs, self.schedule(graphs, changes * self.dt, np.array(order))

    def product(self) -> tuple[list[Graph], MarkovChain]:
        """All 2^E graphs, and the chain between them, exactly."""
        states = 2 ** len(self)
        there = np.arange(states)[:, None] >> np.arange(len(self))[::-1] & 1 == 1
        chains = [self.chain(link).matrix for link in range(len(self))]
        if self.time == "discrete":
            matrix = reduce(lambda all_, one: np.asarray(np.kron(all_, one)), chains)
        else:
            matrix = reduce(lambda all_, one: np.kron(all_, np.eye(2)) + np.kron(np.eye(len(all_)), one), chains)
        return [self.graph(row) for row in there], MarkovChain(self.time, np.asarray(matrix))


class ActiveAgents(IndependentLinks):
    """Agents, each of which makes every step with a probability, whatever it did before; "links" are the agents."""

    noun = "agent"

    @classmethod
    def of(cls, mesh: Graph, activation: float, dt: float) -> ActiveAgents:
        """All with the same probability."""
        made = np.full(mesh.agents, activation)
        return cls(mesh, mesh.targets, made, 1.0 - made, "discrete", dt)

    @cached_property
    def ends(self) -> list[tuple[int, int, bool]]:
        """Of every agent, itself."""
        return [(agent, agent, False) for agent in range(len(self))]

    def words(self, link: int, names: Sequence[str] | None) -> str:
        """An agent in words."""
        return agent_name(link + 1, names)

    def graph(self, there: BoolArray) -> Graph:
        """The graph in which only the agents ``there`` (m,) make a step, and listen; its name has a digit for each."""
        return replace(super().graph(there), whole=self.mesh, active=there)

    def logged(self, name: str, arcs: Sequence[tuple[int, int, float]]) -> Graph:
        """The same; what agents that never listen do is known by the name only."""
        given = super().logged(name, arcs)
        there = np.bincount(given.targets, minlength=len(self)) > 0
        if len(name) == len(self) and set(name) <= {"0", "1"}:
            there = there | (np.array(list(name)) == "1")
        graph = self.graph(there)
        return replace(graph, name=name) if graph.arcs == given.arcs else replace(given, active=there)

    def _there(self, graph: Graph, found: IntArray) -> BoolArray:
        del found
        assert graph.active is not None
        return graph.active


@dataclass(frozen=True, slots=True, eq=False)
class LinkSchedule(DrawnSchedule):
    """The path of a run whose links switch by themselves."""

    law: IndependentLinks
    there: BoolArray  # (n, E) which links are up in each graph
    foreign: Mapping[int, tuple[int, int]]  # by graph, source and target of an arc that belongs to no link


def _path(rise: float, fall: float, share: float, steps: int, random: np.random.Generator) -> BoolArray:
    """(steps,) whether a link is up; ``share``: probability that it begins so."""
    # Of the chain at the times of the steps, whose holding times are geometric.
    up = bool(random.random() < share)
    ends: list[IntArray] = []
    last = 0
    while last < steps:
        pair = (fall, rise) if up else (rise, fall)
        if pair[0] == 0.0:  # it never goes down
            break
        held = random.geometric(pair, size=(max(8, int(steps * min(pair)) // 2), 2)).reshape(-1)
        ends.append(last + np.cumsum(np.minimum(held, steps)))
        last = int(ends[-1][-1])
    flips = np.concatenate(ends) if ends else np.empty(0, dtype=np.int64)
    flipped = np.zeros(steps, dtype=np.int64)
    flipped[flips[flips < steps]] = 1  # holding times are a step at least: no two end at once
    return np.asarray((np.cumsum(flipped) % 2 == 1) != up)


def expanded(experiment: Experiment) -> Experiment:
    """The same with a Markov chain in place of what its path is drawn from: of all 2^E graphs, or of phases."""
    if isinstance(found := experiment.schedule, SojournSchedule):
        law, gain = found.law, experiment.noise_gain[found.law.graph_of]
        chain, graphs = law.phases, [experiment.graph_list[graph] for graph in law.graph_of.tolist()]
        number = np.arange(len(graphs)) - law.first[law.graph_of]
        graphs = [
            replace(graph, name=f"{graph.name}, phase {k + 1}") if k else graph
            for graph, k in zip(graphs, number.tolist(), strict=True)
        ]
    elif experiment.links:
        graphs, chain = experiment.links.product()
        gain = np.broadcast_to(experiment.noise_gain[0], (len(graphs), *experiment.noise_gain.shape[1:]))
    else:
        return experiment
    return _of_graphs(experiment, graphs, chain, gain)


def _of_graphs(
    experiment: Experiment, graphs: Sequence[Graph], law: MarkovChain | Schedule, gain: FloatArray
) -> Experiment:
    """The same with other graphs (n), what switches between them, and their noise gains (n, m, m)."""
    found = replace(experiment, graph_list=tuple(graphs), switching_law=law, noise_gain=gain)
    return found.bound(found.protocol.info) if found.protocol else found


def given_graphs(experiment: Experiment) -> Experiment:
    """The same with the graphs of its run as a given sequence."""
    found = experiment.schedule
    if not isinstance(found, DrawnSchedule):
        return experiment
    return replace(experiment, switching_law=Schedule(found.starts, found.order, found.modes, found.end, found.repeat))


def with_logged(experiment: Experiment, graphs: Sequence[Graph], modes: IntArray) -> Experiment:
    """The same with the graphs of a log, and their path (N,) in it, -1: not known, in place of those drawn."""
    assert experiment.links is not None
    changes = np.append(0, 1 + np.flatnonzero(np.diff(modes)))
    order = np.maximum(modes[changes], 0)
    path = experiment.links.schedule(graphs, changes * experiment.step_length, order)
    gain = np.broadcast_to(experiment.noise_gain[0], (len(graphs), *experiment.noise_gain.shape[1:]))
    return _of_graphs(experiment, graphs, path, gain)


def law_of(
    switching: SwitchingSpec,
    noise: NoiseSpec,
    graphs: Sequence[Graph],
    time: Time,
    dt: float,
    names: Sequence[str] | None,
    *,
    protocol: bool,
) -> tuple[IndependentLinks | None, list[str]]:
    """What the graphs of every run are drawn from, if not from a chain, and what is wrong with it (then it is None)."""
    if noise.activation is None or not noise.leaves_out_steps:
        return links_of(switching.links, graphs[0], time, dt, names) if switching.links else (None, [])
    others = ["several graphs"] * (len(graphs) > 1) + ["a protocol"] * protocol
    others += [f"switching.{key}" for key in ("links", "schedule") if getattr(switching, key) is not None]
    if others:
        wanted = f"expected one graph that does not switch, not {' and '.join(others)}"
        return None, [problem("noise.activation", noise.activation, wanted, "remove one of them")]
    return ActiveAgents.of(graphs[0], noise.activation, dt), []


def drawn_sojourns(chain: MarkovChain, switching: SwitchingSpec, names: Sequence[str], run: RunSpec) -> SojournSchedule:
    """The path of a run whose holding times are not exponential, from the seed."""
    sojourn = switching.sojourn or {}
    law = SemiMarkovChain(chain, np.array([sojourn[name].shape if name in sojourn else 1 for name in names]))
    initial = law.phases.stationary
    if switching.initial != "stationary":
        initial = np.eye(len(initial))[law.first[names.index(switching.initial)]]
    return law.drawn(initial, generator(run.seed, Stream.SWITCHING), run.steps, run.dt)


def links_of(
    spec: LinksSpec, mesh: Graph, time: Time, dt: float, names: Sequence[str] | None
) -> tuple[IndependentLinks | None, list[str]]:
    """The law that the file describes, and what is wrong with it (then it is None); agents in ``spec`` are numbers."""
    weights = {(s, t): w for s, t, w in mesh.arcs}  # agents from 1
    numbers: dict[tuple[int, int], int] = {}
    count = 0
    for s, t in weights:
        if (t, s) in numbers and weights[t, s] == weights[s, t]:
            numbers[s, t] = numbers[t, s]
        else:
            numbers[s, t], count = count, count + 1
    link_of = np.array(list(numbers.values()), dtype=np.int64)
    found: list[str] = []
    values = [
        _values(f"switching.links.{key}", getattr(spec, key), count, numbers, names, found) for key in ("up", "down")
    ]
    links = IndependentLinks(mesh, link_of, values[0], values[1], time, dt)
    for link in np.flatnonzero((values[0] == 0.0) | (values[1] > 1.0) | (values[0] > 1.0)).tolist():
        up, down = float(values[0][link]), float(values[1][link])
        if up == 0.0:
            wanted = "expected more than 0, so that the link comes up"
            found.append(problem("switching.links.up", f"0 for link {links.words(link, names)}", wanted, "raise it"))
        elif time == "discrete":
            wanted = "expected probabilities up to 1 in discrete time"
            found.append(problem("switching.links", f"{up:g} and {down:g}", wanted, "lower them"))
            break
    if time == "discrete" and not found and (np.minimum(values[0], values[1]) == 1.0).any():
        found.append(problem("switching.links", "up and down: 1", "expected an ergodic chain", "lower one of them"))
    return (None if found else links), found


def _values(
    key: str,
    given: RateSpec,
    count: int,
    numbers: dict[tuple[int, int], int],
    names: Sequence[str] | None,
    found: list[str],
) -> FloatArray:
    """(E,) the value of every link; mistakes are added to ``found``."""
    values = np.full(count, given.default)
    seen: set[int] = set()
    for kind in ("edges", "arcs"):
        for i, j, value in getattr(given, kind):
            link, back = numbers.get((int(i), int(j))), numbers.get((int(j), int(i)))
            place = f"{key}.{kind}"
            shown = show([i, j] if names is None else [agent_name(int(agent), names) for agent in (i, j)])
            if link is None or (kind == "edges") != (link == back):
                what = "an undirected link" if kind == "edges" else "a link in one direction"
                found.append(problem(place, shown, f"expected the agents of {what} of the graph", "correct it"))
            elif link in seen:
                found.append(problem(place, shown, "expected every link once", "remove one"))
            else:
                values[link] = value
                seen.add(link)
    return values
