"""The lockstep against a serial loop: random networks in random orders of delivery, and a small one in every order.

The values are integers that depend on everything which they were made of, in its order, so that a wrong step, a wrong
agent or a wrong order anywhere changes what comes out at the end.
"""

import io
import pickle
import random
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msg_agents.stepping.synchronizer import HISTORY_STEPS, Synchronizer, _Uses
from msg_analysis.messages.acceptance import Refusal

PRIME = 2**61 - 1
HoldingPeriod = tuple[int, int, int, int]  # sequence, mode, first step, last step
Inputs = list[list[list[int]]]  # [mode][agent]: whom the agent uses


@dataclass(frozen=True)
class Case:
    """A network without arithmetic."""

    agents: int
    steps: int
    window: int
    inputs: Inputs
    path: list[HoldingPeriod]
    delay: int = 0
    lost: frozenset[tuple[int, int, int]] = frozenset()  # receiver, sender, step of the value

    def needed(self, receiver: int, sender: int, step: int) -> int:
        """The step of the value that is used: the last one received."""
        step = max(0, step - self.delay)
        while (receiver, sender, step) in self.lost:
            step -= 1
        return step

    @cached_property
    def peers(self) -> list[set[int]]:
        """Of every agent: whom it hears, or who hears it, in any mode."""
        found: list[set[int]] = [set() for _ in range(self.agents)]
        for mode in self.inputs:
            for agent, heard in enumerate(mode):
                for j in heard:
                    found[agent].add(j)
                    found[j].add(agent)
        return found


def law(own: int, agent: int, mode: int, heard: list[tuple[int, int]]) -> int:
    for number in (agent, mode, *(part for pair in heard for part in pair)):
        own = (own * 1_000_003 + number + 1) % PRIME
    return own


def serial(case: Case) -> list[list[int]]:
    """[step][agent], computed by one loop that knows everything."""
    modes = [mode for _, mode, first, last in case.path for _ in range(first, last + 1)]
    states = [[agent + 1 for agent in range(case.agents)]]
    for k, mode in enumerate(modes):
        used = [[(j, states[case.needed(i, j, k)][j]) for j in row] for i, row in enumerate(case.inputs[mode])]
        states.append([law(states[k][i], i, mode, used[i]) for i in range(case.agents)])
    return states


@dataclass
class Network:
    """Synchronizers and the FIFO queues between them; what happens next is chosen from outside."""

    case: Case
    nodes: list[Synchronizer[int]] = field(init=False)
    states: list[list[int]] = field(init=False)  # [agent][step]
    links: dict[tuple[int, int], deque[tuple[int, int]]] = field(init=False)
    graphs: list[deque[HoldingPeriod]] = field(init=False)
    unasked: set[tuple[int, int]] = field(default_factory=set)  # links over which a new process has not asked yet
    killed: bool = False

    def __post_init__(self) -> None:
        case = self.case
        self.nodes = [self._node(i, 0) for i in range(case.agents)]
        self.links = {(j, i): deque() for i in range(case.agents) for j in case.peers[i]}
        self.graphs = [deque(case.path) for _ in range(case.agents)]
        self.states = [[] for _ in range(case.agents)]
        for i in range(case.agents):
            self._publish(i, i + 1)

    def _node(self, agent: int, start: int) -> Synchronizer[int]:
        case = self.case
        options = {"agent": agent, "steps": case.steps, "peers": case.peers[agent], "window": case.window}
        if case.delay or case.lost:
            options |= {"needed": partial(case.needed, agent), "delay": case.delay}
        return Synchronizer(inputs=[mode[agent] for mode in case.inputs], start=start, **options)

    def _publish(self, agent: int, value: int) -> None:
        for (source, _), queue in self.links.items():
            if source == agent:
                queue.append((len(self.states[agent]), value))
        self.states[agent].append(value)

    def kill(self, agent: int) -> None:
        """All that is under way to and from it is lost; its next process publishes again what this one has."""
        self.killed = True
        self.nodes[agent] = self._node(agent, self.nodes[agent].step)
        self.graphs[agent] = deque(self.case.path)
        for source, target in self.links:
            if source == agent:
                self.links[source, target] = deque(enumerate(self.states[agent]))
            elif target == agent:
                self.links[source, target].clear()
                self.unasked.add((source, target))
        self.check_bounds(agent)

    def events(self) -> list[tuple[str, int, int]]:
        """Everything that can happen now."""
        possible = [("state", j, i) for (j, i), queue in self.links.items() if queue]
        possible += [("graph", i, i) for i, queue in enumerate(self.graphs) if queue]
        possible += [("again", j, i) for j, i in self.unasked]
        return possible + [("step", i, i) for i, node in enumerate(self.nodes) if node.ready()]

    def happen(self, event: tuple[str, int, int]) -> None:
        kind, source, target = event
        node = self.nodes[target]
        if kind == "state":
            refused = node.offer(source, *self.links[source, target].popleft())
            assert refused in ((None, Refusal.REPEATED) if self.killed else (None,))
        elif kind == "graph":
            refused = node.learn(*self.graphs[target].popleft())
            assert refused in ((None, Refusal.REPEATED) if self.killed else (None,))
        elif kind == "again":
            self.unasked.discard((source, target))
            first = self.case.needed(target, source, max(0, node.step - self.case.window - 1))
            self.links[source, target].extend(list(enumerate(self.states[source]))[first:])
        else:
            step = node.step
            mode, values = node.inputs()
            used = self.case.inputs[mode][target]
            assert len(values) == len(used), "uses others than the row of this mode"
            node.advance()
            assert node.step == step + 1
            self._publish(target, law(self.states[target][-1], target, mode, list(zip(used, values, strict=True))))
        self.check_bounds(target)

    def check_bounds(self, agent: int) -> None:
        """Of the one agent that an event changes."""
        window, node, made = self.case.window, self.nodes[agent], len(self.states[agent])
        assert made == node.step + 1
        for j in self.case.peers[agent]:
            assert made - len(self.states[j]) <= window + 1

    def check_end(self, expected: list[list[int]]) -> None:
        texts = [f"agent {i + 1} waits for {node.waiting_for()}" for i, node in enumerate(self.nodes)]
        assert all(node.finished for node in self.nodes), texts
        assert [list(row) for row in zip(*self.states, strict=True)] == expected

    def progress(self) -> tuple[int, ...]:
        """Tells the situation completely: what was sent on a link is a function of its number."""
        return (
            *(node.step for node in self.nodes),
            *(len(queue) for queue in self.links.values()),
            *(len(queue) for queue in self.graphs),
        )


