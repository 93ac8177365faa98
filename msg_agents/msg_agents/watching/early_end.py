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

"""The end of a run before its duration (``--until``): who asks for it, and what became of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from msg_agents.recovery.stop_files import StopFiles
from msg_agents.watching.run_observer import RunObserver
from msg_analysis.model.run.record import RunRecord


class EarlyEnd:
    """Follows a run, and asks the switcher to end it when that is enough; a context.

    The request is a file, so a killed switcher that is restarted finds it again. Without an answer, the run goes on to
    its planned end: the observer has failed, or the answer comes too late to end earlier.
    """

    def __init__(self, record: RunRecord, checkpoints: Path) -> None:
        assert record.until is not None
        self._record, self._until = record, record.until
        self._files = StopFiles(checkpoints, record.run)
        self._decided, self._asked, self._given_up = False, False, False
        self.last_step = record.experiment.steps
        self.observer = RunObserver(record, checkpoints)

    def look(self, reached: int, note: Callable[[str], None]) -> bool:
        """Take the newest step that all agents have published; True once: ``last_step`` is now known to be earlier."""
        self.observer.look(reached)
        if not self._asked and self.observer.reached is not None:
            self._asked = True
            self._files.ask()
            note(f"--until {self._until}: {self.observer.reached}: the run ends soon")
        if not self._given_up and self.observer.note is not None:
            self._given_up = True
            note(f"--until {self._until}: {self.observer.note}: the run goes on to step {self.last_step}")
        if not self._asked or self._decided or (step := self._files.decided()) is None:
            return False
        self._decided, self.last_step = True, step
        self.observer.ends_at(step)
        return True

    def to_json(self) -> dict[str, Any]:
        """Key ``until`` of result.json."""
        return {
            "rule": str(self._until),
            "planned_steps": self._record.experiment.steps,
            "ended_early": self._decided,
            "step": self.last_step,
            "reason": self._reason(),
        }

    def _reason(self) -> str:
        observer = self.observer
        if observer.reached is not None:
            late = "" if self._decided else ", too late to end earlier"
            return f"{observer.reached}{late}"
        if observer.note is not None:
            return f"not known: {observer.note}"
        if observer.report is None:
            return "not reached"
        from msg_analysis.inference.online.stopping import precision_words

        return f"not reached: {precision_words(observer.report)}"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.observer.end()
