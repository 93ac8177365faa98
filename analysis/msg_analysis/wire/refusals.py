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

"""Why messages are refused: the reasons that all receivers, the bag reader and the documentation use.

They are keys in results (``refused``, ``strangers``) and in diagnostics: docs/faults.md and docs/messages.md list them.
"""

from __future__ import annotations


class Refusal:
    """A reason for each kind of message, from general to particular."""

    OTHER_RUN = "other run"
    OTHER_EPOCH = "other epoch"
    UNDECODABLE = "undecodable"
    COMPRESSED = "compressed message"
    REPEATED = "received again"  # harmless: nodes send again what a restarted one may have missed
    CONTRADICTION = "contradicts an earlier copy"
    NOT_OF_RECORD = "contradicts the run record"
    NOT_SIGNED = "not signed with the key of the run"
    DUPLICATE_NAME = "duplicate node name"  # not of a message

    # States
    UNKNOWN_AGENT = "unknown agent"
    OTHER_AGENT = "of another agent than its topic"
    NOT_A_PEER = "not a peer"
    WRONG_LENGTH = "wrong length"
    OTHER_LAYOUT = "not in the layout of the agents"
    NOT_FINITE = "not finite"
    UNKNOWN_MODE = "unknown mode"
    OTHER_MODES = "agents used different graphs"
    BAD_HEARD = "impossible entry in heard"
    BEFORE_START = "stamped before the start"
    OUT_OF_RANGE = "step out of range"
    TOO_OLD = "step too old"
    TOO_NEW = "a step that a peer cannot have reached"
    TOO_LATE = "too late"

    # Sojourns of the graph
    OUT_OF_SEQUENCE = "a sojourn out of sequence"
    TOO_EARLY = "a sojourn before its time"
    GRAPH_OUT_OF_RANGE = "graph out of range"
    OTHER_GRAPH = "graph of a step that its states contradict"

    # Files of a bag
    UNREADABLE_FILE = "unreadable file"
    TORN_FILE = "torn file"
    DAMAGED_CHUNK = "damaged chunk"