@st.composite
def cases(draw: st.DrawFn) -> Case:
    agents, modes = draw(st.integers(1, 6)), draw(st.integers(1, 3))
    steps, window = draw(st.integers(1, 25)), draw(st.integers(0, 5))
    directed, everybody = draw(st.booleans()), range(agents)
    pairs = [(i, j) for i in everybody for j in everybody if (i != j if directed else i < j)]
    inputs: Inputs = []
    for _ in range(modes):
        # Any set of links will do, the empty one too: the graph may be disconnected, even all of them together.
        chosen = draw(st.sets(st.sampled_from(pairs))) if pairs else set()
        arcs = chosen if directed else chosen | {(j, i) for i, j in chosen}
        inputs.append([sorted(j for i, j in arcs if i == agent) for agent in everybody])
    ends = sorted(draw(st.sets(st.integers(0, steps - 1), max_size=8)) | {steps - 1})
    firsts = [0] + [end + 1 for end in ends[:-1]]
    path = [
        (n, draw(st.integers(0, modes - 1)), first, last)
        for n, (first, last) in enumerate(zip(firsts, ends, strict=True))
    ]
    delay, loss = draw(st.sampled_from([0, 0, 0, 1, 3, 20])), draw(st.sampled_from([0.0, 0.0, 0.3, 0.9]))
    lost = losses(agents, steps, loss, draw(st.randoms()))
    return Case(agents, steps, window, inputs, path, delay, lost)


def losses(agents: int, steps: int, loss: float, chance: random.Random) -> frozenset[tuple[int, int, int]]:
    """Values that are lost; that of step 0 never is."""
    values = product(range(agents), range(agents), range(1, steps + 1)) if loss else ()
    return frozenset(value for value in values if chance.random() < loss)


@settings(max_examples=200, deadline=None)
@given(cases(), st.integers(0, 2**32), st.sampled_from([1.0, 0.1, 0.001]))
def test_any_network_in_any_order_is_the_serial_loop(case: Case, seed: int, slowness: float) -> None:
    rng = random.Random(seed)
    network = Network(case)
    # Some links, some agents and some graph topics are far slower than the others.
    weight = {
        (kind, j, i): rng.choice([1.0, slowness])
        for kind in ("state", "graph", "step")
        for i in range(case.agents)
        for j in range(case.agents)
    }
    while events := network.events():
        network.happen(rng.choices(events, [weight[event] for event in events])[0])
    network.check_end(serial(case))


@settings(max_examples=200, deadline=None)
@given(cases(), st.integers(0, 2**32))
def test_agents_may_be_killed_at_any_time(case: Case, seed: int) -> None:
    """Each of them a few times, also while others wait for its answer."""
    run_with_kills(case, random.Random(seed))


