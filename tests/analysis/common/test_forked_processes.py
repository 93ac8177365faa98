"""What is sent to a fork server. Real ones: tests/agents/processes/test_fork_server.py."""

from __future__ import annotations

import json
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from msg_analysis.common.forked_processes import LONGEST, MOST_DESCRIPTORS, _messages

REQUESTS = st.lists(
    st.tuples(st.integers(0, 9000), st.lists(st.integers(3, 400), unique=True, max_size=5)), max_size=80
)


@given(REQUESTS)
def test_every_request_is_in_one_message_with_its_descriptors(sizes: list[tuple[int, list[int]]]) -> None:
    requests = [({"number": i, "text": "x" * size}, numbers) for i, (size, numbers) in enumerate(sizes)]
    received: list[tuple[Any, list[int]]] = []
    for message, descriptors in _messages(requests):
        assert len(message) <= LONGEST
        assert len(descriptors) == len(set(descriptors)) <= MOST_DESCRIPTORS
        received += [(request, [descriptors[place] for place in places]) for request, places in json.loads(message)]
    assert received == requests


def test_few_messages() -> None:
    """A network of forty processes is one, and what they share is sent once."""
    (message,) = _messages(
        [({"arguments": ["agent", "run.json", "--agent", str(i)]}, [5, 6, 10 + i]) for i in range(40)]
    )
    assert len(message[1]) == 42
