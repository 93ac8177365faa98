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

"""How a run is asked to end early, and at which step it does: two files beside the checkpoints.

They outlive the processes: a switcher that takes over asks for nothing again, and announces the same step.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from uuid import UUID


class StopFiles:
    """The files of a run in its directory of checkpoints."""

    def __init__(self, directory: Path, run: UUID) -> None:
        self._asked, self._decided = directory / f"stop_asked.{run}", directory / f"stop.{run}"

    def ask(self) -> None:
        """Ask the switcher to end the run soon."""
        self._asked.touch()

    def asked(self) -> bool:
        """Whether somebody has asked."""
        return self._asked.exists()

    def decide(self, step: int) -> None:
        """Note the last step of the run, whole or not at all, before it is announced."""
        draft = self._decided.with_suffix(".draft")
        draft.write_text(str(step), encoding="ascii")
        draft.replace(self._decided)

    def decided(self) -> int | None:
        """The last step of the run; None: not decided."""
        with contextlib.suppress(OSError, ValueError):
            return int(self._decided.read_text(encoding="ascii"))
        return None
