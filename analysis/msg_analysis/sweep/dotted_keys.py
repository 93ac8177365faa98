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

"""Dotted keys: places in the document of an experiment.

Names are joined by dots, places in lists stand in brackets and count from 1: ``noise.process[3]``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from msg_analysis.model.experiment.problems import problem, show

_PART = re.compile(r"([^\[\]]+)|\[(\d+)\]")


class KeyProblemError(Exception):
    """A key that cannot be set; the text is a line of problems."""


def put(document: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy of a document with another value at a place; only the containers on the way are copied.

    Names in the document may have dots in them; missing sections are made. KeyProblemError: the key leads nowhere.
    """
    parts = _split(key)
    changed = dict(document)
    _put(changed, parts, value, key, "")
    return changed


def _split(key: str) -> list[str | int]:
    """Names between dots, and places from 0."""
    parts: list[str | int] = []
    for piece in key.split("."):
        found = list(_PART.finditer(piece))
        if not found or "".join(match[0] for match in found) != piece or found[0][1] is None:
            raise KeyProblemError(_problem(key, "not a key", "names joined by dots, places in lists in brackets"))
        for match in found:
            if match[2] == "0":
                raise KeyProblemError(_problem(key, f"place {match[0]}", "places from 1"))
            parts.append(match[1] if match[1] is not None else int(match[2]) - 1)
    return parts


def _put(here: Any, parts: list[str | int], value: Any, key: str, path: str) -> None:
    """Set a value in a container that is a copy already."""
    name, used = _name(here, parts)
    rest = parts[used:]
    if isinstance(name, int):
        if not isinstance(here, list) or not name < len(here):
            size = f"{len(here)} entries" if isinstance(here, list) else show(here)
            raise KeyProblemError(_problem(key, f"{path} has {size}", f"a list with at least {name + 1} entries"))
        shown = f"{path}[{name + 1}]"
    else:
        if not isinstance(here, dict):
            raise KeyProblemError(_problem(key, f"{path} is {show(here)}", "keys with values there"))
        shown = f"{path}.{name}" if path else name
    if not rest:
        here[name] = value
        return
    inner = here[name] if isinstance(name, int) else here.get(name)
    inner = {} if inner is None else inner
    here[name] = dict(inner) if isinstance(inner, Mapping) else list(inner) if isinstance(inner, list) else inner
    _put(here[name], rest, value, key, shown)


def _name(here: Any, parts: list[str | int]) -> tuple[str | int, int]:
    """The next name and how many parts it takes: a name that is there may have dots."""
    if isinstance(parts[0], str) and isinstance(here, dict) and parts[0] not in here:
        name = parts[0]
        for count, part in enumerate(parts[1:], start=2):
            if isinstance(part, int):
                break
            name = f"{name}.{part}"
            if name in here:
                return name, count
    return parts[0], 1


def _problem(key: str, found: str, wanted: str) -> str:
    return problem(f"over.{key}", found, f"expected {wanted}", "correct the key")
