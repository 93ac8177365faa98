"""What ROS 2 demands, beside an ideal middleware that does whatever the policies leave open."""

from __future__ import annotations

import random
from collections import deque
from itertools import product

import pytest

from msg_agents.doctor.qos.semantics import Action, Demand, Step, demands_of, newest, steps_of
from msg_analysis.wire.topics import Qos

JOIN, KILL, STOP, CONTINUE = Action.JOIN, Action.KILL, Action.STOP, Action.CONTINUE
SCRIPTS: dict[str, list[Step]] = {
    "first": [JOIN, range(7)],
    "late": [range(5), JOIN, range(5, 9)],
    "killed": [JOIN, range(3), KILL, range(3, 8), JOIN, range(8, 10)],
    "stopped": [JOIN, range(3), STOP, range(3, 8), CONTINUE, range(8, 10)],
}


class IdealMiddleware:
    """Keeps what the histories say; what a reader has not got yet is sent, arrives and is taken at any time."""

    def __init__(self, qos: Qos, rng: random.Random) -> None:
        self.qos, self.rng = qos, rng
        self.history: deque[int] = deque(maxlen=qos.depth)  # of the writer
        self.due: list[int] = []  # to be sent to the reader
        self.network: deque[int] = deque()
        self.queue: deque[int] = deque(maxlen=qos.depth)  # of the reader
        self.there = self.running = False
        self.taken: list[int] = []
        self.chances = [rng.choice([0.0, 0.5, 1.0]) for _ in range(3)]

    def act(self, action: Action) -> None:
        self.running = action in (JOIN, CONTINUE)
        if action is JOIN:
            self.there = True
            self.network.clear()
            self.queue.clear()
            self.due = list(self.history) if self.qos.latched else []
        elif action is KILL:
            self.there = False

    def publish(self, number: int) -> None:
        self.history.append(number)
        if self.there:
            self.due.append(number)
            self.go_on(self.chances)

    def go_on(self, chances: list[float]) -> None:
        """Some of what may happen now: each kind of event with its chance."""
        self.due = [number for number in self.due if number in self.history]
        for _ in range(10):
            sends, arrives, takes = (self.rng.random() < chance for chance in chances)
            if self.due and sends:
                number = self.due.pop(0)
                if self.qos.reliable or self.rng.random() < 0.7:
                    self.network.append(number)
            if self.running and self.network and arrives:
                self.queue.append(self.network.popleft())
            if self.running and self.queue and takes:
                self.taken.append(self.queue.popleft())

    def settle(self) -> None:
        """All that must happen in the end."""
        while self.running and (self.due or self.network or self.queue):
            self.go_on([max(chance, 0.2) for chance in self.chances])


def simulated(qos: Qos, steps: list[Step], rng: random.Random) -> list[set[int]]:
    """What the reader takes in each step."""
    middleware, found = IdealMiddleware(qos, rng), []
    for step in steps:
        middleware.taken = []
        if isinstance(step, Action):
            middleware.act(step)
        else:
            for number in step:
                middleware.publish(number)
        middleware.settle()
        found.append(set(middleware.taken))
    return found


@pytest.mark.parametrize("script", SCRIPTS)
@pytest.mark.parametrize(
    ("reliable", "latched", "depth"), list(product([True, False], [True, False], [1, 3, 6, None])), ids=str
)
def test_demands_are_exactly_what_an_ideal_middleware_does(
    script: str, reliable: bool, latched: bool, depth: int | None
) -> None:
    """Over 200 random orders of events, what always comes must come, and what ever comes may come."""
    qos, steps, rng = Qos(depth, reliable=reliable, latched=latched), SCRIPTS[script], random.Random(1)
    runs = [simulated(qos, steps, rng) for _ in range(200)]
    for place, demand in enumerate(demands_of(qos, steps)):
        always = set.intersection(*(run[place] for run in runs))
        ever = set.union(*(run[place] for run in runs))
        assert (always, ever) == ((set(demand.must), set(demand.may)) if demand else (set(), set()))


@pytest.mark.parametrize(
    ("qos", "script", "expected"),
    [
        (Qos(3), "late", [None, Demand(range(0), range(0)), Demand(range(6, 9), range(5, 9), True)]),
        (
            Qos(3, latched=True),
            "late",
            [None, Demand(range(2, 5), range(2, 5)), Demand(range(6, 9), range(5, 9), True)],
        ),
        (Qos(None, reliable=False), "first", [Demand(range(0), range(0)), Demand(range(0), range(7), True)]),
    ],
    ids=["volatile", "latched", "best effort"],
)
def test_by_hand(qos: Qos, script: str, expected: list[Demand | None]) -> None:
    assert demands_of(qos, SCRIPTS[script]) == expected


@pytest.mark.parametrize("reader", ["first", "late", "killed", "slow", "stopped"])
@pytest.mark.parametrize("depth", [1, 10, 1000, None])
def test_every_number_is_published_once_and_more_than_a_history_keeps(reader: str, depth: int | None) -> None:
    """While no reader takes messages, in one go, or in the whole try where they always do."""
    steps = steps_of(reader, depth)  # type: ignore[arg-type]
    published = [step for step in steps if isinstance(step, range)]
    assert [number for step in published for number in step] == list(range(published[-1].stop))
    assert max(map(len, published)) > (depth or 1000)


def test_newest() -> None:
    assert newest(range(3, 8), 2) == range(6, 8)
    assert newest(range(3, 8), 9) == newest(range(3, 8), None) == range(3, 8)
