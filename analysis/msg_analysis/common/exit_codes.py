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

"""Exit codes of all commands, as docs/commands.md lists them."""

from __future__ import annotations

import signal
from enum import IntEnum


class ExitCode(IntEnum):
    """What a command found."""

    FINE = 0  # success; a comparison agrees
    DISAGREES = 1
    BAD_INPUT = 2
    INCOMPLETE = 3  # data are missing, or the end was not reached


def killed_by(number: int) -> int:
    """Exit code of a process that a signal ended, as shells report it."""
    return 128 + number


INTERRUPTED = killed_by(signal.SIGINT)
