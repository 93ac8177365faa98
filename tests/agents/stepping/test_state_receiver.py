"""What a recorder takes from batches, against the same messages one by one."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest

from msg_agents.stepping.state_receiver import StateReceiver
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.cdr import encode_batch
from msg_analysis.messages.messages import AgentState
from msg_analysis.messages.topics import STATE, STATES, TRUTH, TRUTHS
from msg_analysis.model.run_record import RunRecord
from msg_analysis.twin.simulate import new_record

STEPS = 200


def _record(**noise: Any) -> RunRecord:
    return new_record(
        Experiment.parse(
            {
                "name": "net",
                "graphs": {"line": {"path": [1, 2, 3]}, "star": {"star": {"center": 2}}},
                "agents": 3,
                "switching": {"generator": [[-1, 1], [1, -1]]},
                "noise": {"process": 1.0} | noise,
                "run": {"dt": 0.1, "duration": STEPS * 0.1, "replicas": 2},
            }
        )
    )


def _message(record: RunRecord, agent: int, step: int, value: float = 1.5, **changes: Any) -> bytes:
    fields = {"stamp": step * 10**8, "run": record.run.bytes, "agent": agent, "step": step, "mode": min(step, 1)}
    return AgentState(**(fields | {"state": np.array([value, -step])} | changes)).encode()


def _receiver(record: RunRecord) -> StateReceiver:
    return StateReceiver(record, STATES, STATE, "/net/")


def test_a_run_in_batches_of_any_size() -> None:
    """Every state comes out once, with its own bytes, in the order in which it came."""
    record, chance = _record(), random.Random(1)
    receiver = _receiver(record)
    sent = [(agent, step) for step in range(STEPS + 1) for agent in (1, 2, 3)]
    found, left = [], list(sent)
    while left:
        count = chance.randrange(1, 40)
        part, left = left[:count], left[count:]
        batch = encode_batch(record.run.bytes, [_message(record, *each) for each in part])
        assert receiver.add(batch) >= len(batch)
        if chance.random() < 0.5 or not left:
            received = receiver.take()
            assert received.refused == []
            for agent, step, time, start, size in zip(
                *(received.agent, received.step, received.time, received.start, received.size), strict=True
            ):
                assert received.data[start : start + size] == _message(record, agent + 1, step)
                assert time == step * 10**8
                found.append((agent + 1, step))
    assert found == sent
    assert len(receiver.take().agent) == 0
    assert receiver.names == ["/net/agent_1/state", "/net/agent_2/state", "/net/agent_3/state"]


def test_repetitions_and_contradictions() -> None:
    """Repeated states are dropped; of two different ones both are recorded, further ones are not."""
    record = _record()
    receiver = _receiver(record)
    values = [1.5, 1.5, 2.5, 3.5, 2.5]
    receiver.add(encode_batch(record.run.bytes, [_message(record, 2, 5, value) for value in values]))
    received = receiver.take()
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
    receiver = _receiver(record)
    others = {"stamp": 1, "mode": 2, "state": np.array([1.5, np.nextafter(-3.0, 0.0)]), "heard": np.array([2], "u8")}
    messages = [_message(record, 1, 3), _message(record, 1, 3, **{field: others[field]})]
    receiver.add(encode_batch(record.run.bytes, messages))
    assert receiver.take().refused == [("/net/agent_1/state", Refusal.CONTRADICTION)]


def test_what_cannot_be() -> None:
    """Every message is refused for its reason; those around it are taken."""
    record = _record()
    receiver = _receiver(record)
    name = "/net/agent_2/state"
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
    receiver.add(encode_batch(record.run.bytes, messages))
    received = receiver.take()
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
    assert received.refused == [
        ("states", Refusal.UNDECODABLE),
        ("states", Refusal.UNDECODABLE),
        ("states", Refusal.OTHER_RUN),
    ]


def test_exact_states_beside_noisy_ones() -> None:
    record = _record(broadcast=0.1)
    receiver = StateReceiver(record, TRUTHS, TRUTH, "/")
    receiver.add(encode_batch(record.run.bytes, [_message(record, 3, 0)]))
    assert receiver.take().agent.tolist() == [2]
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
