"""How far long work is, for whoever wants to show it: nothing is passed through the functions between."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Watch = Callable[[str, int, int], None]
"""Takes what is being done, how much of it is done, and how much there is to do, in any unit."""

_watch: ContextVar[Watch | None] = ContextVar("watch", default=None)


@contextmanager
def watched(watch: Watch) -> Iterator[None]:
    """Call ``watch`` in this context, often, by what is done in it."""
    token = _watch.set(watch)
    try:
        yield
    finally:
        _watch.reset(token)


def tell(what: str, done: int, total: int) -> None:
    """Say how far the work is."""
    watch = _watch.get()
    if watch is not None:
        watch(what, done, total)
