"""The codec of msg_analysis against ROS itself."""

import math
import random
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

pytest.importorskip("rclpy")

from msg_agents_interfaces import msg as interfaces
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String

from msg_analysis.messages import messages

U32, U64 = st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1)
NANOSECOND = st.integers(0, (2**31 - 1) * 10**9 + 999_999_999)
TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)
RUN = st.binary(min_size=16, max_size=16)
REAL = st.floats(width=64)  # infinite and not-a-number too: the codec carries, others judge
SPECIAL = np.array([math.inf, -math.inf, math.nan, -0.0, 5e-324])
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


def plain(value: Any) -> Any:
    """Numbers by their bits, so that -0.0 is not 0.0 and not-a-number is itself; sequences as lists."""
    if isinstance(value, float):
        return struct.pack("<d", value)
    return value if isinstance(value, int | str) else [plain(each) for each in np.asarray(value).tolist()]


def both_ways(message: Any) -> None:
    """Every field is read by rclpy as it was; what rclpy writes is read as the same message."""
    data = message.encode()
    ros = deserialize_message(data, getattr(interfaces, type(message).__name__))
    given = {name: getattr(message, name) for name in type(message).__slots__}
    given |= {"run": list(message.run)}
    if "arcs" in given:
        arcs = given.pop("arcs")
        given |= {name: [arc[i] for arc in arcs] for i, name in enumerate(("source", "target", "weight"))}
    stamp = ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec
    assert (stamp, ros.header.frame_id) == (given.pop("stamp"), given.pop("frame_id"))
    assert {"header", *given} == set(ros.get_fields_and_field_types())
    assert {name: plain(getattr(ros, name)) for name in given} == {name: plain(value) for name, value in given.items()}
    written = bytes(serialize_message(ros))
    assert type(message).decode(written).encode() == data
    assert messages.stamp_ns(written) == message.stamp


@quick
@given(states)
@example(messages.AgentState(0, bytes(16), 1, 0, 0, SPECIAL))
def test_agent_state(message: messages.AgentState) -> None:
    both_ways(message)


@quick
@given(graphs)
def test_active_graph(message: messages.ActiveGraph) -> None:
    both_ways(message)


@quick
@given(progresses)
def test_progress(message: messages.Progress) -> None:
    both_ways(message)


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
        assert plain(ros.state) == plain(state)
        assert frame.unwrap(serialize_message(ros)) == (7, step, 2, state.tobytes())
