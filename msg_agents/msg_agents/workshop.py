"""The temporary folder of a run: its record and what its processes print."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = "msg_agents_run_"
YOUTH = 60.0  # s; younger folders may belong to a run that has not locked its own yet


@contextmanager
def workshop() -> Iterator[Path]:
    """A folder of our own that is gone afterwards; those of runs that were killed are cleared away first.

    A lock tells a run's folder from one that was left behind: it goes with the process, however that ends.
    """
    _clear_abandoned()
    path = Path(tempfile.mkdtemp(prefix=PREFIX))
    lock = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        os.close(lock)


def _clear_abandoned() -> None:
    for path in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with suppress(OSError):  # gone already, another user's, or locked
            if time.time() - path.stat().st_mtime < YOUTH:
                continue
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path)
            finally:
                os.close(lock)
