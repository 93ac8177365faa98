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

"""Takeover of a node: the new process removes its killed predecessor from the network at once.

The middleware drops a killed process only after 20 s of silence (its lease); until then writers keep what it never
acknowledged, and block after 5,000 messages. A shorter lease would also drop processes that are only stopped or
starved, and lose messages to them. The successor knows that the process is gone: it holds a lock that ends with the
process that held it. So it sends, in the name of the dead process, the message by which a participant leaves.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable
from pathlib import Path

from msg_agents.discovery.rtps import PREFIX_SIZE, remove_participant
from msg_analysis.errors import InputError


class Takeover:
    """The right to run a node, which one process has at a time: a lock on the file ``path``, created if missing.

    ``predecessor``: GUID prefix of the last process; empty if there was none. InputError: another process has the lock.
    """

    def __init__(self, path: Path) -> None:
        # Open, and locked, for as long as this process lives.
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"--checkpoint: another process is running {path.stem}: end that process, or give another directory"
            ) from None
        self.predecessor = os.read(self._descriptor, PREFIX_SIZE)

    def store_prefix(self, prefix: bytes) -> None:
        """Store the GUID prefix of this process for its successor."""
        os.pwrite(self._descriptor, prefix, 0)


def take_over(directory: Path | None, names: Iterable[str]) -> list[Takeover]:
    """Get the right to run these nodes, and remove the processes that ran them before from the network.

    ``directory`` has a file per node; None: no takeover. InputError: another process is running one of the nodes.
    """
    if directory is None:
        return []
    takeovers = [Takeover(directory / f"{name}.participant") for name in names]
    domain = int(os.environ.get("ROS_DOMAIN_ID") or 0)
    for prefix in {t.predecessor for t in takeovers if len(t.predecessor) == PREFIX_SIZE}:
        remove_participant(prefix, domain)
    return takeovers
