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

"""The last states that an agent has published, in a file that remains when its process is killed.

Every state is written before it is published. A process that takes over from a killed one resumes from there, and
publishes again what may have been lost on the way. Any agent can also repeat what a restarted peer has missed.
"""

from __future__ import annotations

import mmap
import os
import struct
from pathlib import Path

from msg_agents.stepping.synchronizer import RESEND_LIMIT
from msg_analysis.errors import InputError
from msg_analysis.model.run.record import RunRecord
from msg_analysis.wire.receiving import state_frame

MOST_KEPT, LEAST_KEPT, ROOM = RESEND_LIMIT, 256, 1 << 24
"""States kept of each agent: as many as fit into ROOM bytes, from LEAST_KEPT to MOST_KEPT. Where possible, more than
the 5,000 that the middleware keeps of a writer for slow readers; always more steps than agents may be apart."""

# Length of the entry and step + 1; 0 from before the entry is written until it is whole.
MARK = struct.Struct("<QQ")


def published_size(record: RunRecord) -> int:
    """Bytes of what agents publish of a state, where that is not the state itself; else 0: it is not kept."""
    return 8 * record.experiment.run.replicas if record.experiment.truth else 0


def entry_size(record: RunRecord) -> int:
    """Bytes of the longest entry of a run: a message with the whole state, and behind it what is published of it."""
    return state_frame(record, whole=True).size + published_size(record)


def room_for(size: int) -> int:
    """Size of the checkpoint file of an agent whose longest entry has ``size`` bytes."""
    slot = size + MARK.size
    return slot * max(LEAST_KEPT, min(MOST_KEPT, ROOM // slot))


class Checkpoint:
    """A ring of entries in a memory-mapped file, which survives its process, but not its machine.

    ``found``: the file was there, so another process has run this agent before. ``size`` is that of the longest entry
    in bytes. Without a path it is in memory, for this process only. InputError: a file of another size, or no room.
    """

    def __init__(self, path: Path | None, size: int) -> None:
        self.found = False
        self._size = size
        self._slot = size + MARK.size
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
        MARK.pack_into(self._map, start + self._size, 0, 0)  # who reads meanwhile must not take it for the old one
        self._map[start : start + len(entry)] = entry
        MARK.pack_into(self._map, start + self._size, len(entry), step + 1)

    def read(self, first: int = 0) -> list[tuple[int, bytes]]:
        """(step, entry) of the newest consecutive steps, ascending, from step ``first`` on.

        The slot after the newest is left out: it may be torn.
        """
        marks = [MARK.unpack_from(self._map, slot * self._slot + self._size) for slot in range(self.capacity)]
        newest = max(mark for _, mark in marks) - 1
        found: list[tuple[int, bytes]] = []
        for step in range(newest, max(first - 1, newest - self.capacity + 1, -1), -1):
            slot = step % self.capacity
            length, mark = marks[slot]
            if mark != step + 1:
                break
            start = slot * self._slot
            found.append((step, self._map[start : start + length]))
        return found[::-1]
