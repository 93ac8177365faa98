"""Filters, order and dates of lists of runs."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from msg_analysis.errors import InputError
from msg_analysis.runs import RunEntry, RunFilter, moment

UTC = UTC
NOW = datetime(2026, 11, 25, 12, 0, tzinfo=UTC)


def run(folder: str, day: int, **fields: Any) -> RunEntry:
    return RunEntry(folder, "compared", datetime(2026, 11, day, tzinfo=UTC), **fields)


RUNS = [
    run("a", 1, name="line", seed=3, verdict="agrees", measured=2.0),
    run("b", 2, name="ring", seed=1, verdict="disagrees", measured=1.0),
    run("c", 3, name="line_ring", seed=3, verdict="agrees", measured=3.0),
    run("d", 4),
]


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        ({}, "abcd"),
        ({"name": "line"}, "a"),
        ({"name": "line*"}, "ac"),
        ({"name": "*"}, "abc"),
        ({"verdicts": ("agrees",)}, "ac"),
        ({"verdicts": ("none", "disagrees")}, "bd"),
        ({"seed": 3}, "ac"),
        ({"since": datetime(2026, 11, 2, tzinfo=UTC)}, "bcd"),
        ({"until": datetime(2026, 11, 2, tzinfo=UTC)}, "a"),
        ({"last": 2}, "cd"),
        ({"last": 9}, "abcd"),
        ({"seed": 3, "last": 1}, "c"),
    ],
)
def test_filters(wanted: dict[str, Any], found: str) -> None:
    assert "".join(entry.folder for entry in RunFilter(**wanted).choose(RUNS[::-1])) == found


@pytest.mark.parametrize(
    ("key", "found"), [("date", "abcd"), ("name", "acbd"), ("seed", "bacd"), ("verdict", "acbd"), ("error", "bacd")]
)
def test_order(key: Any, found: str) -> None:
    assert "".join(entry.folder for entry in RunFilter().choose(RUNS[::-1], key)) == found


@pytest.mark.parametrize(
    ("text", "end", "found"),
    [
        ("30m", False, NOW - timedelta(minutes=30)),
        ("12h", True, NOW - timedelta(hours=12)),
        ("7d", False, NOW - timedelta(days=7)),
        ("2026-11-25", False, datetime(2026, 11, 25).astimezone()),
        ("2026-11-25", True, datetime(2026, 11, 26).astimezone()),
        ("2026-11-25T14:30", True, datetime(2026, 11, 25, 14, 30).astimezone()),
        ("2026-11-25T14:30+02:00", False, datetime(2026, 11, 25, 12, 30, tzinfo=UTC)),
    ],
)
def test_moments(text: str, end: bool, found: datetime) -> None:
    assert moment(text, "--since", NOW, end=end) == found


@pytest.mark.parametrize("text", ["", "yesterday", "2026-13-01", "7w", "-3d", "999999d"])
def test_what_is_not_a_moment(text: str) -> None:
    with pytest.raises(InputError, match=r"--until .*: expected a date"):
        moment(text, "--until", NOW)
