# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Agents in texts: by name where they have names, else by number. Numbers count from 1."""

from __future__ import annotations

import re
from collections.abc import Sequence

_NUMBER = r"(?<![\w.])\d+(?![\w.])"
_AGENTS = re.compile(rf"\b([Aa]gents? )({_NUMBER}(?:(?:,| and|, and) {_NUMBER})*)(?! to \d)")


def agent_name(number: int, names: Sequence[str] | None) -> str:
    """The name of an agent, or its number; the latter, too, where there is no such agent."""
    return names[number - 1] if names and 1 <= number <= len(names) else str(number)


def agent_text(number: int, names: Sequence[str] | None) -> str:
    """``agent 3``, or ``agent north``."""
    return f"agent {agent_name(number, names)}"


def with_names(text: str, names: Sequence[str] | None) -> str:
    """The text with names instead of numbers after the word "agent" or "agents": in results, agents have numbers."""
    if not names:
        return text
    return _AGENTS.sub(lambda found: found[1] + re.sub(r"\d+", lambda n: agent_name(int(n[0]), names), found[2]), text)
