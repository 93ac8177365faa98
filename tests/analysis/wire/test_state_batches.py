"""Batches of states against hand-made bytes and the definition of the message."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from msg_analysis.messages.cdr import CdrError, decode_batch, encode_batch
from msg_analysis.messages.messages import STATE_BATCH

RUN = bytes(range(16))


def test_bytes() -> None:
    head = b"\x00\x01\x00\x00" + RUN + struct.pack("<III", 2, 3, 1)
    assert encode_batch(RUN, [b"abc", b"d"]) == head + struct.pack("<I", 4) + b"abcd"


@given(st.lists(st.binary(max_size=50), max_size=9))
def test_another_library_reads_it(messages: list[bytes]) -> None:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(STATE_BATCH.schema, STATE_BATCH.full_name))
    data = encode_batch(RUN, messages)
    found = store.deserialize_cdr(data, STATE_BATCH.full_name)
    assert bytes(found.run) == RUN
    assert found.size.tolist() == [len(message) for message in messages]
    assert found.messages.tobytes() == b"".join(messages)
    run, size, joined = decode_batch(data)
    assert (run, size.tolist(), joined) == (RUN, found.size.tolist(), b"".join(messages))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "begins with nothing"),
        (b"\x00\x01\x00\x00" + RUN, "size"),
        (encode_batch(RUN, [b"abcd"])[:-1], "messages"),
        (encode_batch(RUN, [b"abcd"]) + bytes(8), "8 bytes too many"),
        (encode_batch(RUN, [b"abcd"]).replace(struct.pack("<II", 1, 4), struct.pack("<II", 1, 5)), "sizes of 5 bytes"),
        (b"\x00\x01\x00\x00" + RUN + struct.pack("<I", 2**31), "size"),
    ],
)
def test_what_is_none(data: bytes, words: str) -> None:
    with pytest.raises(CdrError, match=words):
        decode_batch(data)
