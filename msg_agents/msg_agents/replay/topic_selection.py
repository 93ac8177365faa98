"""Which topics of a bag are played, and what they are called then. Without ROS."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

from msg_analysis.errors import InputError


def select_topics(topics: Iterable[str], wanted: Sequence[str], excluded: Sequence[str]) -> list[str]:
    """The names that are wanted and not excluded, in the order given.

    Parameters
    ----------
    topics
        names of all topics
    wanted
        names, or patterns such as ``/agent_*/state``; none: all
    excluded
        the same

    Raises
    ------
    InputError
        a name that no topic has, or nothing is left
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
    """New names of all topics that are played, by their old ones.

    Parameters
    ----------
    remaps
        ``old:=new``; names without a slash at the beginning get one
    topics
        that are played

    Raises
    ------
    InputError
        not of this form, or a topic that is not played
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
