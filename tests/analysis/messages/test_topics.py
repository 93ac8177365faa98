"""Topics, and the definitions of their messages: against the ROS packages, rosbags, and the documentation."""

import json
import re
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import msg_analysis.messages
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.cdr import CdrError, decode_batch, encode_batch
from msg_analysis.messages.messages import (
    ACTIVE_GRAPH,
    AGENT_STATE,
    ESTIMATE,
    PROGRESS,
    STATE_BATCH,
    STRING,
    MessageType,
)
from msg_analysis.messages.topics import STATE, TOPICS, TRUTH, network_topics

DOCS = Path(__file__).parents[3] / "docs"


def test_names() -> None:
    def names(*arguments: Any, **options: bool) -> str:
        return " ".join(topic.name for topic in network_topics(*arguments, **options))

    assert names(2) == "/experiment /graph /agent_1/state /agent_2/state"
    assert names(1, truth=True, stop=True) == "/experiment /graph /agent_1/state /agent_1/truth /stop"
    assert names(1, "/lab/") == "/lab/experiment /lab/graph /lab/agent_1/state"
    durability = [topic.qos.offered()[0]["durability"] for topic in network_topics(1)]
    assert durability == ["transient_local", "transient_local", "volatile"]
    assert (STATE.of(0), TRUTH.of(9)) == ("agent_1/state", "agent_10/truth")


def rows(page: str) -> Iterator[list[str]]:
    """The rows of the table of topics on a page, one for each topic; 'the same' is replaced by what it means."""
    table = re.search(r"^\| topic \|.*\n((?:\|.*\n)+)", (DOCS / page).read_text(encoding="utf-8"), re.MULTILINE)
    assert table
    before: list[str] = []
    for line in table[1].splitlines()[1:]:
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        before = [old if cell == "the same" else cell for cell, old in zip(cells, before or cells, strict=True)]
        yield from ([name, *before[1:]] for name in re.findall("`(.*?)`", before[0]))


def test_documentation() -> None:
    """Types, quality of service, and the nodes that publish."""
    found = {name: (kind.strip("`"), publishers, qos) for name, kind, publishers, qos in rows("ros.md")}
    assert found.keys() == {topic.name for topic in TOPICS}
    for topic in TOPICS:
        kind, publishers, qos = found[topic.name]
        assert (kind, qos) == (topic.type.full_name, str(topic.qos))
        assert all(writer in publishers for writer in topic.writers.split(", ")), topic.name


def test_reasons_in_the_documentation() -> None:
    """Every reason that the documentation explains exists, and no two have the same text."""
    reasons = [text for name, text in vars(Refusal).items() if not name.startswith("_")]
    assert len(set(reasons)) == len(reasons)
    faults = (DOCS / "wire.md").read_text(encoding="utf-8")
    table = re.search(r"^\| reason \|.*\n((?:\|.*\n)+)", faults, re.MULTILINE)
    assert table
    named = re.findall("`(.*?)`", "".join(line.split("|")[1] for line in table[1].splitlines()[1:]))
    assert len(named) > 8
    assert set(named) <= set(reasons)


DEFINITIONS = Path(msg_analysis.messages.__file__).parent / "definitions"
INTERFACES = Path(__file__).parents[3] / "ros_ws" / "src" / "msg_agents_interfaces"
TYPES = [AGENT_STATE, ACTIVE_GRAPH, ESTIMATE, PROGRESS, STRING]


@pytest.mark.parametrize("package", ["msg_agents_interfaces", "std_msgs", "builtin_interfaces"])
def test_definitions_are_those_of_the_packages(package: str) -> None:
    share = INTERFACES if package == "msg_agents_interfaces" else Path(sys.prefix) / "share" / package
    if not share.exists():
        pytest.skip(f"{package} is not installed: run make setup")
    ours = {file.name: file.read_bytes() for file in (DEFINITIONS / package / "msg").glob("*.msg")}
    theirs = {file.name: file.read_bytes() for file in (share / "msg").glob("*.msg")}
    assert ours
    assert ours.items() <= theirs.items()
    assert package != "msg_agents_interfaces" or ours == theirs


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.name)
def test_type_hashes(typestore: Any, kind: MessageType) -> None:
    assert kind.type_hash == typestore.hash_rihs01(kind.full_name)
    description = Path(sys.prefix) / "share" / kind.package / "msg" / f"{kind.name}.json"
    ours = {"type_name": kind.full_name, "hash_string": kind.type_hash}
    assert not description.exists() or ours in json.loads(description.read_text())["type_hashes"]


def test_schema_lists_every_dependency_once() -> None:
    parts = AGENT_STATE.schema.split("\n" + "=" * 80 + "\nMSG: ")
    assert [part.split("\n", 1)[0] for part in parts[1:]] == ["std_msgs/Header", "builtin_interfaces/Time"]
    assert "=====" not in STRING.schema


RUN = bytes(range(16))


def test_bytes_of_a_batch() -> None:
    head = b"\x00\x01\x00\x00" + RUN + struct.pack("<III", 2, 3, 1)
    assert encode_batch(RUN, [b"abc", b"d"]) == head + struct.pack("<I", 4) + b"abcd"


@given(st.lists(st.binary(max_size=50), max_size=9))
def test_another_library_reads_a_batch(messages: list[bytes]) -> None:
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
def test_what_is_no_batch(data: bytes, words: str) -> None:
    with pytest.raises(CdrError, match=words):
        decode_batch(data)
