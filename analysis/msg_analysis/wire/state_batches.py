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

"""Many states in one message, on their way to the recorder: msg_agents_interfaces/msg/StateBatch as CDR bytes."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from msg_analysis.types import IntArray
from msg_analysis.wire.cdr_fields import LITTLE_ENDIAN, RUN_SIZE, CdrError, CdrReader

_HEAD = struct.Struct(f"<4s{RUN_SIZE}sI")  # encapsulation, run, number of messages
_LENGTH = struct.Struct("<I")


def encode_batch(run: bytes, messages: Sequence[bytes]) -> bytes:
    """A StateBatch of the run with this id (16 bytes)."""
    sizes = struct.pack(f"<{len(messages)}I", *map(len, messages))
    data = b"".join(messages)
    return b"".join((_HEAD.pack(LITTLE_ENDIAN, run, len(messages)), sizes, _LENGTH.pack(len(data)), data))


def decode_batch(data: bytes) -> tuple[bytes, IntArray, bytes]:
    """Run id, (messages,) sizes, and the messages one behind the other; CdrError where it is not a StateBatch."""
    reader = CdrReader(data, "StateBatch")
    run, sizes = reader.raw(RUN_SIZE, "run"), reader.array("u4", "size").astype(np.int64)
    messages = reader.array("u1", "messages").tobytes()
    reader.end()
    if int(sizes.sum()) != len(messages):
        raise CdrError(f"StateBatch: sizes of {int(sizes.sum())} bytes, messages of {len(messages)}")
    return run, sizes, messages
