"""What a process of the network tells the one that started it, in a file: what was refused, who waits for what."""

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
    """Of all processes of a run.

    Attributes
    ----------
    refused
        messages that nodes did not take, counted by (node, topic, reason)
    waiting
        for what those nodes wait that cannot go on, by node
    """

    refused: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    waiting: dict[str, str] = field(default_factory=dict)

    def strangers(self) -> list[dict[str, Any]]:
        """The list of ``result.json``: who refused what on which topic, why, and how often."""
        return [
            {"node": node, "topic": topic, "reason": reason, "count": count}
            for (node, topic, reason), count in sorted(self.refused.items())
        ]


def write_account(path: Path, refused: Sequence[Refused], waiting: Mapping[str, str]) -> None:
    """Replace the account of one process. That it cannot be written (full disk) is no reason to fail.

    Parameters
    ----------
    path
        of the file
    refused
        messages that were refused
    waiting
        name of a node, and what it waits for
    """
    with contextlib.suppress(OSError):
        temporary = path.with_suffix(".part")
        temporary.write_text(json.dumps({"refused": refused, "waiting": waiting}), encoding="utf-8")
        temporary.replace(path)


def read_accounts(paths: Iterable[Path]) -> Account:
    """Sum of the accounts of processes, in the order of their start, those that were killed included.

    Parameters
    ----------
    paths
        of the files; those that are not there are left out
    """
    account = Account()
    waiting: dict[str, str] = {}
    for path in paths:
        with contextlib.suppress(OSError, ValueError):
            document = json.loads(path.read_text(encoding="utf-8"))
            for *what, count in document["refused"]:
                account.refused[tuple(what)] += count
            waiting |= document["waiting"]  # later processes know better; "" for who does not wait
    account.waiting = {node: message for node, message in waiting.items() if message}
    return account
