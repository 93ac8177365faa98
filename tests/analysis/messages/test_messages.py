"""The codec against hand-made bytes and against rosbags' independent serializer."""

import contextlib
import random
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from msg_analysis.messages.cdr import CdrError
from msg_analysis.messages.messages import (
    ActiveGraph,
    AgentState,
    Progress,
    StateCodec,
    StateFrame,
    decode_string,
    encode_string,
    stamp_ns,
    with_state,
)

RUN = bytes(range(16))
U32, U64 = st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1)
TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=9)
REAL = st.floats(allow_nan=False)
quick = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def _header(typestore: Any, stamp: int, frame_id: str) -> Any:
    time = typestore.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return typestore.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def _oracle(typestore: Any, message: AgentState | ActiveGraph | Progress, little: bool = True) -> bytes:
    """The bytes that rosbags makes of the same message."""
    name = f"msg_agents_interfaces/msg/{type(message).__name__}"
    fields: dict[str, Any] = {"header": _header(typestore, message.stamp, message.frame_id)}
    fields["run"] = np.frombuffer(message.run, np.uint8)
    if isinstance(message, ActiveGraph):
        source, target, weight = zip(*message.arcs, strict=True) if message.arcs else ((), (), ())
        fields |= {
            "sequence": message.sequence,
            "mode": message.mode,
            "name": message.name,
            "first_step": message.first_step,
            "last_step": message.last_step,
            "source": np.array(source, np.uint32),
            "target": np.array(target, np.uint32),
            "weight": np.array(weight, np.float64),
        }
    else:
        fields |= {"agent": message.agent, "step": message.step}
    if isinstance(message, AgentState):
        fields |= {"mode": message.mode, "heard": message.heard, "state": message.state}
    return bytes(typestore.serialize_cdr(typestore.types[name](**fields), name, little_endian=little))


def _same(one: Any, other: Any) -> None:
    for name in one.__slots__:
        a, b = getattr(one, name), getattr(other, name)
        assert np.array_equal(a, b), name


ARCS = st.lists(st.tuples(U32, U32, REAL), min_size=1, max_size=4).map(tuple)
ANY = st.one_of(
    st.builds(
        AgentState,
        *(st.integers(0, 10**15), st.just(RUN), U32, U64, U32),
        st.lists(REAL, min_size=1, max_size=4).map(np.array),
        st.lists(U64, max_size=4).map(lambda steps: np.array(steps, np.uint64)),
        TEXT,
    ),
    st.builds(ActiveGraph, st.just(5 * 10**9 + 3), st.just(RUN), st.just(4), U32, TEXT, U64, U64, ARCS, TEXT),
    st.builds(Progress, st.just(17), st.just(RUN), U32, U64, TEXT),
)


@quick
@given(ANY, st.booleans())
def test_messages_against_rosbags(typestore: Any, message: Any, little: bool) -> None:
    decode = type(message).decode
    _same(decode(_oracle(typestore, message, little)), message)
    assert message.encode() == _oracle(typestore, message)
    _same(decode(message.encode()), message)


@quick
@given(TEXT)
def test_string_against_rosbags(typestore: Any, text: str) -> None:
    name = "std_msgs/msg/String"
    data = bytes(typestore.serialize_cdr(typestore.types[name](data=text), name))
    assert encode_string(text) == data
    assert decode_string(data) == text
    assert decode_string(data + b"\x00\x00") == text  # middleware may pad


@pytest.mark.parametrize(
    "message",
    [
        AgentState(5, RUN, 1, 2, 1, np.ones(3), np.array([1, 2], np.uint64), "base"),
        ActiveGraph(5, RUN, 0, 1, "line", 0, 9, ((1, 2, 0.5), (2, 1, 0.5)), "base"),
        Progress(5, RUN, 1, 2),
    ],
    ids=["AgentState", "ActiveGraph", "Progress"],
)
def test_damaged_bytes_are_refused_and_cost_no_memory(message: AgentState | ActiveGraph | Progress) -> None:
    decode, data = type(message).decode, message.encode()
    for length in range(len(data)):
        with pytest.raises(CdrError):
            decode(data[:length])
    with pytest.raises(CdrError, match="too many"):
        decode(data + bytes(8))
    rng = random.Random(3)
    for _ in range(300):
        garbage = bytearray(data)
        for _ in range(4):
            garbage[rng.randrange(len(garbage))] = rng.choice([0, 1, 0x7F, 0xFF])
        with contextlib.suppress(CdrError):  # any other exception fails the test
            decode(bytes(garbage))


