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

"""Signatures of the messages that steer a run: only processes that have the run's record with its key can make them.

Progress, end, epoch, leave and requests to resend cannot be compared with the record as the graph can. Who forges one
could end the run for all.
"""

from __future__ import annotations

import hmac
from dataclasses import replace

from msg_analysis.wire.messages import Progress
from msg_analysis.wire.topics import Topic

SIZE = 16  # bytes of the HMAC-SHA256 that are sent, as hexadecimal digits in ``frame_id``


def sign(message: Progress, topic: Topic, key: bytes | None) -> Progress:
    """The message with its signature for a topic; without a key, as it is."""
    return message if key is None else replace(message, frame_id=_signature(message, topic, key))


def genuine(message: Progress, topic: Topic, key: bytes | None) -> bool:
    """Whether the signature is right; without a key, every message passes."""
    return key is None or hmac.compare_digest(message.frame_id.encode(), _signature(message, topic, key).encode())


def _signature(message: Progress, topic: Topic, key: bytes) -> str:
    unsigned = replace(message, frame_id="").encode()
    return hmac.digest(key, topic.name.encode() + b"\0" + unsigned, "sha256")[:SIZE].hex()
