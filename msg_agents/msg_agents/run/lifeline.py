# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Whether a process has hung: its main thread waits, and has not run for a minute, though nobody has stopped it.

The main thread of a node that waits for others, for its clock, or for a slow reader still runs several times a second.
"""

from __future__ import annotations

import contextlib
import faulthandler
import fcntl
import io
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

GRACE = 5.0  # s


def exit_with_pipe(descriptor: int) -> None:
    """End this process when the other end of a pipe closes: its parent has ended."""

    def wait() -> None:
        while os.read(descriptor, 1):
            pass

    _end_after(wait)


def exit_with_lock(folder: Path) -> None:
    """End this process when a folder is no longer locked, or gone: its parent has ended, see ``temporary_directory``."""

    def wait() -> None:
        with contextlib.suppress(OSError):
            fcntl.flock(os.open(folder, os.O_RDONLY), fcntl.LOCK_SH)

    _end_after(wait)


def _end_after(wait: Callable[[], None]) -> None:
    def watch() -> None:
        wait()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(GRACE)
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="lifeline").start()


HUNG = 60.0  # s
SHOW_STACKS = signal.SIGUSR1  # makes a node write what its threads are doing
LONGEST_LOOK = 2.0  # s that count at most between two looks: this process may have been stopped with the other
WAITS = "S"  # of the states of proc(5): neither running, nor waiting for a disk, stopped or traced


def show_stacks_when_asked() -> None:
    """Let this process, and what it forks, write the stacks of its threads to stderr when it gets SHOW_STACKS."""
    with contextlib.suppress(RuntimeError, io.UnsupportedOperation):  # it has no stderr
        faulthandler.register(SHOW_STACKS)


class HungDetector:
    """Watches one process; where the system does not say when threads run, no process has ever hung."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._ran: str | None = None  # ns for which its main thread had run when it was looked at
        self._looked, self._latest, self._still = time.monotonic(), time.time(), 0.0

    def update(self) -> str | None:
        """Look at it, about once a second; in words that it has hung, or None."""
        now, before, self._ran = time.monotonic(), self._ran, _run_time(self._pid)
        elapsed, self._looked = min(now - self._looked, LONGEST_LOOK), now
        # The system's clock may have been set back. Waits of the middleware then last until it is there again.
        wall = time.time()
        counts = wall >= self._latest and self._ran is not None and self._ran == before
        self._latest = max(wall, self._latest)
        self._still = self._still + elapsed if counts else 0.0
        return f"hung, its main thread has not run for {HUNG:g} s" if self._still >= HUNG else None


def _run_time(pid: int) -> str | None:
    """For how long the main thread of a process has run [ns], if it waits now and the system counts that (Linux)."""
    thread = Path(f"/proc/{pid}/task/{pid}")
    with contextlib.suppress(OSError, IndexError):
        state = (thread / "stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[0]
        ran = (thread / "schedstat").read_text(encoding="ascii").split()[0]
        return ran if state == WAITS and ran != "0" else None
    return None