def test_messages_name_the_field() -> None:
    data = AgentState(5, RUN, 1, 2, 1, np.ones(1)).encode()
    with pytest.raises(CdrError, match=r"AgentState\.state: needs"):
        AgentState.decode(data[:-1])
    huge = bytearray(data)
    huge[60:64] = b"\xff\xff\xff\xff"  # four thousand million numbers
    with pytest.raises(CdrError, match=r"AgentState\.state"):
        AgentState.decode(bytes(huge))
    with pytest.raises(CdrError, match="CDR header"):
        AgentState.decode(b"\x00\x07" + data[2:])
    with pytest.raises(CdrError, match="UTF-8"):
        decode_string(b"\x00\x01\x00\x00\x02\x00\x00\x00\xff\x00")
    with pytest.raises(CdrError, match="NUL"):
        decode_string(b"\x00\x01\x00\x00\x02\x00\x00\x00ab")
    with pytest.raises(CdrError, match="stamp"):
        stamp_ns(b"\x00\x01")


@pytest.mark.parametrize("replicas", [1, 16])
@pytest.mark.parametrize("heard", [[], [8], [8, 2**64 - 1, 8]])
def test_fast_codec_is_the_general_one(typestore: Any, replicas: int, heard: list[int]) -> None:
    payload = struct.pack(f"<{replicas}d", *range(replicas))
    codec, state = StateCodec(RUN, 7, replicas, 0.25), np.arange(replicas, dtype=float)
    data = codec.wrap(9, 1, payload, heard)
    assert stamp_ns(data) == 2_250_000_000
    message = AgentState(2_250_000_000, RUN, 7, 9, 1, state, np.array(heard, np.uint64))
    assert data == message.encode() == _oracle(typestore, message)
    frame = StateFrame(RUN, replicas, 3)
    assert frame.unwrap(data) == (7, 9, 1, payload)
    assert len(data) <= frame.size
    other = struct.pack(f"<{replicas}d", *range(1, replicas + 1))
    assert frame.unwrap(with_state(data, other)) == (7, 9, 1, other)
    assert AgentState.decode(with_state(data, other)).heard.tolist() == heard
    for length in (1, 5):
        decoded = AgentState.decode(with_state(data, bytes(8 * length), len(other)))
        assert (decoded.state.tolist(), decoded.heard.tolist(), decoded.step) == ([0.0] * length, heard, 9)
    for most in range(len(heard)):  # of a run in which less can be lost
        assert StateFrame(RUN, replicas, most).unwrap(data) is None


def test_frame_refuses_what_is_not_its_own() -> None:
    """Every length, every byte before the state changed, another layout of the expected length."""
    frame, good = StateFrame(RUN, 2, 3), StateCodec(RUN, 1, 2, 0.1).wrap(2, 1, bytes(16), [1, 1])
    other = AgentState(5, RUN, 1, 2, 1, np.ones(1), np.array([1], np.uint64)).encode()
    assert len(other) == len(StateCodec(RUN, 1, 2, 0.1).wrap(2, 1, bytes(16), []))
    assert StateFrame(RUN, 2).unwrap(other) is frame.unwrap(other) is None
    assert frame.unwrap(good) == (1, 2, 1, bytes(16))
    assert all(frame.unwrap(good[:length]) is None for length in range(len(good)))
    for place in [*range(4), *range(12, 33), *range(56, 60), *range(76, 80)]:  # header, frame_id, run, both lengths
        assert frame.unwrap(good[:place] + bytes([good[place] ^ 0xFF]) + good[place + 1 :]) is None, place


def test_an_id_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="run"):
        StateCodec(b"short", 1, 2, 0.1)
