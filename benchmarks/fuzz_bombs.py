"""Small files that are meant to take long or to fill the memory: each gets an answer or one error, soon.

The commands run as processes of their own, as users start them. A case is a finding if a command needs more than
SECONDS of CPU time or MEMORY, prints a traceback, or ends with another exit code than 0, 1 or 2.
"""

from __future__ import annotations

import os
import resource
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import zstandard
from fuzz_documents import BOMB

SECONDS = 10.0  # of CPU time
MEMORY = 1e9  # bytes
LARGEST = 10**6  # bytes of a case
STOP = 60  # s of CPU time after which a command is ended
MAGIC = b"\x89MCAP0\r\n"
HEADER, SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA = 1, 3, 4, 5, 6, 12  # opcodes
STATE, GRAPH = "msg_agents_interfaces/msg/AgentState", "msg_agents_interfaces/msg/ActiveGraph"
STRING = "std_msgs/msg/String"
CDR = b"\x00\x01\x00\x00"


def record(opcode: int, content: bytes) -> bytes:
    """An MCAP record."""
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str) -> bytes:
    """A string with its length."""
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def pairs(values: dict[str, str]) -> bytes:
    """A map of strings."""
    data = b"".join(text(key) + text(value) for key, value in values.items())
    return struct.pack("<I", len(data)) + data


def schema(number: int, name: str, data: bytes = b"") -> bytes:
    """A schema record."""
    content = struct.pack("<H", number) + text(name) + text("ros2msg") + struct.pack("<I", len(data)) + data
    return record(SCHEMA, content)


def channel(number: int, topic: str, metadata: dict[str, str] | None = None, of: int = 1) -> bytes:
    """A channel record."""
    return record(CHANNEL, struct.pack("<HH", number, of) + text(topic) + text("cdr") + pairs(metadata or {}))


def message(number: int, data: bytes = b"", time: int = 0) -> bytes:
    """A message record."""
    return record(MESSAGE, struct.pack("<HIQQ", number, 0, time, time) + data)


def chunk(records: bytes) -> bytes:
    """A chunk record, compressed as well as can be."""
    packed = zstandard.ZstdCompressor(19).compress(records)
    head = struct.pack("<QQQI", 0, 1, len(records), 0) + text("zstd") + struct.pack("<Q", len(packed))
    return record(CHUNK, head + packed)


def string(value: str) -> bytes:
    """The CDR bytes of a std_msgs/String."""
    data = value.encode() + b"\0"
    return CDR + struct.pack("<I", len(data)) + data


START = MAGIC + record(HEADER, text("ros2") + text("x")) + schema(1, STATE)


def filled(make: Callable[[int], bytes]) -> bytes:
    """A file with as many pieces as fit into ``LARGEST`` bytes."""
    parts, size = [START], len(START)
    for number in range(LARGEST):
        parts.append(make(number))
        size += len(parts[-1])
        if size > LARGEST:
            break
    return b"".join(parts[:-1])


def profile(number: int) -> dict[str, str]:
    """A quality of service of its own."""
    return {"offered_qos_profiles": f"- history: 1\n  depth: {number}\n  reliability: 1\n"}


def state_of(run: int) -> bytes:
    """An AgentState of some run."""
    head = struct.pack("<iII4x", 0, 0, 1) + struct.pack("<QQ", run, 7919 * run)
    return CDR + head + struct.pack("<I4xQI", 1, 0, 0) + struct.pack("<II", 0, 0)


