"""Files are those of the library ``mcap``, byte for byte."""

from __future__ import annotations

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from msg_analysis.bags.format.mcap_writer import McapWriter
from msg_analysis.bags.format.storage_options import Compression

TYPES = {"none": CompressionType.NONE, "zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}
MESSAGES = st.lists(
    st.one_of(
        st.tuples(st.integers(1, 4), st.integers(0, 2**64 - 1), st.binary(max_size=300), st.integers(0, 2**32 - 1)),
        st.sampled_from(["flush", "metadata"]),
    ),
    max_size=60,
)


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
