# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What a process needs to take over from a killed one: checkpoints of states, stop files, and the right to run a node.

Every state is written to the checkpoint before it is published. A process that takes over resumes from there, and
publishes again what may have been lost on the way. It also removes its predecessor from the network at once: the
middleware would drop that only after an hour of silence (its lease), and until then writers keep what it never
acknowledged, and block after 5,000 messages.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from uuid import UUID

from msg_agents.discovery.rtps import PREFIX_SIZE, remove_participant
from msg_agents.stepping.synchronizer import RESEND_LIMIT
from msg_analysis.common.files import lock, write_whole
from msg_analysis.errors import InputError
from msg_analysis.messages.acceptance import state_frame
from msg_analysis.model.run_record import RunRecord


class StopFiles:
    """How a run is asked to end early, and at which step it does: two files beside the checkpoints."""

    def __init__(self, directory: Path, run: UUID) -> None:
        self._asked, self._decided = directory / f"stop_asked.{run}", directory / f"stop.{run}"

    def ask(self) -> None:
        """Ask the switcher to end the run soon."""
        self._asked.touch()

    def asked(self) -> bool:
        """Whether somebody has asked."""
        return self._asked.exists()

    def decide(self, step: int) -> None:
        """Note the last step of the run before it is announced."""
        write_whole(self._decided, str(step).encode())

    def decided(self) -> int | None:
        """The last step of the run; None: not decided."""
        with contextlib.suppress(OSError, ValueError):
            return int(self._decided.read_text(encoding="ascii"))
        return None


# States kept of each agent: as many as fit into ROOM bytes, but always more steps than agents may be apart, and at most
# more than the 5,000 messages that the middleware keeps of a writer for slow readers.
LEAST_STATES, ROOM = 256, 1 << 24

# After each entry: its length and step + 1; 0 from before the entry is written until it is whole.
FOOTER = struct.Struct("<QQ")


def published_size(record: RunRecord) -> int:
    """Bytes of what agents publish of a state, where that is not the state itself; else 0: it is not kept."""
    return 8 * record.experiment.run.replicas if record.experiment.truth else 0


def entry_size(record: RunRecord) -> int:
    """Bytes of the longest entry of a run: a message with the whole state, and behind it what is published of it."""
    return state_frame(record, whole=True).size + published_size(record)


def room_for(size: int) -> int:
    """Size of the checkpoint file of an agent whose longest entry has ``size`` bytes."""
    slot = size + FOOTER.size
    return slot * max(LEAST_STATES, min(RESEND_LIMIT, ROOM // slot))


class Checkpoint:
    """A ring of entries in a memory-mapped file (None: in memory only), which survives its process, not its machine."""

    def __init__(self, path: Path | None, size: int) -> None:  # size: that of the longest entry in bytes
        self.found = False  # whether the file was there: another process has run this agent before
        self._size = size
        self._slot = size + FOOTER.size
        total = room_for(size)
        self.capacity = total // self._slot  # entries
        if path is None:
            self._map = mmap.mmap(-1, total)
            return
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            found = os.fstat(descriptor).st_size
            if found not in (0, total):
                raise InputError(
                    f"{path}: {found} bytes, expected {total}: it belongs to another run: remove it, or give another "
                    "directory"
                )
            self.found = bool(found)
            # Allocate all of it now: if the disk were full later, writing to the map would kill the process.
            os.posix_fallocate(descriptor, 0, total)
            self._map = mmap.mmap(descriptor, total)
        except OSError as error:
            raise InputError(
                f"{path}: no room for {total} bytes ({error.strerror}): give another directory, or allow no restarts "
                "(--restarts 0)"
            ) from error
        finally:
            os.close(descriptor)

    def write(self, step: int, entry: bytes) -> None:
        """Keep the entry of a step; steps must be consecutive."""
        start = step % self.capacity * self._slot
        FOOTER.pack_into(self._map, start + self._size, 0, 0)  # a reader meanwhile must not take it for the old entry
        self._map[start : start + len(entry)] = entry
        FOOTER.pack_into(self._map, start + self._size, len(entry), step + 1)

    def read(self, first: int = 0) -> list[tuple[int, bytes]]:
        """(step, entry) of the newest consecutive steps, ascending, from step ``first`` on."""
        footers = [FOOTER.unpack_from(self._map, slot * self._slot + self._size) for slot in range(self.capacity)]
        newest = max(number for _, number in footers) - 1
        found: list[tuple[int, bytes]] = []
        # Without the slot after the newest, which may be torn.
        for step in range(newest, max(first - 1, newest - self.capacity + 1, -1), -1):
            slot = step % self.capacity
            length, number = footers[slot]
            if number != step + 1:
                break
            start = slot * self._slot
            found.append((step, self._map[start : start + length]))
        return found[::-1]


class Takeover:
    """The right to run a node, which one process has at a time: a lock on a file; InputError: another one has it."""

    def __init__(self, path: Path) -> None:
        # Open, and locked, for as long as this process lives.
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            lock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, path)
        except BlockingIOError:
            raise InputError(
                f"--checkpoint: another process is running {path.stem}: end that process, or give another directory"
            ) from None
        self.predecessor = os.read(self._descriptor, PREFIX_SIZE)  # its GUID prefix; empty if there was none

    def store_prefix(self, prefix: bytes) -> None:
        """Store the GUID prefix of this process for its successor."""
        os.pwrite(self._descriptor, prefix, 0)


def take_over(
    directory: Path | None, names: Iterable[str], remove: Callable[[bytes, int], object] = remove_participant
) -> list[Takeover]:
    """Get the right to run these nodes, by a file each, and remove the processes that ran them before."""
    if directory is None:
        return []
    takeovers = [Takeover(directory / f"{name}.participant") for name in names]
    domain = int(os.environ.get("ROS_DOMAIN_ID") or 0)
    for prefix in {t.predecessor for t in takeovers if len(t.predecessor) == PREFIX_SIZE}:
        remove(prefix, domain)
    return takeovers
