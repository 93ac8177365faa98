"""What a recorder takes from batches, against the same messages one by one; which steps it knows."""

import random
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from networks import experiment

from msg_agents.stepping.state_receiver import CONSECUTIVE, Received, ReceivedSteps, StateReceiver, hashes_of
from msg_agents.stepping.synchronizer import RESEND_LIMIT
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.cdr import encode_batch
from msg_analysis.messages.messages import AgentState
from msg_analysis.messages.topics import STATE, STATES, TRUTH, TRUTHS
from msg_analysis.model.run_record import RunRecord
from msg_analysis.twin.simulate import new_record

STEPS = 200


def _record(**noise: Any) -> RunRecord:
    graphs = {"line": {"path": [1, 2, 3]}, "star": {"star": {"center": 2}}}
    run = {"dt": 0.1, "duration": STEPS * 0.1}
    return new_record(experiment(3, agents=3, graphs=graphs, noise={"process": 1.0} | noise, run=run))


def _message(record: RunRecord, agent: int, step: int, value: float = 1.5, **changes: Any) -> bytes:
    fields = {"stamp": step * 10**8, "run": record.run.bytes, "agent": agent, "step": step, "mode": min(step, 1)}
    return AgentState(**(fields | {"state": np.array([value, -step])} | changes)).encode()


def _receiver(record: RunRecord) -> StateReceiver:
    return StateReceiver(record, STATES, STATE, "/net/")


def _taken(record: RunRecord, messages: list[bytes], receiver: StateReceiver | None = None) -> Received:
    """From a batch with these messages."""
    receiver = receiver or _receiver(record)
    receiver.add(encode_batch(record.run.bytes, messages))
    return receiver.take()


def test_a_run_in_batches_of_any_size() -> None:
    """Every state comes out once, with its own bytes, in the order in which it came."""
    record, chance = _record(), random.Random(1)
    receiver = _receiver(record)
    sent = [(agent, step) for step in range(STEPS + 1) for agent in (1, 2, 3)]
    parts, left = [], list(sent)
    while left:
        count = chance.randrange(1, 40)
        parts, left = [*parts, left[:count]], left[count:]
    received = []
    for part in parts:
        batch = encode_batch(record.run.bytes, [_message(record, *each) for each in part])
        assert receiver.add(batch) >= len(batch)
        received += [receiver.take()] if chance.random() < 0.5 or part is parts[-1] else []
    found = []
    for some in received:
        assert some.refused == []
        for agent, step, time, start, size in zip(
            *(some.agent, some.step, some.time, some.start, some.size), strict=True
        ):
            assert some.data[start : start + size] == _message(record, agent + 1, step)
            assert time == step * 10**8
            found.append((agent + 1, step))
    assert found == sent
    assert len(receiver.take().agent) == 0
    assert receiver.names == ["/net/agent_1/state", "/net/agent_2/state", "/net/agent_3/state"]


def test_repetitions_and_contradictions() -> None:
    """Repeated states are dropped; of two different ones both are recorded, further ones are not."""
    record = _record()
    received = _taken(record, [_message(record, 2, 5, value) for value in (1.5, 1.5, 2.5, 3.5, 2.5)])
    assert received.step.tolist() == [5, 5]
    assert [received.data[start + 68 : start + 76] for start in received.start] == [
        np.float64(value).tobytes() for value in (1.5, 2.5)
    ]
    name = "/net/agent_2/state"
    assert sorted(received.refused) == sorted(
        [(name, Refusal.REPEATED), (name, Refusal.CONTRADICTION), *[(name, Refusal.REPEATED)] * 2]
    )


@pytest.mark.parametrize("field", ["stamp", "mode", "state", "heard"])
def test_any_other_byte_is_a_contradiction(field: str) -> None:
    record = _record(loss=0.5)
    others = {"stamp": 1, "mode": 2, "state": np.array([1.5, np.nextafter(-3.0, 0.0)]), "heard": np.array([2], "u8")}
    messages = [_message(record, 1, 3), _message(record, 1, 3, **{field: others[field]})]
    assert _taken(record, messages).refused == [("/net/agent_1/state", Refusal.CONTRADICTION)]


