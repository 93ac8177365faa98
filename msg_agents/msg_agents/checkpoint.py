"""The last states that an agent has published, in a file that outlives its process.

Every state is written before it is published. Whoever takes over from a killed process finds there how far it came, and
can publish again what was still on its way; and any agent can send again what a peer that comes back has missed.
"""

from __future__ import annotations

import mmap
import os
import struct
from pathlib import Path

from msg_analysis.errors import InputError

MOST, LEAST, ROOM = 6000, 256, 1 << 24
"""States kept of each agent: as many as find room [bytes], between these. More than the 5,000 that a reader may be
behind (what the middleware keeps of a writer), where that is possible; and always more than agents may be apart."""

# Length of the message, and step + 1, written after it: 0 or an older step's mark until it is whole.
_MARK = struct.Struct("<QQ")


class Checkpoint:
    """A ring of messages in a memory-mapped file. Survives its process, not its machine.

    Parameters
    ----------
    path : of the file; made if there is none. None: in memory, for this process only
    size : bytes of the longest message

    Raises
    ------
    InputError : the file is there and of another size
    """

    def __init__(self, path: Path | None, size: int) -> None:
        self._size = size
        self._slot = size + _MARK.size
        self._capacity = max(LEAST, min(MOST, ROOM // self._slot))
        total = self._slot * self._capacity
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
            os.truncate(descriptor, total)
            self._map = mmap.mmap(descriptor, total)
        finally:
            os.close(descriptor)

    def write(self, step: int, message: bytes) -> None:
        """Keep the message of a step; steps must come one after the other."""
        start = step % self._capacity * self._slot
        self._map[start : start + len(message)] = message
        _MARK.pack_into(self._map, start + self._size, len(message), step + 1)

    def read(self, first: int = 0) -> list[tuple[int, bytes]]:
        """(step, message) of the newest unbroken row of steps, from a first one on, ascending.

        The slot after the newest is left out: it may be torn.
        """
        marks = [_MARK.unpack_from(self._map, slot * self._slot + self._size) for slot in range(self._capacity)]
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
