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

"""Files in which the processes of a run report to the runner: neither side ever waits for the other.

Account files have refused messages and what the nodes wait for; the file of steps, how far every agent is; that of
clocks, how far those of several hosts are apart.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Refused = tuple[str, str, str, int]  # node, topic, reason, count


@dataclass(slots=True)
class Account:
    """Sum of the account files of a run."""

    refused: Counter[tuple[str, str, str]] = field(default_factory=Counter)  # by (node, topic, reason)
    waiting: dict[str, str] = field(default_factory=dict)  # by node, what it waits for; only nodes that wait

    def strangers(self) -> list[dict[str, Any]]:
        """Key ``strangers`` of result.json: refused messages by node, topic and reason, with their counts."""
        return [
            {"node": node, "topic": topic, "reason": reason, "count": count}
            for (node, topic, reason), count in sorted(self.refused.items())
        ]


def write_account(path: Path, refused: Sequence[Refused], waiting: Mapping[str, str]) -> None:
    """Replace the account file of one process atomically; an error such as a full disk is ignored."""
    _replace(path, {"refused": refused, "waiting": waiting})


def write_steps(path: Path, steps: Sequence[int]) -> None:
    """Replace the newest step of every agent; an error such as a full disk is ignored."""
    _replace(path, list(steps))


def read_steps(path: Path) -> list[int]:
    """The newest step of every agent; empty as long as there is no such file."""
    with contextlib.suppress(OSError, ValueError):
        steps: list[int] = json.loads(path.read_text(encoding="utf-8"))
        return steps
    return []


def write_clocks(path: Path, offsets: Sequence[Mapping[str, Any]], warning: str | None) -> None:
    """Replace what the switcher knows of the clocks of several hosts; an error such as a full disk is ignored."""
    _replace(path, {"offsets": list(offsets), "warning": warning})


def read_clocks(path: Path) -> tuple[list[dict[str, Any]] | None, str | None]:
    """Offsets of the clocks (None: not compared), and which are too far apart."""
    with contextlib.suppress(OSError, ValueError):
        document = json.loads(path.read_text(encoding="utf-8"))
        return document["offsets"], document["warning"]
    return None, None


def _replace(path: Path, document: Any) -> None:
    """Whole or not at all, whatever ends this process."""
    with contextlib.suppress(OSError):
        temporary = path.with_suffix(".part")
        temporary.write_text(json.dumps(document), encoding="utf-8")
        temporary.replace(path)


def read_accounts(paths: Iterable[Path]) -> Account:
    """Add up account files, given in the order of the starts; missing or damaged files are left out."""
    account = Account()
    waiting: dict[str, str] = {}
    for path in paths:
        with contextlib.suppress(OSError, ValueError):
            document = json.loads(path.read_text(encoding="utf-8"))
            for *what, count in document["refused"]:
                account.refused[tuple(what)] += count
            waiting |= document["waiting"]  # later processes are more recent; "": does not wait
    account.waiting = {node: message for node, message in waiting.items() if message}
    return account
