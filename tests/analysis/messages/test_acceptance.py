"""Which bytes on the topics of a run are taken, and why others are refused."""

import hashlib
import json
import uuid
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from experiments import RunRecord, line_ring, new_record
from msg_analysis.messages.acceptance import Refusal, RunRules, sign, state_frame, state_receiver
from msg_analysis.messages.messages import ActiveGraph, AgentState, Progress, encode_string
from msg_analysis.messages.topics import END, PROGRESS, RESEND
from msg_analysis.model.graph_path import HoldingPeriod, holding_periods
from msg_analysis.model.step_model import first_graph

PAIR = {"graphs": {"line": {"path": [1, 2]}}, "switching": {}, "run": {"dt": 0.1, "duration": 1, "start": "zero"}}
RECORD = new_record(line_ring(**PAIR), uuid.UUID(int=4))
RUN, OTHER = RECORD.run.bytes, uuid.UUID(int=5).bytes


def state(**changes: Any) -> bytes:
    fields: dict[str, Any] = {"stamp": 0, "run": RUN, "agent": 2, "step": 3, "mode": 1, "state": np.ones(2)}
    return AgentState(**fields | changes).encode()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", Refusal.UNDECODABLE),
        (state()[:-1], Refusal.UNDECODABLE),
        (state(run=OTHER), Refusal.OTHER_RUN),
        (state(run=OTHER, agent=7), Refusal.OTHER_RUN),
        (state(agent=0), Refusal.UNKNOWN_AGENT),
        (state(agent=3), Refusal.UNKNOWN_AGENT),
        (state(agent=1), Refusal.OTHER_AGENT),
        (state(state=np.ones(3)), Refusal.WRONG_LENGTH),
        (state(frame_id="map"), Refusal.OTHER_LAYOUT),
        (state(heard=np.array([2], np.uint64)), Refusal.OTHER_LAYOUT),
        (state(state=np.array([1, np.nan])), Refusal.NOT_FINITE),
        (state(mode=2), Refusal.UNKNOWN_MODE),
        (state(mode=0), Refusal.UNKNOWN_MODE),
        (state(step=0), Refusal.UNKNOWN_MODE),
        (state(step=9), "of the receiver"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_refused_states(data: bytes, reason: str) -> None:
    taken, refused = [], []

    def take(agent: int, step: int, mode: int, payload: bytes, message: bytes) -> str | None:
        taken.append((agent, step, mode, payload, message))
        return "of the receiver" if step == 9 else None

    receive = state_receiver(RECORD, 1, state_frame(RECORD, whole=False), take, refused.append, possible=True)
    receive(state())
    assert (taken.pop(), refused) == ((1, 3, 1, np.ones(2).tobytes(), state()), [])
    receive(data)
    assert refused == [reason]
    assert bool(taken) == (reason == "of the receiver")


@pytest.mark.parametrize(("changes", "listed"), [({}, 0), ({"noise": {"loss": 0.1}}, 1)])
def test_longest_message(changes: dict[str, Any], listed: int) -> None:
    """Only where messages may be lost, or in real time, does a state list what was heard."""
    record = new_record(RECORD.experiment.parse(RECORD.experiment.to_document() | changes))
    assert state_frame(record, whole=True).size == len(state()) + 8 * listed


SWITCHING = new_record(line_ring(run={"duration": 50, "start": "zero", "replicas": 1}))
PATH = list(holding_periods(SWITCHING.experiment, first_graph(SWITCHING.experiment)))


def published(holding: HoldingPeriod, **changes: Any) -> bytes:
    graph = SWITCHING.experiment.graph_list[holding.mode]
    fields = {"mode": holding.mode + 1, "name": graph.name, "arcs": graph.arcs, "sequence": holding.sequence}
    fields |= {"first_step": holding.first_step, "last_step": holding.last_step}
    stamp = holding.first_step * 50_000_000
    return ActiveGraph(**{"stamp": stamp, "run": SWITCHING.run.bytes} | fields | changes).encode()


def test_the_graph_is_compared_with_the_record() -> None:
    """Every holding period in any order passes; one with any other field, or one that the run has not, does not."""
    rules = RunRules(SWITCHING)
    for holding in [*reversed(PATH), *PATH]:
        assert isinstance(rules.graph(published(holding)), ActiveGraph)
    first = PATH[0]
    for changes in (
        {"mode": 0},
        {"mode": 2 - first.mode},
        {"mode": 9},
        {"name": "x"},
        {"last_step": first.last_step + 1},
        {"last_step": 10**9},
        {"first_step": 1},
        {"arcs": []},
        {"arcs": [(1, 2, 0.5)]},
        {"stamp": 7},
        {"frame_id": "map"},
        {"sequence": 1},
    ):
        assert rules.graph(published(first, **changes)) == Refusal.NOT_OF_RECORD, changes
    assert rules.graph(published(first, sequence=len(PATH))) == Refusal.GRAPH_OUT_OF_RANGE
    assert rules.graph(published(first, sequence=2**32 - 1)) == Refusal.TOO_EARLY
    assert rules.graph(published(first, run=OTHER)) == Refusal.OTHER_RUN
    assert rules.graph(b"") == Refusal.UNDECODABLE


def test_old_holding_periods_are_forgotten() -> None:
    rules = RunRules(SWITCHING)
    rules.forget(500)
    for holding in PATH:
        found = rules.graph(published(holding))
        assert (found == Refusal.REPEATED) == (holding.last_step < 500)
    rules.forget(10**6)
    assert {rules.graph(published(holding)) for holding in PATH} == {Refusal.REPEATED}


def test_the_record_is_compared() -> None:
    rules, text = RunRules(RECORD), RECORD.to_json()
    assert "key" not in json.loads(text)
    assert rules.experiment(encode_string(text)) is None
    assert rules.experiment(encode_string(text) + b"\0\0") is None  # padding of the middleware
    read = RunRecord.from_json(RECORD.to_json(with_key=True), "run.json")
    assert read.key == RECORD.key
    assert RunRules(read).experiment(encode_string(text)) is None
    assert rules.experiment(encode_string(text.replace("0.1", "0.2"))) == Refusal.NOT_OF_RECORD
    assert rules.experiment(encode_string(new_record(RECORD.experiment).to_json())) == Refusal.OTHER_RUN
    for wrong in (b"", encode_string("["), encode_string("[1]"), encode_string("[" * 10_000)):
        assert rules.experiment(wrong) == Refusal.UNDECODABLE


def test_what_steers_a_run_is_signed() -> None:
    """The signature is HMAC-SHA256 (RFC 2104) of topic and message, as hashlib has it."""
    rules, message = RunRules(RECORD), Progress(7, RUN, 2, 3)
    assert rules.progress(message.encode(), PROGRESS) == Refusal.NOT_SIGNED
    signed = sign(message, PROGRESS, RECORD.key)
    block = RECORD.key.ljust(64, b"\0")
    inner = hashlib.sha256(bytes(b ^ 0x36 for b in block) + b"progress\0" + message.encode()).digest()
    assert signed.frame_id == hashlib.sha256(bytes(b ^ 0x5C for b in block) + inner).hexdigest()[:32]
    assert rules.progress(signed.encode(), PROGRESS) == signed
    for topic, changes in (
        (RESEND, {}),
        (PROGRESS, {"step": 4}),
        (PROGRESS, {"agent": 1}),
        (PROGRESS, {"stamp": 8}),
        (PROGRESS, {"frame_id": signed.frame_id[:-1] + "\N{SNOWMAN}"}),
    ):
        assert rules.progress(replace(signed, **changes).encode(), topic) == Refusal.NOT_SIGNED
    for topic, changes, reason in (
        (PROGRESS, {"agent": 3}, Refusal.UNKNOWN_AGENT),
        (END, {"agent": 2}, Refusal.UNKNOWN_AGENT),
        (PROGRESS, {"step": 11}, Refusal.OUT_OF_RANGE),
        (PROGRESS, {"run": OTHER}, Refusal.OTHER_RUN),
    ):
        forged = sign(replace(message, **changes), topic, RECORD.key)
        assert rules.progress(forged.encode(), topic) == reason
    without = replace(RECORD, key=None)
    assert RunRules(without).progress(message.encode(), PROGRESS) == message
    assert sign(message, PROGRESS, None) == message


def test_the_last_that_is_taken() -> None:
    """The last step, the last agent, and the graph as far ahead as it may be; agents do not sign what the run does."""
    rules, last = RunRules(RECORD), Progress(7, RUN, 2, 10)
    for message, topic in ((last, PROGRESS), (replace(last, agent=0), END)):
        signed = sign(message, topic, RECORD.key)
        assert rules.progress(signed.encode(), topic) == signed
    assert rules.progress(sign(replace(last, agent=1), END, RECORD.key).encode(), END) == Refusal.UNKNOWN_AGENT
    ahead = RunRules(SWITCHING)
    assert ahead.graph(published(PATH[0], sequence=10_000)) == Refusal.GRAPH_OUT_OF_RANGE
    assert ahead.graph(published(PATH[0], sequence=10_001)) == Refusal.TOO_EARLY


def test_impossible_states_are_refused_only_where_that_is_asked_for() -> None:
    """Agents leave it to their synchronizer; the recorder asks for it."""
    taken, refused = [], []
    receive = state_receiver(
        RECORD, 1, state_frame(RECORD, whole=False), lambda *found: taken.append(found), refused.append
    )
    receive(state(mode=2))
    assert (len(taken), refused) == (1, [])
