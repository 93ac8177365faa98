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

"""Which topics of a bag are played, and under which names. No ROS."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

from msg_analysis.errors import InputError


def select_topics(topics: Iterable[str], wanted: Sequence[str], excluded: Sequence[str]) -> list[str]:
    """Names that are wanted (none given: all) and not excluded, by name or pattern such as ``/agent_*/state``.

    InputError: a name or pattern that no topic has, or no topic is left.
    """
    names = list(topics)
    for option, patterns in (("--topics", wanted), ("--exclude", excluded)):
        for pattern in patterns:
            if not any(_fits(name, pattern) for name in names):
                raise InputError(f"{option}: {pattern}: no such topic in the bag: expected one of {', '.join(names)}")
    chosen = [
        name
        for name in names
        if (not wanted or any(_fits(name, pattern) for pattern in wanted))
        and not any(_fits(name, pattern) for pattern in excluded)
    ]
    if not chosen:
        raise InputError(f"--exclude: {', '.join(excluded)}: leaves no topic to play: exclude fewer")
    return chosen


def _fits(name: str, pattern: str) -> bool:
    return fnmatchcase(name, pattern if pattern.startswith("/") else f"/{pattern}")


def parse_remaps(remaps: Sequence[str], topics: Sequence[str]) -> dict[str, str]:
    """New names of all topics that are played, by old name; each of ``remaps`` is ``old:=new``.

    Names get a missing slash in front. InputError: not of this form, or a topic that is not played.
    """
    names = {name: name for name in topics}
    for remap in remaps:
        old, separator, new = remap.partition(":=")
        if not separator or not old or not new:
            raise InputError(f"--remap: {remap}: expected old:=new")
        old, new = (name if name.startswith("/") else f"/{name}" for name in (old, new))
        if old not in names:
            raise InputError(f"--remap: {old}: no such topic is played: expected one of {', '.join(topics)}")
        names[old] = new
    return names
