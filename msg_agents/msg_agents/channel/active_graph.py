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

"""The active graph, from the switcher to the channel: one number in a mapped file, read for every packet."""

from __future__ import annotations

import mmap
import struct
from pathlib import Path
from typing import Self

_NUMBER = struct.Struct("<q")


class ActiveGraphFile:
    """The mode of the active graph, from 0; -1 before the first step, when every packet passes."""

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as stream:
            self._map = mmap.mmap(stream.fileno(), _NUMBER.size)

    @classmethod
    def create(cls, path: Path) -> Self:
        """Make the file, which says -1."""
        path.write_bytes(_NUMBER.pack(-1))
        return cls(path)

    @property
    def mode(self) -> int:
        """The newest mode that was written."""
        return int(_NUMBER.unpack_from(self._map)[0])

    def tell(self, mode: int) -> None:
        """Say that the graph with this mode is active now."""
        _NUMBER.pack_into(self._map, 0, mode)