def test_what_cannot_be() -> None:
    """Every message is refused for its reason; those around it are taken."""
    record, name = _record(), "/net/agent_2/state"
    bad = {
        _message(record, 2, 3, run=bytes(16)): ("states", Refusal.OTHER_RUN),
        _message(record, 0, 3): ("states", Refusal.UNKNOWN_AGENT),
        _message(record, 4, 3): ("states", Refusal.UNKNOWN_AGENT),
        _message(record, 2, 3, state=np.ones(3)): ("states", Refusal.WRONG_LENGTH),
        _message(record, 2, 3, state=np.ones(0)): ("states", Refusal.WRONG_LENGTH),
        _message(record, 2, 3, frame_id="map"): ("states", Refusal.OTHER_LAYOUT),
        _message(record, 2, 3, heard=np.array([2], "u8")): ("states", Refusal.OTHER_LAYOUT),
        _message(record, 2, 3, mode=3): (name, Refusal.UNKNOWN_MODE),
        _message(record, 2, 3, mode=0): (name, Refusal.UNKNOWN_MODE),
        _message(record, 2, 3, value=np.nan): (name, Refusal.NOT_FINITE),
        _message(record, 2, STEPS + 1): (name, Refusal.OUT_OF_RANGE),
        _message(record, 2, 2**64 - 1, stamp=0): (name, Refusal.OUT_OF_RANGE),
        b"": ("states", Refusal.UNDECODABLE),
        b"\x00\x01\x00\x00" + b"\xff" * 70: ("states", Refusal.UNDECODABLE),
    }
    messages = [_message(record, 1, 0)]
    for number, message in enumerate(bad, start=1):
        messages += [message, _message(record, 1, number)]
    received = _taken(record, messages)
    assert received.step.tolist() == list(range(len(bad) + 1))
    assert sorted(received.refused) == sorted(bad.values())


def test_batches_that_are_none() -> None:
    record = _record()
    receiver = _receiver(record)
    good = encode_batch(record.run.bytes, [_message(record, 1, 0)])
    for batch in (b"", good[:-1], encode_batch(bytes(16), [_message(record, 1, 0)]), good):
        receiver.add(batch)
    received = receiver.take()
    assert received.agent.tolist() == [0]
    reasons = [Refusal.UNDECODABLE, Refusal.UNDECODABLE, Refusal.OTHER_RUN]
    assert received.refused == [("states", reason) for reason in reasons]


def test_exact_states_beside_noisy_ones() -> None:
    record = _record(broadcast=0.1)
    receiver = StateReceiver(record, TRUTHS, TRUTH, "/")
    assert _taken(record, [_message(record, 3, 0)], receiver).agent.tolist() == [2]
    assert receiver.names[2] == "/agent_3/truth"


def test_single_messages_beside_batches() -> None:
    """Of a player, or of somebody else: taken once, on the topic of their agent only."""
    record = _record()
    receiver = _receiver(record)
    receiver.add(encode_batch(record.run.bytes, [_message(record, 1, 0), _message(record, 2, 0)]))
    for agent, message in ((0, _message(record, 1, 0)), (1, _message(record, 2, 1)), (1, _message(record, 3, 0))):
        receiver.add_single(agent, message)
    received = receiver.take()
    assert sorted(zip(received.agent.tolist(), received.step.tolist(), strict=True)) == [(0, 0), (1, 0), (1, 1)]
    assert sorted(received.refused) == sorted(
        [("/net/agent_1/state", Refusal.REPEATED), ("/net/agent_2/state", Refusal.OTHER_AGENT)]
    )


LONG = 50_000


@pytest.mark.parametrize("first", [[0, 1, 2], [0, 2, 1]], ids=["in order", "neighbours swapped"])
def test_to_the_end(first: list[int]) -> None:
    """What comes long after two that are swapped is taken all the same."""
    steps = ReceivedSteps(LONG)
    for k in (*first, *range(3, LONG + 1)):
        assert steps.take(k, k) is None
        assert k < 3 or steps.row == k
    assert steps.take(LONG + 1, 0) == Refusal.OUT_OF_RANGE


