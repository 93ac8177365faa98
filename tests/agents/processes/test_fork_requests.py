"""What is sent to a fork server. Real ones: ``test_fork_server.py``."""

from __future__ import annotations

import json
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from msg_agents.run.fork_server import LONGEST, MOST_DESCRIPTORS, NodeStart, _messages

NODES = st.lists(
    st.tuples(st.integers(0, 9000), st.lists(st.integers(3, 400), unique=True, min_size=1, max_size=5)), max_size=80
)


@given(NODES)
def test_every_node_is_in_one_message_with_its_descriptors(sizes: list[tuple[int, list[int]]]) -> None:
    nodes = [
        NodeStart([str(i), "x" * size], {f"--{number}": number for number in others}, output, None)
        for i, (size, (output, *others)) in enumerate(sizes)
    ]
    received: list[tuple[Any, list[int]]] = []
    for message, descriptors in _messages(nodes):
        assert len(message) <= LONGEST
        assert len(descriptors) == len(set(descriptors)) <= MOST_DESCRIPTORS
        received += [(request, [descriptors[place] for place in places]) for request, places in json.loads(message)]
    assert received == [
        (
            {"arguments": node.arguments, "options": list(node.descriptors), "core": None},
            [node.output, *node.descriptors.values()],
        )
        for node in nodes
    ]


def test_few_messages() -> None:
    """A network of forty processes is one, and what they share is sent once."""
    (message,) = _messages(
        [
            NodeStart(["agent", "run.json", "--agent", str(i)], {"--lifeline": 6, "--status": 10 + i}, 5, None)
            for i in range(40)
        ]
    )
    assert len(message[1]) == 42
