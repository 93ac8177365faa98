"""Files are those of the library ``mcap``, byte for byte, where it compresses as much as we do."""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import partial

import mcap.writer
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Attachment
from mcap.writer import CompressionType, Writer

from msg_analysis.bags import mcap_writing
from msg_analysis.bags.mcap_writing import McapWriter
from msg_analysis.bags.stored_file import MESSAGE_HEAD, Compression

TYPES = {"none": CompressionType.NONE, "zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}
MESSAGES = st.lists(
    st.one_of(
        st.tuples(st.integers(1, 4), st.integers(0, 2**64 - 1), st.binary(max_size=300), st.integers(0, 2**32 - 1)),
        st.sampled_from(["flush", "metadata"]),
    ),
    max_size=60,
)


@pytest.fixture(scope="module", autouse=True)
def _same_level() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap.writer.zstandard, "compress", partial(zstandard.compress, level=mcap_writing.ZSTD_LEVEL))
        yield


@given(MESSAGES, st.sampled_from(sorted(TYPES)), st.sampled_from([100, 2000, 10**6]))
def test_bytes(actions: list[tuple[int, int, bytes, int] | str], compression: Compression, chunk_size: int) -> None:
    ours, theirs = io.BytesIO(), io.BytesIO()
    writer = McapWriter(ours, chunk_size=chunk_size, compression=compression)
    library = Writer(theirs, chunk_size=chunk_size, compression=TYPES[compression])
    library.start(profile="ros2", library="mcap")
    for name in ("one", "two"):
        schema = writer.register_schema(name, "ros2msg", b"float64 x" * 9)
        assert schema == library.register_schema(name, "ros2msg", b"float64 x" * 9)
        for topic in ("/a", "/é"):
            number = writer.register_channel(f"{topic}_{name}", "cdr", schema, {"qos": "reliable"})
            assert number == library.register_channel(f"{topic}_{name}", "cdr", schema, {"qos": "reliable"})
    for action in actions:
        if action == "flush":
            writer.flush()
            library.flush()
        elif action == "metadata":
            writer.add_metadata("record", {"a": "b", "é": "ü" * 50})
            library.add_metadata("record", {"a": "b", "é": "ü" * 50})
        else:
            channel, time, data, sequence = action
            writer.add_message(channel, time, data, sequence)
            library.add_message(channel, time, data, time, sequence)
    assert ours.getvalue() == theirs.getvalue()  # what a killed process leaves is the same too
    writer.finish()
    library.finish()
    assert ours.getvalue() == theirs.getvalue()


@pytest.mark.parametrize("size", [0, 70_000])
def test_without_a_message(size: int) -> None:
    """A long head alone makes no chunk, at the end neither."""
    ours, theirs = io.BytesIO(), io.BytesIO()
    writer = McapWriter(ours, chunk_size=100, compression="none")
    library = Writer(theirs, chunk_size=100, compression=CompressionType.NONE)
    library.start(profile="ros2", library="mcap")
    for each in (writer, library):
        each.register_schema("one", "ros2msg", b"x" * size)
        each.finish()
    assert ours.getvalue() == theirs.getvalue()


BATCHES = st.lists(
    st.one_of(
        st.lists(
            st.tuples(
                st.integers(1, 4),
                st.integers(0, 2**32 - 1),
                st.integers(0, 2**64 - 1),
                st.integers(0, 2**64 - 1),
                st.binary(max_size=90),
            ),
            max_size=40,
        ),
        st.sampled_from(["flush", "attachment", "one"]),
    ),
    max_size=12,
)


@given(BATCHES, st.sampled_from([100, 2000, 10**6]))
def test_many_messages_at_once(actions: list[list[tuple[int, int, int, int, bytes]] | str], chunk_size: int) -> None:
    """The same bytes as one by one, chunks, indexes, attachments and all."""
    ours, theirs = io.BytesIO(), io.BytesIO()
    writer = McapWriter(ours, chunk_size=chunk_size, compression="zstd", profile="x", library="y")
    library = Writer(theirs, chunk_size=chunk_size, compression=CompressionType.ZSTD)
    library.start(profile="x", library="y")
    for each in (writer, library):
        schema = each.register_schema("one", "ros2msg", b"float64 x")
        for topic in "abcd":
            each.register_channel(topic, "cdr", schema, {})
    for action in actions:
        if action == "flush":
            writer.flush()
            library.flush()
        elif action == "attachment":
            writer.add_attachment(Attachment(3, 4, "é", "text/plain", b"data"))
            library.add_attachment(3, 4, "é", "text/plain", b"data")
        elif action == "one":
            writer.add_message(3, 17, b"single", 5)
            library.add_message(3, 17, b"single", 17, 5)
        else:
            head = np.array([message[:4] for message in action], dtype=MESSAGE_HEAD)
            data = b"-" + b"-".join(message[4] for message in action)
            size = np.array([len(message[4]) for message in action], dtype=np.int64)
            writer.add_messages(head, data, np.cumsum(size + 1) - size, size)
            for channel, sequence, log_time, publish_time, content in action:
                library.add_message(channel, log_time, content, publish_time, sequence)
    assert ours.getvalue() == theirs.getvalue()
    writer.finish()
    library.finish()
    assert ours.getvalue() == theirs.getvalue()


def test_more_indexes_than_the_memory_is_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_writing, "INDEXES_IN_MEMORY", 1000)
    ours, theirs = io.BytesIO(), io.BytesIO()
    writer = McapWriter(ours, chunk_size=50, compression="none")
    library = Writer(theirs, chunk_size=50, compression=CompressionType.NONE)
    library.start(profile="ros2", library="mcap")
    for each in (writer, library):
        each.register_channel("/a", "cdr", each.register_schema("one", "ros2msg", b"float64 x"), {})
    for time in range(200):
        writer.add_message(1, time, bytes(40), time)
        library.add_message(1, time, bytes(40), time, time)
    writer.finish()
    library.finish()
    assert ours.getvalue() == theirs.getvalue()
