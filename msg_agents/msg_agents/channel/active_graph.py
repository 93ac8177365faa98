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

"""The active graph, for the channel: which one it is, as the switcher says, and to whom it does not apply meanwhile.

Numbers in a mapped file, read for every packet.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path
from typing import Self

_MODE = struct.Struct("<q")


class ActiveGraphFile:
    """The mode of the active graph, from 0; -1 before the first step, when every packet passes; and a byte per host."""

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as stream:
            self._map = mmap.mmap(stream.fileno(), 0)

    @classmethod
    def create(cls, path: Path, hosts: int) -> Self:
        """Make the file, which says -1, and nothing of the hosts."""
        path.write_bytes(_MODE.pack(-1) + bytes(hosts))
        return cls(path)

    @property
    def mode(self) -> int:
        """The newest mode that was written."""
        return int(_MODE.unpack_from(self._map)[0])

    def tell(self, mode: int) -> None:
        """Say that the graph with this mode is active now."""
        _MODE.pack_into(self._map, 0, mode)

    def lets_through(self, host: int) -> bool:
        """Whether all packets from and to a host, from 0, pass."""
        return bool(self._map[_MODE.size + host])

    def let_through(self, host: int, *, all_packets: bool) -> None:
        """Say whether they do."""
        self._map[_MODE.size + host] = all_packets
