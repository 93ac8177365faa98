"""The temporary folders of a run: its record and what its processes print, and what they leave if they are killed."""

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
MEMORY = Path("/dev/shm")
"""A file system in memory, where there is one: pages of files on a disk cost about twice as much when they are written
for the first time, and again whenever the system has saved them."""

SPARE = 4  # times the room that is needed there must be free, for others to live
YOUTH = 60.0  # s; younger folders may belong to a run that has not locked its own yet


@contextmanager
def workshop(room: int | None = None) -> Iterator[Path]:
    """A folder of our own that is gone afterwards; those of runs that were killed are cleared away first.

    A lock tells a run's folder from one that was left behind: it goes with the process, however that ends.

    Parameters
    ----------
    room
        bytes that will be mapped into memory; the folder then is in memory, if there is plenty of it
    """
    _clear_abandoned()
    parent = MEMORY if room is not None and _free(MEMORY) > SPARE * room else None
    path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
    lock = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        os.close(lock)


def _free(directory: Path) -> int:
    """Bytes that we could write there."""
    try:
        return shutil.disk_usage(directory).free if os.access(directory, os.W_OK) else 0
    except OSError:
        return 0


def _clear_abandoned() -> None:
    for path in [path for parent in (Path(tempfile.gettempdir()), MEMORY) for path in parent.glob(f"{PREFIX}*")]:
        with suppress(OSError):  # gone already, another user's, or locked
            if time.time() - path.stat().st_mtime < YOUTH:
                continue
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path)
            finally:
                os.close(lock)
