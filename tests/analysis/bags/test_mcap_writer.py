"""Files are those of the library ``mcap``, byte for byte, at the level of compression of zstd itself."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Attachment
from mcap.writer import CompressionType, Writer

from msg_analysis.bags.mcap_writing import McapWriter
from msg_analysis.bags.stored_file import MESSAGE_HEAD, Compression

TIMES = st.integers(0, 2**64 - 1)
TYPES = {"none": CompressionType.NONE, "zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}


NUMBERS = st.lists(
    st.tuples(st.integers(1, 4), st.integers(0, 2**32 - 1), TIMES, TIMES, st.binary(max_size=300)), max_size=40
)
ACTIONS = st.tuples(st.sampled_from(["one by one", "at once", "flush", "metadata", "attachment"]), NUMBERS)


@given(st.lists(ACTIONS, max_size=20), st.sampled_from(sorted(TYPES)), st.sampled_from([100, 2000, 10**6]))
def test_bytes(
    actions: list[tuple[str, list[tuple[int, int, int, int, bytes]]]], compression: Compression, chunk_size: int
) -> None:
    """Chunks, indexes, attachments and all; of the library, messages come one by one."""
    ours, theirs = io.BytesIO(), io.BytesIO()
    writer = McapWriter(ours, chunk_size=chunk_size, compression=compression, level=3, profile="x", library="y")
    library = Writer(theirs, chunk_size=chunk_size, compression=TYPES[compression])
    library.start(profile="x", library="y")
    for each in (writer, library):
        for name in ("one", "two"):
            schema = each.register_schema(name, "ros2msg", b"float64 x" * 9)
            for topic in ("/a", "/é"):
                each.register_channel(f"{topic}_{name}", "cdr", schema, {"qos": "reliable"})
    for action, messages in actions:
        if action == "flush":
            writer.flush()
            library.flush()
        elif action == "metadata":
            writer.add_metadata("record", {"a": "b", "é": "ü" * 50})
            library.add_metadata("record", {"a": "b", "é": "ü" * 50})
        elif action == "attachment":
            writer.add_attachment(Attachment(3, 4, "é", "text/plain", b"data"))
            library.add_attachment(3, 4, "é", "text/plain", b"data")
        elif action == "one by one":
            for channel, sequence, time, _, data in messages:
                writer.add_message(channel, time, data, sequence)
                library.add_message(channel, time, data, time, sequence)
        else:
            head = np.array([message[:4] for message in messages], dtype=MESSAGE_HEAD)
            size = np.array([len(message[4]) for message in messages], dtype=np.int64)
            between = b"-" + b"-".join(message[4] for message in messages)
            writer.add_messages(head, between, np.cumsum(size + 1) - size, size)
            for channel, sequence, time, published, data in messages:
                library.add_message(channel, time, data, published, sequence)
    assert ours.getvalue() == theirs.getvalue()  # what a killed process leaves is the same too
    writer.finish()
    library.finish()
    assert ours.getvalue() == theirs.getvalue()


@pytest.mark.parametrize(("size", "messages"), [(0, 0), (70_000, 0), (9, 200)])
def test_without_a_message_and_with_more_indexes_than_the_memory_is_for(size: int, messages: int) -> None:
    """A long head alone makes no chunk, at the end neither."""
    ours, theirs = io.BytesIO(), io.BytesIO()
    writer = McapWriter(ours, chunk_size=50, compression="none", indexes_in_memory=1000)
    library = Writer(theirs, chunk_size=50, compression=CompressionType.NONE)
    library.start(profile="ros2", library="mcap")
    for each in (writer, library):
        each.register_channel("/a", "cdr", each.register_schema("one", "ros2msg", b"x" * size), {})
    for time in range(messages):
        writer.add_message(1, time, bytes(40), time)
        library.add_message(1, time, bytes(40), time, time)
    writer.finish()
    library.finish()
    assert ours.getvalue() == theirs.getvalue()
