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

"""The file system in memory, where there is one."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from msg_analysis.errors import InputError

MEMORY = Path("/dev/shm")
"""A page of a file on a disk costs about twice as much to write for the first time, and again after each time the
system has saved it."""

LEAST = 64 << 10  # bytes; where a page that ROS maps there cannot be had, the processes of a run die of SIGBUS


def free_space(directory: Path) -> int:
    """Bytes that we could write there."""
    try:
        return shutil.disk_usage(directory).free if os.access(directory, os.W_OK) else 0
    except OSError:
        return 0


def require_shared_memory(directory: Path = MEMORY) -> None:
    """InputError if it is full. Without it, or where it cannot be written, a run does without."""
    # The library of the tracer LTTng, which rclpy loads, makes a file of one page there and writes to it.
    if os.access(directory, os.W_OK) and (free := free_space(directory)) < LEAST:
        raise InputError(
            f"{directory}: full ({free} bytes free): ROS 2 processes would be killed by SIGBUS: remove what is not "
            "used, with `fastdds shm clean` or by hand"
        )
