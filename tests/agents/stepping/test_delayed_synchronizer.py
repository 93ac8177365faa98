"""The lockstep with older values, against a serial loop: random losses and networks, in random orders, with kills.

As in test_synchronizer.py the values are integers that depend on all that they were made of, in its order.
"""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msg_agents.stepping.synchronizer import HISTORY_STEPS, Synchronizer
from msg_analysis.messages.acceptance import Refusal

PRIME = 2**61 - 1


def law(own: int, agent: int, heard: list[int]) -> int:
    for number in (agent, *heard):
        own = (own * 1_000_003 + number + 1) % PRIME
    return own


@dataclass
class Case:
    """A network: every agent hears some others in each of two graphs, which follow each other at random."""

    agents: int
    steps: int
    window: int
    delay: int
    loss: float
    random: random.Random
    inputs: list[list[list[int]]] = field(init=False)  # [mode][agent]
    modes: list[int] = field(init=False)
    lost: dict[tuple[int, int], list[bool]] = field(init=False)  # by receiver and sender, of every step

    def __post_init__(self) -> None:
        pairs = [(i, j) for i in range(self.agents) for j in range(self.agents) if i != j]
        chosen = [[pair for pair in pairs if self.random.random() < 0.6] for _ in range(2)]
        self.inputs = [[[j for i, j in mode if i == agent] for agent in range(self.agents)] for mode in chosen]
        self.modes = [self.random.randrange(2) for _ in range(self.steps)]
        self.lost = {pair: [self.random.random() < self.loss for _ in range(self.steps + 1)] for pair in pairs}
        for row in self.lost.values():
            row[0] = False

    def needed(self, receiver: int, sender: int, step: int) -> int:
        """The last one heard."""
        step = max(0, step - self.delay)
        while self.lost[receiver, sender][step]:
            step -= 1
        return step

    def peers(self, agent: int) -> list[int]:
        heard = {j for mode in self.inputs for j in mode[agent]}
        return sorted(heard | {i for i in range(self.agents) for mode in self.inputs if agent in mode[i]})

    def serial(self) -> list[list[int]]:
        """[agent][step]."""
        states = [[i + 1] for i in range(self.agents)]
        for k, mode in enumerate(self.modes):
            made = [
                law(states[i][k], i, [states[j][self.needed(i, j, k)] for j in self.inputs[mode][i]])
                for i in range(self.agents)
            ]
            for row, value in zip(states, made, strict=True):
                row.append(value)
        return states


