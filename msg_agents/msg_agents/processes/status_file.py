"""Account files, in which the processes of a run report refused messages and what their nodes wait for."""

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
    with contextlib.suppress(OSError):
        temporary = path.with_suffix(".part")
        temporary.write_text(json.dumps({"refused": refused, "waiting": waiting}), encoding="utf-8")
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
