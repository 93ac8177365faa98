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

"""What a run tells while it goes on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from msg_agents.processes.fork_server import Process
from msg_agents.watching.run_observer import RunObserver
from msg_analysis.model.run.record import RunRecord


class View:
    """Follows a run; the thread that runs the network calls all methods. This one hands on steps and notes."""

    def __init__(self, on_progress: Callable[[int], None], on_note: Callable[[str], None]) -> None:
        self._on_progress, self._on_note = on_progress, on_note

    def joined(self, domain: int) -> None:
        """The run is in this ROS_DOMAIN_ID, and nothing has been started yet."""

    def begin(self, record: RunRecord, checkpoints: Path | None, observer: RunObserver | None = None) -> None:
        """The processes have been started; ``checkpoints``: directory of the agents' states, if they are kept here.

        ``observer``: follows the run already, and is ended by who has made it.
        """

    def ends_at(self, step: int) -> None:
        """The run ends at this step, before its planned end."""

    def started(self, processes: Mapping[str, Process]) -> None:
        """The processes, by the names of their nodes; again after each restart."""

    def look(self, steps: Sequence[int]) -> None:
        """The newest step of every agent (-1: none; empty before the start), about 20 times a second."""
        if (reached := min(steps, default=-1)) >= 0:
            self._on_progress(reached)

    def note(self, line: str) -> None:
        """A line of text about a restart or stall."""
        self._on_note(line)

    def end(self) -> None:
        """The run is over; its processes may still be there."""
