"""The last states that an agent has published, in a file that outlives its process.

Every state is written before it is published. Whoever takes over from a killed process finds there how far it came, and
can publish again what was still on its way; and any agent can send again what a peer that comes back has missed.
"""

from __future__ import annotations

import mmap
import os
import struct
from pathlib import Path

from msg_agents.stepping.synchronizer import AGAIN
from msg_analysis.errors import InputError
from msg_analysis.model.run.record import RunRecord

MOST, LEAST, ROOM = AGAIN, 256, 1 << 24
"""States kept of each agent: as many as find room [bytes], between these. More than the 5,000 that a reader may be
behind (what the middleware keeps of a writer), where that is possible; and always more than agents may be apart."""

# Length of the message, and step + 1, written after it: 0 or an older step's mark until it is whole.
MARK = struct.Struct("<QQ")


def longest_heard(record: RunRecord) -> int:
    """Most steps that ``heard`` of a state message can list in a run.

    Parameters
    ----------
    record
        of the run
    """
    experiment = record.experiment
    return experiment.agents - 1 if experiment.noise.loss or experiment.run.pace == "realtime" else 0


def room_for(size: int) -> int:
    """Bytes of the file of an agent whose longest message has so many.

    Parameters
    ----------
    size
        of the message, in bytes
    """
    slot = size + MARK.size
    return slot * max(LEAST, min(MOST, ROOM // slot))


class Checkpoint:
    """A ring of messages in a memory-mapped file. Survives its process, not its machine.

    Parameters
    ----------
    path
        of the file; made if there is none. None: in memory, for this process only
    size
        bytes of the longest message

    Attributes
    ----------
    found
        whether the file was there: some process has been here before

    Raises
    ------
    InputError
        the file is there and of another size, or there is no room for it
    """

    def __init__(self, path: Path | None, size: int) -> None:
        self.found = False
        self._size = size
        self._slot = size + MARK.size
        total = room_for(size)
        self._capacity = total // self._slot
        if path is None:
            self._map = mmap.mmap(-1, total)
            return
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            found = os.fstat(descriptor).st_size
            if found not in (0, total):
                raise InputError(
                    f"{path}: {found} bytes, expected {total}: it is of another run: remove it, or name another place"
                )
            self.found = bool(found)
            # All of it now: a disk that is full later would kill whoever writes to the map.
            os.posix_fallocate(descriptor, 0, total)
            self._map = mmap.mmap(descriptor, total)
        except OSError as error:
            raise InputError(
                f"{path}: no room for {total} bytes ({error.strerror}): name another place, or let nobody be started "
                "again (--restarts 0)"
            ) from error
        finally:
            os.close(descriptor)

    def write(self, step: int, message: bytes) -> None:
        """Keep the message of a step; steps must come one after the other.

        Parameters
        ----------
        step
            k
        message
            CDR bytes of the state
        """
        start = step % self._capacity * self._slot
        self._map[start : start + len(message)] = message
        MARK.pack_into(self._map, start + self._size, len(message), step + 1)

    def read(self, first: int = 0) -> list[tuple[int, bytes]]:
        """(step, message) of the newest unbroken row of steps, from a first one on, ascending.

        The slot after the newest is left out: it may be torn.

        Parameters
        ----------
        first
            least step that is wanted
        """
        marks = [MARK.unpack_from(self._map, slot * self._slot + self._size) for slot in range(self._capacity)]
        newest = max(mark for _, mark in marks) - 1
        found: list[tuple[int, bytes]] = []
        for step in range(newest, max(first - 1, newest - self._capacity + 1, -1), -1):
            slot = step % self._capacity
            length, mark = marks[slot]
            if mark != step + 1:
                break
            start = slot * self._slot
            found.append((step, self._map[start : start + length]))
        return found[::-1]