def bags() -> Iterator[tuple[str, bytes]]:
    """Names and contents of .mcap files."""
    alike, other = message(1), message(1, b"x")
    many = 250_000_000 // len(alike)
    yield "chunk_of_messages", START + chunk(channel(1, "/agent_1/state") + alike * many)
    yield "chunks_of_messages", START + chunk(channel(1, "/agent_1/state") + alike * (many // 8)) * 40
    yield "chunk_of_unlike_messages", START + chunk(channel(1, "/agent_1/state") + (alike + other) * 700_000)
    yield "chunk_of_unknown_records", START + chunk(record(0x81, b"") * 2_500_000)
    yield "chunk_of_zeros", START + chunk(bytes(60_000_000))
    yield "most_topics", START + chunk(b"".join(channel(i, f"/t{i}", profile(i)) for i in range(1, 8193)) + alike)
    yield "too_many_topics", START + chunk(b"".join(channel(i, f"/t{i}") for i in range(1, 65_536)) + alike)
    yield (
        "topics_that_change",
        START + chunk(b"".join(channel(i % 999 + 1, f"/t{i}", profile(i)) for i in range(250_000)) + alike),
    )
    yield "chunk_for_each_message", filled(lambda i: chunk(channel(i % 999 + 1, f"/t{i}") + message(i % 999 + 1)))
    yield "topic_for_each_message", filled(lambda i: channel(i % 999 + 1, f"/t{i}") + message(i % 999 + 1))
    yield "large_schemas", START + chunk(b"".join(schema(i, "a/msg/B", bytes(9_000)) for i in range(2, 7_000)))
    yield "metadata", filled(lambda i: record(METADATA, text("msg_agents") + pairs({"record": f'{{"run": "{i}"}}'})))
    yield (
        "metadata_in_a_chunk",
        START + chunk(b"".join(record(METADATA, text("a") + pairs({"b": f"{i} {' ' * 300}"})) for i in range(200_000))),
    )
    records = b"".join(message(2, string(f'{{"run": "{i}"}}')) for i in range(200_000))
    yield "run_records", START + chunk(schema(2, STRING) + channel(2, "/experiment", of=2) + records)
    graphs = message(2, CDR + bytes(100)) * 400_000
    yield "graphs", START + chunk(schema(2, GRAPH) + channel(2, "/graph", of=2) + graphs)
    runs = b"".join(message(1, state_of(i)) for i in range(150_000))
    yield "states_of_many_runs", START + chunk(channel(1, "/agent_1/state") + runs)
    yield "times_beyond_all_clocks", START + chunk(channel(1, "/agent_1/state") + message(1, time=2**64 - 1) * 1000)


def definitions() -> Iterator[tuple[str, bytes, bytes]]:
    """Names, definitions and encodings of types that take long to understand."""

    def fields(inner: str) -> str:
        return "\n".join(f"{inner} f{k}" for k in range(2000))

    wide = fields("A") + "".join(
        f"\n{'=' * 80}\nMSG: a/{one}\n{fields(other)}" for one, other in ("AB", "BC", ("C", "bool"))
    )
    yield "wide_type", wide.encode(), b"ros2msg"
    begin, end = "module a { module msg { ", "struct B { double x; }; }; };"
    yield "expression", (begin + "const long A = " + "(" * 9 + "1" + ")" * 9 + "; " + end).encode(), b"ros2idl"
    constants = "".join(f"const long A{k} = 1; " for k in range(12_000))
    yield "constants", (begin + constants + end).encode(), b"ros2idl"


def documents() -> Iterator[tuple[str, bytes]]:
    """Names and contents of experiment files, a GraphML file among them."""
    start = "name: x\nproblem: consensus\nchain: {type: uniform, rate: 1}\n"
    yield "aliases.yaml", BOMB.encode()
    yield "aliases_in_a_value.yaml", (f"{start}{BOMB}graphs: {{a: {{path: *i}}}}\n").encode()
    yield "deep.yaml", b"[" * 900_000
    yield "long_name.yaml", (start + "graphs: {" + "x" * 900_000 + ": {path: [1, 2]}}\n").encode()
    yield (
        "many_graphs.yaml",
        (start + "graphs:\n" + "".join(f"  g{i}: {{path: [1, 2]}}\n" for i in range(40_000))).encode(),
    )
    yield "many_edges.yaml", (start + "graphs: {a: {edges: [" + ", ".join(["[1, 2]"] * 120_000) + "]}}\n").encode()
    nodes = "".join(f'<node id="{i}"/>' for i in range(1, 50_000))
    yield "nodes.graphml", f'<graphml><graph edgedefault="undirected">{nodes}</graph></graphml>'.encode()


def endless(folder: Path) -> Path:
    """An experiment whose GraphML file has no end."""
    file = folder / "endless.yaml"
    file.write_text(
        "name: x\nproblem: consensus\nchain: {type: uniform, rate: 1}\ngraphs: {a: {graphml: /dev/zero}}\n",
        encoding="utf-8",
    )
    return file


def cases(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Name and command of every case; its file is made in the folder when it is asked for."""
    for name, data in bags():
        assert len(data) <= LARGEST, f"{name}: {len(data)} bytes"
        file = folder / f"{name}.mcap"
        file.write_bytes(data)
        for command in ("info", "compare"):
            yield f"{command} {name}", [command, str(file)]
        yield f"salvage {name}", ["salvage", str(file), str(folder / f"{name}.salvaged")]
        file.unlink()
    for name, definition, encoding in definitions():
        content = struct.pack("<H", 2) + text("a/msg/B") + struct.pack("<I", len(encoding)) + encoding
        content += struct.pack("<I", len(definition)) + definition
        topics = b"".join(channel(i, f"/tank_{i}", of=2) for i in range(1, 201))
        (folder / f"{name}.mcap").write_bytes(
            START + chunk(record(SCHEMA, content) + topics + message(1, CDR + bytes(8)))
        )
        yield f"map {name}", ["map", str(folder / f"{name}.mcap")]
        yield f"map --check {name}", ["map", str(folder / f"{name}.mcap"), "--check"]
    for name, data in documents():
        assert len(data) <= LARGEST, f"{name}: {len(data)} bytes"
        file = folder / name
        file.write_bytes(data)
        if file.suffix == ".graphml":
            written = (
                f"name: x\nproblem: consensus\nchain: {{type: uniform, rate: 1}}\ngraphs: {{a: {{graphml: {name}}}}}\n"
            )
            file = folder / "experiment.yaml"
            file.write_text(written, encoding="utf-8")
        for command in ("info", "predict"):
            yield f"{command} {name}", [command, str(file)]
    for file in (endless(folder), Path("/dev/zero")):
        for command in ("info", "compare", "predict"):
            yield f"{command} {file.name}", [command, str(file)]


def fault(command: list[str]) -> tuple[str, str | None]:
    """What a command needed, and what is wrong with that; None where nothing is."""
    process = subprocess.Popen(
        [sys.executable, "-m", "msg_analysis", *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (STOP, STOP)),
    )
    assert process.stdout is not None
    output = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds, memory = usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1e3
    needed = f"{seconds:.1f} s, {memory / 1e6:.0f} MB"
    if process.returncode not in (0, 1, 2) or b"Traceback" in output:
        return needed, f"exit code {process.returncode}: {output[-500:].decode(errors='replace')}"
    return needed, needed if seconds > SECONDS or memory > MEMORY else None


def run(folder: Path) -> int:
    """All cases; the number of findings."""
    found = count = 0
    for name, command in cases(folder):
        needed, wrong = fault(command)
        count += 1
        found += wrong is not None
        if wrong or "-v" in sys.argv:
            print(f"{name}: {wrong or needed}", file=sys.stderr, flush=True)
    print(f"bombs: {count} commands: {found} findings")
    return found


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="bombs.") as place:
        sys.exit(1 if run(Path(place)) else 0)