@pytest.mark.parametrize(("delay", "loss", "seed"), [(0, 0.99, 1), (100, 0.5, 2), (70, 0.98, 3)])
def test_values_older_than_all_that_is_kept_anyway(delay: int, loss: float, seed: int) -> None:
    """With bursts of hundreds of steps, more than a window and what is kept after use."""
    rng, steps = random.Random(seed), 700
    pairs = [(i, j) for i in range(3) for j in range(3) if i != j]
    inputs: Inputs = [[[j for i, j in pairs if i == agent and rng.random() < 0.6] for agent in range(3)] for _ in "ab"]
    path = [(k, rng.randrange(2), k, k) for k in range(steps)]
    case = Case(3, steps, 64, inputs, path, delay, losses(3, steps, loss, rng))
    assert max(k - case.needed(i, j, k) for i, j in pairs for k in range(steps)) > HISTORY_STEPS
    run_with_kills(case, rng)


def run_with_kills(case: Case, rng: random.Random) -> None:
    network, lives = Network(case), 2 * case.agents
    while events := network.events():
        if lives and rng.random() < 2 / case.steps:
            lives -= 1
            network.kill(rng.randrange(case.agents))
        else:
            network.happen(rng.choice(events))
    network.check_end(serial(case))


@settings(max_examples=200, deadline=None)
@given(cases(), st.data(), st.integers(0, 2**32))
def test_the_run_may_end_early_at_any_time(case: Case, data: st.DataObject, seed: int) -> None:
    """Agents learn of the last step at different times: all make every step up to it, and none waits for ever."""
    end = data.draw(st.integers(1, case.steps))
    rng = random.Random(seed)
    network, lasts = Network(case), dict[int, tuple[int, int]]()  # found, wanted
    while (events := network.events()) or len(lasts) < case.agents:
        others = [agent for agent in range(case.agents) if agent not in lasts]
        if others and (not events or rng.random() < 0.05):
            agent = rng.choice(others)
            wanted = max(end, network.nodes[agent].step)
            network.nodes[agent].end_at(end)
            lasts[agent] = network.nodes[agent].steps, wanted
        else:
            network.happen(rng.choice(events))
    assert all(found == wanted for found, wanted in lasts.values())
    assert all(node.finished for node in network.nodes)
    assert all(len(states) > end for states in network.states)
    made = [list(row) for row in zip(*(states[: end + 1] for states in network.states), strict=True)]
    assert made == serial(case)[: end + 1]


def _frozen(network: Network) -> bytes:
    """Several times faster than copy.deepcopy; what never changes is not copied."""
    stream = io.BytesIO()
    pickler = pickle.Pickler(stream)
    pickler.dispatch_table = dict.fromkeys((Case, _Uses), _kept)
    pickler.dump(network)
    return stream.getvalue()


CONSTANTS: dict[int, object] = {}


def _kept(constant: object) -> tuple[Callable[[int], object], tuple[int]]:
    CONSTANTS[id(constant)] = constant
    return _constant, (id(constant),)


def _constant(number: int) -> object:
    return CONSTANTS[number]


def explore(case: Case) -> Iterator[Network]:
    """Every end that any order of events leads to."""
    start = Network(case)
    seen, pending = {start.progress()}, [start]
    while pending:
        network = pending.pop()
        events = network.events()
        if not events:
            yield network
        frozen = _frozen(network)
        for number, event in enumerate(events, start=1):
            branch: Network = network if number == len(events) else pickle.loads(frozen)
            branch.happen(event)
            progress = branch.progress()
            if progress not in seen:
                seen.add(progress)
                pending.append(branch)


@pytest.mark.parametrize("window", [0, 1])
@pytest.mark.parametrize(
    ("agents", "inputs", "path"),
    [
        (2, [[[1], [0]], [[], []]], [(0, 0, 0, 0), (1, 1, 1, 1), (2, 0, 2, 2)]),
        (2, [[[1], []], [[], [0]]], [(0, 0, 0, 1), (1, 1, 2, 2)]),
        (3, [[[1], [0], []], [[], [2], [1]]], [(0, 0, 0, 0), (1, 1, 1, 1)]),
    ],
    ids=["pair that parts and meets", "directed pair that turns round", "three of whom one is always alone"],
)
def test_every_order_of_a_small_network(agents: int, inputs: Inputs, path: list[HoldingPeriod], window: int) -> None:
    case = Case(agents, path[-1][3] + 1, window, inputs, path)
    expected = serial(case)
    ends = 0
    for network in explore(case):
        network.check_end(expected)
        ends += 1
    assert ends == 1  # all orders meet in one end, with every queue empty
