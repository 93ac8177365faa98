"""Mutations of bags: bytes, records, chunks with a right CRC, run records, metadata.yaml, messages."""

from __future__ import annotations

import contextlib
import io
import json
import random
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from fuzz_documents import mutate_document, mutate_text
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from msg_analysis.bags.mcap_records import MAGIC
from msg_analysis.bags.stored_file import COMPRESSIONS, Storage
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.messages.messages import decode_string, encode_string
from msg_analysis.twin.simulate import simulate

CHUNK, MESSAGE, METADATA = 0x06, 0x05, 0x0C
_RECORD = struct.Struct("<BQ")
_BIG = [0, 1, 2, 127, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1]
_FIELDS = [  # of a message and of the AgentState in it: place and type
    *((0, "H"), (2, "I"), (6, "Q"), (14, "Q"), (22, "I"), (26, "i"), (30, "I"), (34, "I")),
    *((58, "I"), (66, "Q"), (74, "I"), (78, "I"), (82, "I")),
]
Record = tuple[int, bytes]  # opcode, content


def make_bags(directory: Path) -> list[Path]:
    """A bag of every kind that there is, each with several chunks."""
    graphs = {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}}
    plain = {"name": "fuzz", "graphs": graphs, "switching": {"generator": [[-1, 1], [1, -1]]}}
    run = {"dt": 0.05, "duration": 6.0, "replicas": 2, "start": "zero"}
    kinds: dict[str, dict[str, Any]] = {
        "plain": plain | {"run": run},
        "air": plain | {"run": run, "noise": {"broadcast": 0.1, "loss": 0.2}},
        "held": plain | {"run": run, "noise": {"loss": 0.4, "on_loss": "hold", "delay": 2}},
        "realtime": plain | {"run": run | {"pace": "realtime"}},
    }
    bags = []
    for name, document in kinds.items():
        trajectory = simulate(Experiment.parse(document))
        for compression in COMPRESSIONS:
            bags.append(directory / f"{name}_{compression}")
            split = 12_000 if compression == "zstd" else None
            write_trajectory(trajectory, bags[-1], Storage(compression, split, chunk_size=3000))
    return bags


def mutate_bag(source: Path, target: Path, rng: random.Random) -> str:
    """Make a damaged copy of a bag; what was done to it."""
    shutil.copytree(source, target)
    files = sorted(target.glob("*.mcap"))
    if rng.random() < 0.5:
        (target / "metadata.yaml").unlink()
    elif rng.random() < 0.2:
        file = target / "metadata.yaml"
        file.write_text(mutate_text(file.read_text(), rng), errors="replace")
        return "metadata.yaml"
    name, change = rng.choice(list(_CHANGES.items()))
    file = rng.choice(files)
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        with contextlib.suppress(_NothingToDoError):
            file.write_bytes(change(file.read_bytes(), rng))
    if rng.random() < 0.05:
        file.write_bytes(zstandard.compress(file.read_bytes()))
        file.rename(file.with_name(file.name + ".zstd"))
    return name


class _NothingToDoError(Exception):
    """The file has, after earlier mutations, nothing of the kind left."""


def _bytes(data: bytes, rng: random.Random) -> bytes:
    """Flip, set, insert, remove, repeat, cut."""
    if not data:
        raise _NothingToDoError
    at, size = rng.randrange(len(data)), rng.choice([1, 2, 8, 100, 5000])
    piece = data[at : at + size]
    ways: list[Callable[[], bytes]] = [
        lambda: data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :],
        lambda: data[:at] + bytes([rng.choice([0, 1, 127, 128, 255])]) * len(piece) + data[at + size :],
        lambda: data[:at] + rng.randbytes(len(piece)) + data[at + size :],
        lambda: data[:at] + rng.choice(_BIG).to_bytes(8, "little") + data[at + 8 :],
        lambda: data[:at] + data[at + size :],
        lambda: data[:at] + piece * rng.choice([2, 3, 50]) + data[at + size :],
        lambda: data[:at],
    ]
    return rng.choice(ways)()


def _records(data: bytes) -> Iterator[Record]:
    at = len(MAGIC)
    while at + _RECORD.size <= len(data) - len(MAGIC):
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if length > len(data) - at:
            return
        yield opcode, data[at : at + length]
        at += length


def _file(records: list[Record]) -> bytes:
    return MAGIC + b"".join(_RECORD.pack(opcode, len(content)) + content for opcode, content in records) + MAGIC


