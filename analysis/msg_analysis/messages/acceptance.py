# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Which messages of a run are accepted, and why others are rejected: the rules of all nodes and of the bag reader.

What follows from the run record is compared with it, as the graph is. Progress, end, epoch, leave and requests to
resend do not: they are signed with the key of the record, since who forges one could end the run for all.
"""

from __future__ import annotations

import hmac
import json
import math
from collections.abc import Callable
from dataclasses import fields, replace
from functools import cached_property
from typing import TypeVar

from msg_analysis.arithmetic.reproducible import StepClock
from msg_analysis.arithmetic.update_law import all_finite
from msg_analysis.messages.cdr import CdrError
from msg_analysis.messages.messages import ActiveGraph, AgentState, Progress, StateFrame, decode_string, encode_string
from msg_analysis.messages.topics import END, EPOCH, RECORD, STOP, Topic
from msg_analysis.model.graph_path import HoldingPeriod, PathWindow
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import first_graph


class Refusal:
    """Why a message is rejected: keys in results and diagnostics; docs/faults.md and docs/messages.md list them."""

    OTHER_RUN = "other run"
    OTHER_EPOCH = "other epoch"
    UNDECODABLE = "undecodable"
    COMPRESSED = "compressed message"
    REPEATED = "received again"  # harmless: nodes send again what a restarted one may have missed
    CONTRADICTION = "contradicts an earlier copy"
    NOT_OF_RECORD = "contradicts the run record"
    NOT_SIGNED = "not signed with the key of the run"
    NEGATIVE_TIME = "negative time"  # on /clock
    DUPLICATE_NAME = "duplicate node name"  # not of a message

    # States
    UNKNOWN_AGENT = "unknown agent"
    OTHER_AGENT = "of another agent than its topic"
    NOT_A_PEER = "not a peer"
    WRONG_LENGTH = "wrong length"
    OTHER_LAYOUT = "not in the layout of the agents"
    NOT_FINITE = "not finite"
    UNKNOWN_MODE = "unknown mode"
    OTHER_MODES = "agents used different graphs"
    BAD_HEARD = "impossible entry in heard"
    BEFORE_START = "stamped before the start"
    OUT_OF_RANGE = "step out of range"
    TOO_OLD = "step too old"
    TOO_NEW = "a step that a peer cannot have reached"
    TOO_LATE = "too late"

    # Holding periods of the graph
    OUT_OF_SEQUENCE = "a holding period out of sequence"
    TOO_EARLY = "a holding period before its time"
    GRAPH_OUT_OF_RANGE = "graph out of range"
    OTHER_GRAPH = "graph of a step that its states contradict"

    # Files of a bag
    UNREADABLE_FILE = "unreadable file"
    TORN_FILE = "torn file"
    DAMAGED_CHUNK = "damaged chunk"


SIZE = 16  # bytes of the HMAC-SHA256 that are sent, as hexadecimal digits in ``frame_id``


def sign(message: Progress, topic: Topic, key: bytes | None) -> Progress:
    """The message with its signature for a topic; without a key, as it is."""
    return message if key is None else replace(message, frame_id=_signature(message, topic, key))


def genuine(message: Progress, topic: Topic, key: bytes | None) -> bool:
    """Whether the signature is right; without a key, every message passes."""
    return key is None or hmac.compare_digest(message.frame_id.encode(), _signature(message, topic, key).encode())


def _signature(message: Progress, topic: Topic, key: bytes) -> str:
    unsigned = replace(message, frame_id="").encode()
    return hmac.digest(key, topic.name.encode() + b"\0" + unsigned, "sha256")[:SIZE].hex()


Message = TypeVar("Message", ActiveGraph, Progress)


class RunRules:
    """Which messages belong to a run, on all topics but those of the states."""

    def __init__(self, record: RunRecord) -> None:
        self._record = record
        self._path = PathWindow(record.experiment, first_graph(record.experiment))

    @cached_property
    def _experiment(self) -> bytes:
        """The message on the topic ``experiment``: only the recorder compares it, so others do not make it."""
        return encode_string(self._record.to_json())

    def experiment(self, data: bytes) -> str | None:
        """The ``Refusal`` of a message on the topic ``experiment``; None: it is the record of this run."""
        if data.rstrip(b"\0") == self._experiment.rstrip(b"\0"):  # middleware pads messages to a multiple of four
            return None
        try:
            run = json.loads(decode_string(data))["run"]
        except (ValueError, KeyError, TypeError, RecursionError):  # CdrError and JSON's own among them
            return Refusal.UNDECODABLE
        return Refusal.NOT_OF_RECORD if run == str(self._record.run) else Refusal.OTHER_RUN

    def forget(self, step: int) -> None:
        """From now on, holding periods that end before a step are refused as repeated."""
        self._path.forget(step)

    def graph(self, data: bytes) -> ActiveGraph | str:
        """A holding period of the graph, or a ``Refusal``."""
        message = decode_of_run(ActiveGraph, data, self._record.run.bytes)
        if isinstance(message, str):
            return message
        if message.sequence < self._path.first:
            return Refusal.REPEATED
        if message.sequence > self._path.first + self._path.MOST_AHEAD:
            return Refusal.TOO_EARLY
        holding = self._path.holding(message.sequence)
        if holding is None:
            return Refusal.GRAPH_OUT_OF_RANGE
        true = graph_message(self._record, holding)
        same = all(getattr(message, field.name) == getattr(true, field.name) for field in fields(ActiveGraph))
        return message if same else Refusal.NOT_OF_RECORD

    def progress(self, data: bytes, topic: Topic) -> Progress | str:
        """A message on one of the topics of type Progress, or a ``Refusal``."""
        message = decode_of_run(Progress, data, self._record.run.bytes)
        if isinstance(message, str):
            return message
        if message.agent > (0 if topic in (END, EPOCH, STOP, RECORD) else self._record.experiment.agents):
            return Refusal.UNKNOWN_AGENT
        if message.step > self._record.experiment.steps:
            return Refusal.OUT_OF_RANGE
        return message if genuine(message, topic, self._record.key) else Refusal.NOT_SIGNED


def graph_message(record: RunRecord, holding: HoldingPeriod) -> ActiveGraph:
    """What the switcher publishes of a holding period."""
    graph = record.experiment.graph_list[holding.mode]
    return ActiveGraph(
        stamp=StepClock(record.experiment.step_length).nanoseconds(holding.first_step),
        run=record.run.bytes,
        sequence=holding.sequence,
        mode=holding.mode + 1,
        name=graph.name,
        first_step=holding.first_step,
        last_step=holding.last_step,
        arcs=tuple(graph.arcs),
    )


def decode_of_run(kind: type[Message], data: bytes, run: bytes) -> Message | str:
    """A message of the run with this id (16 bytes), or a ``Refusal``."""
    try:
        message = kind.decode(data)
    except CdrError:
        return Refusal.UNDECODABLE
    return message if message.run == run else Refusal.OTHER_RUN


def state_frame(record: RunRecord, *, whole: bool) -> StateFrame:
    """Reads the states of a run: the whole ones, or those that agents publish on the topic ``state``."""
    experiment = record.experiment
    lists_heard = experiment.noise.loss.any or experiment.run.pace == "realtime"
    width = experiment.width if whole else experiment.run.replicas
    return StateFrame(record.run.bytes, width, experiment.agents - 1 if lists_heard else 0)


def why_refused(data: bytes, record: RunRecord, agent: int | None, frame: StateFrame) -> str:
    """The ``Refusal`` of bytes that are not a state of this agent (index from 0; None: of any agent)."""
    try:
        message = AgentState.decode(data)
    except CdrError:
        return Refusal.UNDECODABLE
    if message.run != record.run.bytes:
        return Refusal.OTHER_RUN
    if not 1 <= message.agent <= record.experiment.agents:
        return Refusal.UNKNOWN_AGENT
    if agent is not None and message.agent != agent + 1:
        return Refusal.OTHER_AGENT
    return Refusal.WRONG_LENGTH if len(message.state) != frame.replicas else Refusal.OTHER_LAYOUT


def fault_of(step: int, mode: int, state: bytes, graphs: int) -> str | None:
    """The ``Refusal`` of a state that no agent can have in a run with so many graphs; None: it is possible."""
    if mode > graphs or (mode == 0) != (step == 0):
        return Refusal.UNKNOWN_MODE
    return None if all_finite(state) else Refusal.NOT_FINITE


def finite_number(text: str) -> float:
    """A number that came as text; ValueError: it is none, or not finite."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def state_receiver(
    record: RunRecord,
    agent: int,  # index from 0
    frame: StateFrame,
    take: Callable[[int, int, int, bytes, bytes], str | None],  # of agent, step, mode, state, message; may refuse it
    refuse: Callable[[str], None],
    *,
    possible: bool = False,  # whether to refuse states that ``fault_of`` finds impossible
) -> Callable[[bytes], None]:
    """The callback for the topic of an agent's states. Hot path."""
    unwrap, number, graphs = frame.unwrap, agent + 1, len(record.experiment.graph_list)

    def receive(data: bytes) -> None:
        found = unwrap(data)
        if found is None or found[0] != number:
            refuse(why_refused(data, record, agent, frame))
            return
        _, step, mode, state = found
        reason = (possible and fault_of(step, mode, state, graphs)) or take(agent, step, mode, state, data)
        if reason:
            refuse(reason)

    return receive
