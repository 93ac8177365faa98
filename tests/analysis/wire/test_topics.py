"""The table of topics: names in bags, and the tables in the documentation."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.topics import STATE, TOPICS, TRUTH, network_topics

DOCS = Path(__file__).parents[3] / "docs"


def test_names() -> None:
    assert [topic.name for topic in network_topics(2)] == ["/experiment", "/graph", "/agent_1/state", "/agent_2/state"]
    assert [topic.name for topic in network_topics(2, truth=True)][2:] == [
        "/agent_1/state",
        "/agent_2/state",
        "/agent_1/truth",
        "/agent_2/truth",
    ]
    named = network_topics(1, "/lab/")
    assert [topic.name for topic in named] == ["/lab/experiment", "/lab/graph", "/lab/agent_1/state"]
    assert [topic.qos.offered()[0]["durability"] for topic in named] == [
        "transient_local",
        "transient_local",
        "volatile",
    ]
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
    found = {name: (kind.strip("`"), qos) for name, kind, _, qos in rows("ros.md")}
    assert found == {topic.name: (topic.type.full_name, str(topic.qos)) for topic in TOPICS}


def test_publishers_in_the_documentation() -> None:
    for name, _, publishers, _ in rows("ros.md"):
        (topic,) = [topic for topic in TOPICS if topic.name == name]
        assert all(writer in publishers for writer in topic.writers.split(", ")), name


def test_reasons_in_the_documentation() -> None:
    """Every reason that the documentation explains exists, and no two have the same text."""
    reasons = [text for name, text in vars(Refusal).items() if not name.startswith("_")]
    assert len(set(reasons)) == len(reasons)
    faults = (DOCS / "faults.md").read_text(encoding="utf-8")
    table = re.search(r"^\| reason \|.*\n((?:\|.*\n)+)", faults, re.MULTILINE)
    assert table
    named = re.findall("`(.*?)`", "".join(line.split("|")[1] for line in table[1].splitlines()[1:]))
    assert len(named) > 8
    assert set(named) <= set(reasons)
