"""Mutations of documents: text as text, and what is in it as values."""

from __future__ import annotations

import copy
import random
import re
from collections.abc import Callable
from typing import Any

VALUES: list[Any] = [
    *(None, True, False, 0, 1, -1, 2, 3.5, -0.0, 0.1, 1e-300, 1e300, 1e308, -1e308, 5e-324),
    *(float("inf"), float("-inf"), float("nan"), 2**31, 2**53, 2**63, 2**64, 10**30, -(10**30), 10**400),
    *("", "a", "0", "1e3", "inf", "line", "stationary", "zero", "\x00", "é", "../x", "%s", "{}"),
    *("9" * 5000, "x" * 10_000),
    *([], {}, [[]], [None], [1], [1, 2], [[1, 2]], [[1, 2, 0.5]], {"a": 1}, {"": None}, [0] * 1000, ["1"]),
]
"""What no file should have, and what some may."""
TOKENS = [
    *("", "~", "true", "-1", "0", "1e999", ".nan", ".inf", "1e-400", "9" * 20, "9" * 6000, "0x10", "1_000", "&a", "*a"),
    *("!!python/object:os.system", "!!binary aGk=", "!!int x", "<<: {a: 1}", "? {a: 1} : 2", "- - - -"),
    *("[" * 50, "{" * 50, "[" * 3000, "\t", "\x00", "\ufeff", "\u2028", "---", "...", "%YAML 9.9", '"', "'", "|", ">"),
    *("#", ":", "2001-01-01", "[1, 2]", "{a: b}", "é", "NaN", "Infinity", "null", "agents: 100000"),
    *("graphml: /dev/null", "graphml: ."),
]
CHARACTERS = ["", " ", "\n", ":", "-", "[", "]", "{", "}", ",", "9", "e", "\x00", "\x85", "é", "😀", "*", "&", "!"]
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(['*' + last] * 9)}]\n" for last, name in zip("abcdefgh", "bcdefghi", strict=True)
)


def mutate_text(text: str, rng: random.Random) -> str:
    """Tokens, lines and characters changed."""
    for _ in range(rng.choice([1, 1, 2, 4])):
        text = rng.choice(_CHANGES)(text, rng)
    return text


def _token(text: str, rng: random.Random) -> str:
    places = list(re.finditer(r"[\w.+-]+", text))
    if not places:
        return rng.choice(TOKENS)
    place = rng.choice(places)
    return text[: place.start()] + rng.choice(TOKENS) + text[place.end() :]


def _line(text: str, rng: random.Random) -> str:
    lines = text.splitlines() or [""]
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    what = rng.randrange(6)
    if what == 0:
        del lines[at]
    elif what == 1:
        lines.insert(other, lines[at])
    elif what == 2:
        lines[at], lines[other] = lines[other], lines[at]
    elif what == 3:
        lines[at] = rng.choice(["  ", " ", "\t", "- "]) + lines[at]
    elif what == 4:
        lines[at] = lines[at].strip()
    else:
        lines.insert(at, rng.choice([BOMB, "<<: *a", "key: &a {b: *a}", *TOKENS]))
    return "\n".join(lines)


def _character(text: str, rng: random.Random) -> str:
    at = rng.randrange(len(text) + 1)
    character = rng.choice(CHARACTERS)
    return text[:at] + character + text[at + rng.choice([0, 1, 1, 30]) :]


_CHANGES: list[Callable[[str, random.Random], str]] = [_token, _line, _character]


def mutate_document(document: Any, rng: random.Random) -> Any:
    """Values and keys changed, removed, doubled, swapped."""
    document = copy.deepcopy(document)
    if not isinstance(document, dict | list):  # what an earlier change has left
        return rng.choice(VALUES)
    for _ in range(rng.choice([1, 1, 2, 4])):
        places = list(_places(document))
        if not places:
            return rng.choice(VALUES)
        container, key = rng.choice(places)
        what = rng.randrange(6)
        if what == 0:
            del container[key]
        elif what == 1:
            other, other_key = rng.choice(places)
            container[key] = copy.deepcopy(other[other_key])
        elif what == 2 and isinstance(container, dict):
            container[rng.choice(["x", "", 1, None, True, "graphs", "agents", "noise"])] = container.pop(key)
        elif what == 3 and isinstance(container, list):
            container.insert(key, copy.deepcopy(container[key]))
        elif what == 4 and isinstance(container[key], int | float) and not isinstance(container[key], bool):
            factor = rng.choice([-1, 0.5, 2, 10, 1000, 1e6, 1e12])
            container[key] = type(container[key])(container[key] * factor) if abs(container[key]) < 1e200 else 0
        else:
            container[key] = copy.deepcopy(rng.choice(VALUES))
    return document


def _places(document: Any) -> list[tuple[Any, Any]]:
    """Every container in a document with every key or index of it."""
    pending, found = [document], []
    while pending:
        container = pending.pop()
        keys = list(container) if isinstance(container, dict) else range(len(container))
        for key in keys:
            found.append((container, key))
            if isinstance(container[key], dict | list):
                pending.append(container[key])
    return found