@given(st.integers(0, 2**32), st.integers(1, 300), st.integers(0, 40))
def test_any_order_and_repetitions(seed: int, last: int, shuffled: int) -> None:
    """Restarts repeat what came before; of different contents the second is told apart."""
    chance = random.Random(seed)
    order = sorted(range(last + 1), key=lambda k: k + chance.uniform(0, shuffled))
    steps, known = ReceivedSteps(last), {}
    for k in order:
        assert steps.take(k, hash((k, seed))) is None
        known[k] = hash((k, seed))
        again = chance.choice(list(known))
        assert steps.take(again, known[again]) == Refusal.REPEATED
    assert steps.row == last
    assert steps.take(last, 1) == Refusal.CONTRADICTION
    assert steps.take(last, 2) == Refusal.REPEATED
    assert steps.take(last, known[last]) == Refusal.REPEATED


def test_reach() -> None:
    steps = ReceivedSteps(LONG)
    for k in range(20_001):
        steps.take(k, k)
    assert steps.take(20_000 - RESEND_LIMIT, 0) == Refusal.TOO_OLD
    assert steps.take(20_001 - RESEND_LIMIT, 20_001 - RESEND_LIMIT) == Refusal.REPEATED
    assert steps.take(20_001 - RESEND_LIMIT, 0) == Refusal.CONTRADICTION
    assert steps.take(20_001 + RESEND_LIMIT, 0) == Refusal.TOO_NEW
    assert steps.take(20_000 + RESEND_LIMIT, 0) is None


def test_forged_steps_change_nothing() -> None:
    """Of any steps that do not follow each other, before the first true one and between true ones."""
    chance = random.Random(1)
    steps = ReceivedSteps(LONG)
    taken = set()
    for k in [*range(LONG, 0, -50), *(chance.randrange(LONG) for _ in range(2000))]:
        taken |= {k} if steps.take(k, -1) is None else set()
    for k in range(LONG + 1):
        assert steps.take(k, k) == (Refusal.CONTRADICTION if k in taken else None)
        forged = chance.randrange(k + 1, 2 * LONG)
        taken |= {forged} if steps.take(forged, -1) is None else set()
    assert steps.row == LONG


def test_a_reader_that_came_late() -> None:
    """The first steps never come: after a few in a row they are taken for lost."""
    for first in (1, 100, RESEND_LIMIT, 20_000):
        steps = ReceivedSteps(LONG)
        taken = [k for k in range(first, LONG + 1) if steps.take(k, k) is None]
        assert taken == list(range(taken[0], LONG + 1))
        assert taken[0] - first < CONSECUTIVE
        assert steps.row == LONG


def test_memory_does_not_grow() -> None:
    steps = ReceivedSteps(10**9)
    for k in range(20_000):
        steps.take(k, k)
    tracemalloc.start()
    for k in range(20_000, 40_000):
        steps.take(k, k)
        steps.take(10**9 - k, k)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 10_000


@given(st.integers(0, 2**32), st.sampled_from([3, 50, 7_000, 13_000, LONG]))
def test_rows_at_once_are_the_same_as_one_by_one(seed: int, last: int) -> None:
    """Rows that follow, repeat, overlap or leave gaps: what one by one says, and the same hashes afterwards."""
    chance = random.Random(seed)
    rows, singles = ReceivedSteps(last), ReceivedSteps(last)
    step = 0
    for _ in range(30):
        first = max(0, step + chance.choice([0, 0, 0, 0, 1, -3, 100, -RESEND_LIMIT]))
        contents = [hash((k, chance.random() < 0.01)) for k in range(first, first + chance.randrange(1, 900))]
        one_by_one = [singles.take(k, content) for k, content in enumerate(contents, start=first)]
        at_once = rows.take_row(first, hashes_of(np.array(contents)))
        left = [] if at_once else contents
        refusals = [None] * len(contents) if at_once else []
        assert refusals + [rows.take(k, content) for k, content in enumerate(left, start=first)] == one_by_one
        assert rows.row == singles.row
        step = min(first + len(contents), last + 1)
    for k in range(max(0, step - 2 * RESEND_LIMIT), min(step + RESEND_LIMIT, last) + 1, 7):
        assert rows.take(k, k) == singles.take(k, k)


def test_a_row_beyond_the_end() -> None:
    steps = ReceivedSteps(5)
    assert not steps.take_row(0, hashes_of(np.arange(7)))
    assert not steps.take_row(1, hashes_of(np.arange(3)))
    assert steps.take_row(0, hashes_of(np.arange(6)))
    assert steps.row == 5
    assert not steps.take_row(6, hashes_of(np.arange(1)))
