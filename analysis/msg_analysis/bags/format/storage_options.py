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

"""How the files of a bag are stored: their compression, and the size after which a new file begins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from msg_analysis.errors import InputError

Compression = Literal["none", "zstd", "lz4"]
COMPRESSIONS: tuple[Compression, ...] = ("none", "zstd", "lz4")
MEGABYTE = 10**6
SMALLEST_SPLIT = 0.1  # MB; about the size of a chunk
SQLITE_SUFFIX, ZSTD_SUFFIX = ".db3", ".zstd"  # the latter of rosbag2's compression mode `file`
BAG_SUFFIXES = (".mcap", ".mcap.zstd", ".db3", ".db3.zstd")  # of the files that can be read


@dataclass(frozen=True, slots=True)
class Storage:
    """Compression of the chunks, and when the bag goes on in a new file."""

    compression: Compression = "zstd"
    # Bytes of messages per file; None: one file. A file gets larger by its head, its summary and one chunk.
    split_size: int | None = None

    def __post_init__(self) -> None:
        """Check them, wherever they came from."""
        if self.compression not in COMPRESSIONS:
            raise InputError(f"compression: {self.compression!r}: expected one of {', '.join(COMPRESSIONS)}")
        if self.split_size is not None and self.split_size <= 0:
            raise InputError(f"split size: {self.split_size} bytes: expected more than 0")


DEFAULT_STORAGE = Storage()
