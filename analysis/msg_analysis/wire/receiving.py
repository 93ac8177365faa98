"""Bytes that arrive on the topics of a run: a valid message of the run, or the reason why they are refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from msg_analysis.model.arithmetic.payload import all_finite
from msg_analysis.model.run.record import RunRecord
from msg_analysis.wire.cdr_fields import CdrError
from msg_analysis.wire.messages import ActiveGraph, AgentState, Progress, StateFrame
from msg_analysis.wire.refusals import Refusal

Message = TypeVar("Message", ActiveGraph, Progress)


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
    lists_heard = experiment.noise.loss or experiment.run.pace == "realtime"
    width = experiment.width if whole else experiment.run.replicas
    return StateFrame(record.run.bytes, width, experiment.agents - 1 if lists_heard else 0)


def why_refused(data: bytes, record: RunRecord, agent: int, frame: StateFrame) -> str:
    """The ``Refusal`` of bytes that are not a state of this agent (index from 0)."""
    try:
        message = AgentState.decode(data)
    except CdrError:
        return Refusal.UNDECODABLE
    if message.run != record.run.bytes:
        return Refusal.OTHER_RUN
    if not 1 <= message.agent <= record.experiment.agents:
        return Refusal.UNKNOWN_AGENT
    if message.agent != agent + 1:
        return Refusal.OTHER_AGENT
    return Refusal.WRONG_LENGTH if len(message.state) != frame.replicas else Refusal.OTHER_LAYOUT


def state_receiver(
    record: RunRecord,
    agent: int,  # index from 0
    frame: StateFrame,
    take: Callable[[int, int, int, bytes, bytes], str | None],  # of agent, step, mode, state, message; may refuse it
    refuse: Callable[[str], None],
    *,
    finite: bool = False,  # whether to refuse states that are not finite
) -> Callable[[bytes], None]:
    """The callback for the topic of an agent's states. Hot path."""
    unwrap, number = frame.unwrap, agent + 1

    def receive(data: bytes) -> None:
        found = unwrap(data)
        if found is None or found[0] != number:
            refuse(why_refused(data, record, agent, frame))
            return
        _, step, mode, state = found
        reason = Refusal.NOT_FINITE if finite and not all_finite(state) else take(agent, step, mode, state, data)
        if reason:
            refuse(reason)

    return receive