class Network:
    """Agents and the queues between them; what happens next is chosen at random."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.states = [[i + 1] for i in range(case.agents)]
        self.links = {(i, j): deque([0]) for i in range(case.agents) for j in case.peers(i)}  # receiver, sender: steps
        self.nodes = [self.node(i) for i in range(case.agents)]

    def node(self, agent: int) -> Synchronizer[int]:
        case, step = self.case, len(self.states[agent]) - 1
        found: Synchronizer[int] = Synchronizer(
            needed=lambda j, k: case.needed(agent, j, k),
            delay=case.delay,
            agent=agent,
            steps=case.steps,
            inputs=[mode[agent] for mode in case.inputs],
            peers=case.peers(agent),
            window=case.window,
            start=step,
        )
        for sequence, mode in enumerate(case.modes):
            assert found.learn(sequence, mode, sequence, sequence) in (None, Refusal.REPEATED)
        return found

    def kill(self, agent: int) -> None:
        """All on its way to or from the agent is lost; it repeats, and asks for, what is used from the window on."""
        case, step = self.case, len(self.states[agent]) - 1
        self.nodes[agent] = self.node(agent)
        first = max(0, step - case.window - 1)
        for (i, j), queue in self.links.items():
            if agent == j:
                queue.clear()
                queue.extend(range(case.needed(i, j, first), step + 1))
            elif agent == i:
                queue.clear()  # it hears some new states before the old ones that it has asked for
                ahead = len(self.states[j]) - 1
                queue.extend([ahead, *range(case.needed(i, j, step), ahead + 1)])

    def run(self) -> None:
        case = self.case
        while not all(node.finished for node in self.nodes):
            events = [("step", i, i) for i, node in enumerate(self.nodes) if node.ready()]
            events += [("hear", *link) for link, queue in self.links.items() if queue]
            assert events, [node.waiting_for() for node in self.nodes]
            kind, i, j = case.random.choice(events)
            if kind == "hear":
                step = self.links[i, j].popleft()
                assert self.nodes[i].offer(j, step, self.states[j][step]) in (None, Refusal.REPEATED)
                continue
            mode, heard = self.nodes[i].inputs()
            self.nodes[i].advance()
            assert mode == case.modes[len(self.states[i]) - 1]
            self.states[i].append(law(self.states[i][-1], i, heard))
            for (_, sender), queue in self.links.items():
                if sender == i:
                    queue.append(len(self.states[i]) - 1)
            if case.random.random() < 0.02:
                self.kill(case.random.randrange(case.agents))


@settings(deadline=None)
@given(
    agents=st.integers(2, 4),
    steps=st.integers(1, 60),
    window=st.integers(0, 5),
    delay=st.sampled_from([0, 0, 1, 3, 20]),
    loss=st.sampled_from([0.0, 0.3, 0.9]),
    seed=st.integers(0, 2**32),
)
def test_equals_the_serial_loop(agents: int, steps: int, window: int, delay: int, loss: float, seed: int) -> None:
    case = Case(agents, steps, window, delay, loss, random.Random(seed))
    network = Network(case)
    network.run()
    assert network.states == case.serial()


@pytest.mark.parametrize(("delay", "loss", "seed"), [(0, 0.99, 1), (100, 0.5, 2), (70, 0.98, 3)])
def test_values_older_than_all_that_is_kept_anyway(delay: int, loss: float, seed: int) -> None:
    """With bursts of hundreds of steps, more than a window and what is kept after use."""
    case = Case(3, 700, 64, delay, loss, random.Random(seed))
    oldest = max(k - case.needed(i, j, k) for i, j in case.lost for k in range(case.steps))
    assert oldest > HISTORY_STEPS
    network = Network(case)
    network.run()
    assert network.states == case.serial()


def lonely(held: int) -> Synchronizer[str]:
    """Agent 0 at step 200, which hears agent 1, of which it holds the value of a step."""
    node: Synchronizer[str] = Synchronizer(
        needed=lambda _j, k: held if k <= 200 else k, delay=0, agent=0, steps=300, inputs=[[1]], peers=[1], start=200
    )
    assert node.learn(0, 0, 0, 299) is None
    return node


@pytest.mark.parametrize("held", [90, 150, 200])
def test_it_waits_for_the_value_that_it_holds(held: int) -> None:
    """Newer and older ones do not help; what comes twice must be the same."""
    node = lonely(held)
    assert node.waiting_for() == f"step {held} of agent 2"
    assert node.lacking() == [1]
    assert node.offer(1, 201, "new") is None
    assert node.offer(1, held - 1, "old") == Refusal.REPEATED
    assert not node.ready()
    assert node.offer(1, held, "held") is None
    assert node.offer(1, held, "held") == Refusal.REPEATED
    assert node.offer(1, held, "forged") == Refusal.CONTRADICTION
    assert node.known(1, held) == "held"
    assert node.ready()
    assert node.inputs() == (0, ["held"])
    node.advance()
    assert node.inputs() == (0, ["new"])


def test_what_it_refuses() -> None:
    node = lonely(200)
    assert node.offer(2, 200, "") == Refusal.NOT_A_PEER
    assert node.offer(1, 266, "") == Refusal.TOO_NEW
    assert node.offer(1, 100, "") is None  # the progress of a peer that is behind
    assert node.offer(1, 99, "") == Refusal.REPEATED
