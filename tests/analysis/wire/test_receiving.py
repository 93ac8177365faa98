"""Which bytes on the topics of a run are taken, and why others are refused."""

from __future__ import annotations

import uuid
from typing import Any

import numpy as np
import pytest

from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.twin.simulate import new_record
from msg_analysis.wire.messages import AgentState, Progress
from msg_analysis.wire.receiving import decode_of_run, state_frame, state_receiver
from msg_analysis.wire.refusals import Refusal

RECORD = new_record(
    ValidExperiment.parse(
        {
            "name": "pair",
            "graphs": {"line": {"path": [1, 2]}},
            "run": {"dt": 0.1, "duration": 1, "start": "zero", "replicas": 2},
        }
    ),
    uuid.UUID(int=4),
)
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
        (state(step=9), "of the receiver"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_refused_states(data: bytes, reason: str) -> None:
    taken, refused = [], []

    def take(agent: int, step: int, mode: int, payload: bytes, message: bytes) -> str | None:
        taken.append((agent, step, mode, payload, message))
        return "of the receiver" if step == 9 else None

    receive = state_receiver(RECORD, 1, state_frame(RECORD, whole=False), take, refused.append, finite=True)
    receive(state())
    assert (taken.pop(), refused) == ((1, 3, 1, np.ones(2).tobytes(), state()), [])
    receive(data)
    assert refused == [reason]
    assert bool(taken) == (reason == "of the receiver")


def test_messages_of_the_run() -> None:
    progress = Progress(1, RUN, 2, 3)
    assert decode_of_run(Progress, progress.encode(), RUN) == progress
    assert decode_of_run(Progress, progress.encode(), OTHER) == Refusal.OTHER_RUN
    assert decode_of_run(Progress, progress.encode()[:-1], RUN) == Refusal.UNDECODABLE


@pytest.mark.parametrize(("changes", "listed"), [({}, 0), ({"noise": {"loss": 0.1}}, 1)])
def test_longest_message(changes: dict[str, Any], listed: int) -> None:
    """Only where messages may be lost, or in real time, does a state list what was heard."""
    record = new_record(RECORD.experiment.parse(RECORD.experiment.to_document() | changes))
    assert state_frame(record, whole=True).size == len(state()) + 8 * listed
