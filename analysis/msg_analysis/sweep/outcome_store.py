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

"""Outcomes on disk: one line of JSON for each, appended and synchronised as soon as it is there."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Self

from msg_analysis.errors import InputError
from msg_analysis.sweep.jobs.job import Outcome

JOURNAL = "points.jsonl"
_FIELDS = {field.name for field in fields(Outcome)}


@dataclass(slots=True)
class OutcomeStore:
    """The outcomes in a directory; a lock lets one process at a time write there."""

    directory: Path
    outcomes: dict[str, Outcome]  # by id of the job; the last one of each
    damaged: int  # lines that could not be read: their jobs are done again
    _descriptor: int

    @classmethod
    def open(cls, directory: str | Path) -> Self:
        """Open a directory, made if needed, and read its outcomes.

        InputError: another process writes there, or the directory cannot be used.
        """
        directory = Path(directory)
        path = directory / JOURNAL
        try:
            directory.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            place = error.filename or directory
            raise InputError(f"{place}: {error.strerror}: choose another place with --out") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(descriptor)
            raise InputError(
                f"{path}: another sweep is writing it: wait for its end, or choose another --out"
            ) from error
        try:
            outcomes, damaged, whole = _read(path)
        except OSError:
            os.close(descriptor)
            raise
        # A last line without its end was being written when a sweep was killed: drop it.
        os.truncate(descriptor, whole)
        os.lseek(descriptor, 0, os.SEEK_END)
        return cls(directory, outcomes, damaged, descriptor)

    def add(self, outcomes: Iterable[Outcome]) -> None:
        """Keep outcomes: when this returns, they are on the disk."""
        lines = b""
        for outcome in outcomes:
            self.outcomes[outcome.id] = outcome
            lines += json.dumps(asdict(outcome)).encode() + b"\n"
        view = memoryview(lines)
        while view:
            view = view[os.write(self._descriptor, view) :]
        os.fsync(self._descriptor)

    def close(self) -> None:
        """Release the lock."""
        os.close(self._descriptor)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _read(path: Path) -> tuple[dict[str, Outcome], int, int]:
    """Outcomes, number of lines that are none, and bytes up to the end of the last whole line."""
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    outcomes: dict[str, Outcome] = {}
    damaged = 0
    for line in content[:whole].splitlines():
        try:
            entry = json.loads(line)
            if not isinstance(entry, dict) or set(entry) != _FIELDS:
                raise ValueError
        except ValueError:
            damaged += 1
            continue
        outcomes[entry["id"]] = Outcome(**entry)
    return outcomes, damaged, whole
