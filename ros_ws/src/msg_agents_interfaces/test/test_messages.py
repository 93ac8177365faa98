# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The messages as built here. Run by ``colcon test``."""

from __future__ import annotations

import pytest
from msg_agents_interfaces.msg import ActiveGraph, AgentState, Estimate, Progress, StateBatch
from rclpy.serialization import deserialize_message, serialize_message


@pytest.mark.parametrize("kind", [ActiveGraph, AgentState, Estimate, Progress, StateBatch])
def test_there_and_back(kind: type) -> None:
    message = kind()
    message.run = list(range(16))
    assert deserialize_message(serialize_message(message), kind) == message


def test_bytes_of_a_state() -> None:
    """As docs/messages.md has them: agent at byte 36, step at 44, the first replica at 68."""
    data = serialize_message(AgentState(agent=3, step=5, state=[1.5]))
    assert data[36:40] == b"\x03\0\0\0"
    assert data[44:52] == b"\x05" + bytes(7)
    assert data[68:76] == b"\0\0\0\0\0\0\xf8\x3f"