def _record_order(data: bytes, rng: random.Random) -> bytes:
    """Whole records lost, doubled, moved, of another kind, with other bytes in them."""
    records = list(_records(data))
    if not records:
        raise _NothingToDoError
    at = rng.randrange(len(records))
    opcode, content = records[at]
    what = rng.randrange(6)
    if what == 0:
        del records[at]
    elif what == 1:
        records.insert(rng.randrange(len(records)), records[at])
    elif what == 2:
        rng.shuffle(records)
    elif what == 3:
        records[at] = (rng.choice([0, 1, 3, 4, 5, 6, 9, 12, 15, 200, opcode]), content)
    elif what == 4 and content:
        records[at] = (opcode, _bytes(content, rng))
    else:
        del records[at:]
    return _file(records)


def _chunk_content(data: bytes, rng: random.Random) -> bytes:
    """The inside of a chunk, packed again as if it had been written so; now and then with lies about its size."""
    records = list(_records(data))
    chunks = [index for index, (opcode, _) in enumerate(records) if opcode == CHUNK]
    if not chunks:
        raise _NothingToDoError
    at = rng.choice(chunks)
    content = records[at][1]
    try:
        start, end, size, _, length = struct.unpack_from("<QQQII", content)
        compression = content[32 : 32 + length].decode()
        inside = _unpack(compression, content[40 + length :], size)
    except (struct.error, UnicodeDecodeError, RuntimeError, zstandard.ZstdError) as error:
        raise _NothingToDoError from error
    inside = _bytes(inside, rng) if rng.random() < 0.6 else _inner_records(inside, rng)
    if rng.random() < 0.02:
        inside = rng.choice([bytes(2**27), 10**6 * (_RECORD.pack(MESSAGE, 22) + bytes(22))])  # small when packed
    packed = _pack(compression, inside)
    size = rng.choice(_BIG) if rng.random() < 0.05 else len(inside)
    crc = 0 if rng.random() < 0.3 else zlib.crc32(inside)
    name = rng.choice([b"", b"lz4", b"zstd", b"brotli", b"\xff"]) if rng.random() < 0.03 else compression.encode()
    head = struct.pack("<QQQI", start, end, size, crc) + struct.pack("<I", len(name)) + name
    records[at] = (CHUNK, head + struct.pack("<Q", len(packed)) + packed)
    return _file(records)


def _unpack(compression: str, data: bytes, size: int) -> bytes:
    if compression == "zstd":
        return zstandard.decompress(data, min(size, 2**24))
    return bytes(lz4.frame.decompress(data)) if compression == "lz4" else data


def _pack(compression: str, data: bytes) -> bytes:
    if compression == "zstd":
        return zstandard.compress(data)
    return bytes(lz4.frame.compress(data)) if compression == "lz4" else data


def _inner_records(inside: bytes, rng: random.Random) -> bytes:
    """Numbers of messages set to what no recorder writes: channel, sequence, times; fields of the CDR data."""
    out, at = bytearray(inside), 0
    starts = []
    while at + _RECORD.size <= len(inside):
        opcode, length = _RECORD.unpack_from(inside, at)
        if not opcode or length > len(inside) - at:
            break
        starts += [at + _RECORD.size] if opcode == MESSAGE and length >= 90 else []
        at += _RECORD.size + length
    if not starts:
        raise _NothingToDoError
    for start in rng.sample(starts, min(len(starts), rng.choice([1, 3, 20]))):
        offset, code = rng.choice(_FIELDS)
        limit = 2 ** (8 * struct.calcsize(code) - (code == "i"))
        struct.pack_into("<" + code, out, start + offset, rng.choice(_BIG) % limit)
    return bytes(out)


def _run_record(data: bytes, rng: random.Random) -> bytes:
    """The run record, JSON with other values or other text; all else as it was."""
    stream = io.BytesIO()
    copy = Writer(stream, chunk_size=3000, compression=rng.choice(list(CompressionType)))
    copy.start("ros2", "fuzz")
    try:
        reader = make_reader(io.BytesIO(data))
        text = next(r.metadata["record"] for r in reader.iter_metadata() if r.name == "msg_agents")
        messages = list(reader.iter_messages())
    except Exception as error:  # damaged by an earlier mutation
        raise _NothingToDoError from error
    try:
        changed = mutate_text(text, rng) if rng.random() < 0.4 else json.dumps(mutate_document(json.loads(text), rng))
    except (ValueError, RecursionError) as error:  # no JSON any more
        raise _NothingToDoError from error
    if rng.random() < 0.5:
        copy.add_metadata("msg_agents", {"record": changed})
    channels: dict[int, int] = {}
    for schema, channel, message in messages:
        if schema is None:
            continue
        if channel.id not in channels:
            number = copy.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.id] = copy.register_channel(channel.topic, "cdr", number, channel.metadata)
        content = message.data
        if channel.topic == "/experiment" and decode_string(content) == text:
            content = encode_string(changed)
        copy.add_message(channels[channel.id], message.log_time, content, message.publish_time)
    copy.finish()
    return stream.getvalue()


_CHANGES: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "bytes": _bytes,
    "records": _record_order,
    "chunk": _chunk_content,
    "run record": _run_record,
}
