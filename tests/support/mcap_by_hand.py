"""Records of MCAP files by hand, as https://mcap.dev/spec has them, and files by its own library."""

import struct
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import zstandard
from mcap.writer import Writer

MAGIC = b"\x89MCAP0\r\n"


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def texts(values: dict[str, str]) -> bytes:
    entries = b"".join(text(key) + text(value) for key, value in values.items())
    return struct.pack("<I", len(entries)) + entries


def header(profile: str = "ros2", library: str = "x") -> bytes:
    return record(1, text(profile) + text(library))


def schema(number: int, name: str, data: str = "") -> bytes:
    return record(3, struct.pack("<H", number) + text(name) + text("ros2msg") + text(data))


def channel(number: int, topic: str, schema: int = 1, **metadata: str) -> bytes:
    return record(4, struct.pack("<HH", number, schema) + text(topic) + text("cdr") + texts(metadata))


def message(channel: int, data: bytes = b"", time: int = 0, sequence: int = 0, published: int | None = None) -> bytes:
    return record(5, struct.pack("<HIQQ", channel, sequence, time, time if published is None else published) + data)


def chunk_content(records: bytes, compression: str = "", packed: bytes | None = None, **wrong: int) -> bytes:
    """``wrong``: other values of size, crc and packed_size."""
    packed = records if packed is None else packed
    size, crc = wrong.get("size", len(records)), wrong.get("crc", zlib.crc32(records))
    head = struct.pack("<QQQI", 0, 1, size, crc) + text(compression)
    return head + struct.pack("<Q", wrong.get("packed_size", len(packed))) + packed


def chunk(records: bytes) -> bytes:
    return record(6, chunk_content(records, "zstd", zstandard.ZstdCompressor(3).compress(records)))


def metadata(name: str, **entries: str) -> bytes:
    return record(12, text(name) + texts(entries))


def attachment(name: str, data: bytes, log_time: int, create_time: int) -> bytes:
    head = struct.pack("<QQ", log_time, create_time) + text(name) + text("text/plain")
    content = head + struct.pack("<Q", len(data)) + data
    return record(9, content + struct.pack("<I", zlib.crc32(content)))


def write(path: Path, *records: bytes) -> Path:
    """A file without an end."""
    path.write_bytes(MAGIC + b"".join(records))
    return path


def by_library(
    path: Path, messages: Iterable[tuple[Any, ...]], *, library: str = "theirs", qos: str = "", **options: Any
) -> Path:
    """A file by mcap's own writer, of messages: topic, type (empty: none), data, log time and perhaps publish time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2", library)
        schemas, channels = {"": 0}, {}
        for topic, kind, data, time, *published in messages:
            if kind not in schemas:
                schemas[kind] = writer.register_schema(kind, "ros2msg", b"string data")
            if (topic, kind) not in channels:
                metadata = {"offered_qos_profiles": qos}
                channels[topic, kind] = writer.register_channel(topic, "cdr", schemas[kind], metadata)
            writer.add_message(channels[topic, kind], time, data, *(published or [time]))
        writer.finish()
    return path
