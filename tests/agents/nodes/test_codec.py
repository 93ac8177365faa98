"""The codec and the schemas of msg_analysis against ROS itself."""

from __future__ import annotations

import json
import math
import random
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from msg_agents_interfaces import msg as interfaces
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header, String

from msg_analysis.messages import messages
from msg_analysis.messages.messages import ACTIVE_GRAPH, AGENT_STATE, ESTIMATE, PROGRESS, STRING, MessageType

U32, U64 = st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1)
NANOSECOND = st.integers(0, (2**31 - 1) * 10**9 + 999_999_999)
TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)
RUN = st.binary(min_size=16, max_size=16)
REAL = st.floats(width=64)  # infinite and not-a-number too: the codec carries, others judge
quick = settings(max_examples=100, deadline=None)

states = st.builds(
    messages.AgentState,
    stamp=NANOSECOND,
    run=RUN,
    agent=U32,
    step=U64,
    mode=U32,
    state=st.lists(REAL, max_size=20).map(lambda values: np.array(values, np.float64)),
    heard=st.lists(U64, max_size=5).map(lambda values: np.array(values, np.uint64)),
    frame_id=TEXT,
)
graphs = st.builds(
    messages.ActiveGraph,
    stamp=NANOSECOND,
    run=RUN,
    sequence=U32,
    mode=U32,
    name=TEXT,
    first_step=U64,
    last_step=U64,
    arcs=st.lists(st.tuples(U32, U32, REAL), max_size=6).map(tuple),
    frame_id=TEXT,
)
progresses = st.builds(messages.Progress, stamp=NANOSECOND, run=RUN, agent=U32, step=U64, frame_id=TEXT)


def serialized(kind: Any, message: Any, names: list[str], **fields: Any) -> bytes:
    """By rclpy: header, run, and the attributes of these names."""
    seconds, nanoseconds = divmod(message.stamp, 10**9)
    header = Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=message.frame_id)
    same = {name: getattr(message, name) for name in names}
    return bytes(serialize_message(kind(header=header, run=np.frombuffer(message.run, np.uint8), **same, **fields)))


def bits(values: Any) -> list[bytes]:
    """Numbers by their bits, so that -0.0 is not 0.0 and not-a-number is itself."""
    return [struct.pack("<d", value) for value in values]


def same_header(message: Any, ros: Any) -> None:
    assert ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec == message.stamp
    assert ros.header.frame_id == message.frame_id
    assert bytes(ros.run) == message.run


@quick
@given(states)
def test_agent_state(message: messages.AgentState) -> None:
    ros = deserialize_message(message.encode(), interfaces.AgentState)
    same_header(message, ros)
    assert (ros.agent, ros.step, ros.mode) == (message.agent, message.step, message.mode)
    assert list(ros.heard) == message.heard.tolist()
    assert bits(ros.state) == bits(message.state)

    fields = {"heard": message.heard.tolist(), "state": message.state.tolist()}
    data = serialized(interfaces.AgentState, message, ["agent", "step", "mode"], **fields)
    assert messages.AgentState.decode(data).encode() == message.encode()
    assert messages.stamp_ns(data) == message.stamp


@quick
@given(graphs)
def test_active_graph(message: messages.ActiveGraph) -> None:
    ros = deserialize_message(message.encode(), interfaces.ActiveGraph)
    same_header(message, ros)
    assert (ros.sequence, ros.mode, ros.name) == (message.sequence, message.mode, message.name)
    assert (ros.first_step, ros.last_step) == (message.first_step, message.last_step)
    assert list(zip(ros.source, ros.target, bits(ros.weight), strict=True)) == [
        (source, target, *bits([weight])) for source, target, weight in message.arcs
    ]

    arcs = {name: [arc[i] for arc in message.arcs] for i, name in enumerate(("source", "target", "weight"))}
    names = ["sequence", "mode", "name", "first_step", "last_step"]
    data = serialized(interfaces.ActiveGraph, message, names, **arcs)
    assert messages.ActiveGraph.decode(data).encode() == message.encode()


@quick
@given(progresses)
def test_progress(message: messages.Progress) -> None:
    ros = deserialize_message(message.encode(), interfaces.Progress)
    same_header(message, ros)
    assert (ros.agent, ros.step) == (message.agent, message.step)
    assert messages.Progress.decode(serialized(interfaces.Progress, message, ["agent", "step"])) == message


@quick
@given(st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=300))
def test_string(text: str) -> None:
    assert deserialize_message(messages.encode_string(text), String).data == text
    assert messages.decode_string(serialize_message(String(data=text))) == text


@pytest.mark.parametrize("replicas", [1, 2, 16])
def test_the_agents_own_layout(replicas: int) -> None:
    """What goes over the network a thousand times a second."""
    rng = random.Random(replicas)
    run = rng.randbytes(16)
    codec, frame = messages.StateCodec(run, 7, replicas, 0.05), messages.StateFrame(run, replicas)
    last = 20 * 2**31 - 1  # ROS counts seconds in 32 bits
    for step in [0, 1, 19, 20, last, *(rng.randrange(last) for _ in range(50))]:
        state = np.array([rng.gauss(0, 10.0 ** rng.randint(-300, 300)) for _ in range(replicas)])
        ros = deserialize_message(codec.wrap(step, 2, state.tobytes()), interfaces.AgentState)
        assert (ros.header.stamp.sec, ros.header.stamp.nanosec) == divmod(step * 50_000_000, 10**9)
        assert (bytes(ros.run), ros.agent, ros.step, ros.mode) == (run, 7, step, 2)
        assert bits(ros.state) == bits(state)
        assert frame.unwrap(serialize_message(ros)) == (7, step, 2, state.tobytes())


def test_special_numbers_survive() -> None:
    state = np.array([math.inf, -math.inf, math.nan, -0.0, 5e-324])
    message = messages.AgentState(0, bytes(16), 1, 0, 0, state)
    assert bits(deserialize_message(message.encode(), interfaces.AgentState).state) == bits(state)


@pytest.mark.parametrize("kind", [AGENT_STATE, ACTIVE_GRAPH, ESTIMATE, PROGRESS, STRING], ids=lambda kind: kind.name)
def test_schema_and_hash_are_those_of_the_installed_package(kind: MessageType) -> None:
    share = Path(sys.prefix) / "share"
    if not (share / kind.package / "msg" / f"{kind.name}.json").exists():
        pytest.skip(f"{kind.package} is not installed: run make setup")
    parts = kind.schema.split("\n" + "=" * 80 + "\nMSG: ")
    definitions = {kind.full_name.replace("/msg/", "/"): parts[0]}
    definitions |= dict(part.split("\n", 1) for part in parts[1:])
    for name, text in definitions.items():
        package, _, message = name.partition("/")
        installed = (share / package / "msg" / f"{message}.msg").read_text()
        assert text.strip() == installed.strip()
    description = json.loads((share / kind.package / "msg" / f"{kind.name}.json").read_text())
    hashes = {entry["type_name"]: entry["hash_string"] for entry in description["type_hashes"]}
    assert kind.type_hash == hashes[kind.full_name]
    referenced = description["type_description_msg"]["referenced_type_descriptions"]
    assert {entry["type_name"].replace("/msg/", "/") for entry in referenced} == set(definitions) - {
        kind.full_name.replace("/msg/", "/")
    }
