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

"""The runs in a folder, by their saved results and run records: no states are read."""

from __future__ import annotations

import os
import re
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from msg_analysis.bags.format.files import first_file
from msg_analysis.bags.format.metadata import METADATA_FILE, starting_time
from msg_analysis.bags.format.storage_options import BAG_SUFFIXES
from msg_analysis.common.files import REPORT_FILE, RESULT_FILE
from msg_analysis.common.intervals import HALF_WIDTH_95
from msg_analysis.errors import BagError, InputError
from msg_analysis.runs.saved_result import read_document, result_row, tested_error

Status = Literal["compared", "not compared", "recording", "torn", "empty", "foreign", "damaged"]

_STAMP = re.compile(r"_(\d{8}_\d{6})(?:_\d+)?$")  # of the folder of a run: its start, by the clock of its machine
_CLOCKS = 10**18  # ns: a bag that starts earlier, in 2001, has the simulated time of the twin
_OURS = {"log", ".recording"}  # what a run makes before anything is recorded


@dataclass(frozen=True, slots=True)
class RunEntry:
    """A folder of a run; None where it has no such thing.

    The system error is that of the saved result, with the standard error that tests use (``given_path``: given the path
    of the graphs).
    """

    folder: str
    status: Status
    date: datetime  # of the start, in local time
    problem: str | None = None  # why the folder is foreign or damaged
    name: str | None = None  # of the experiment
    seed: int | None = None
    run: str | None = None  # id
    verdict: str | None = None
    simulated_time: float | None = None  # that was compared
    measured: float | None = None
    standard_error: float | None = None
    low: float | None = None  # to high: the 95 % interval
    high: float | None = None
    predicted: float | None = None
    z: float | None = None
    given_path: bool = False
    report: str | None = None  # file

    def to_json(self) -> dict[str, Any]:
        """The document of one run."""
        return asdict(self) | {"date": self.date.isoformat(timespec="seconds")}


def list_runs(folder: Path) -> list[RunEntry]:
    """The runs in a folder, oldest first: each of its folders, whatever is in it.

    InputError: it is not there, not a folder, or a bag itself.
    """
    try:
        with os.scandir(folder) as entries:
            inside = list(entries)
    except NotADirectoryError as error:
        raise InputError(f"{folder}: a file: expected a folder with the folders of runs in it") from error
    except OSError as error:
        raise InputError(
            f"{folder}: {error.strerror}: expected a folder with the folders of runs in it, as `msg-agents run --out` "
            "makes it"
        ) from error
    if any(entry.name == METADATA_FILE or entry.name.endswith(BAG_SUFFIXES) for entry in inside):
        raise InputError(f"{folder}: a bag: give the folder it is in: {folder.absolute().parent}")
    inner = (Path(entry) for entry in inside if entry.is_dir() and not entry.name.startswith("."))
    return sorted(map(_entry, inner), key=lambda entry: (entry.date, entry.folder))


def _entry(folder: Path) -> RunEntry:
    try:
        names = {entry.name for entry in folder.iterdir()}
        date = _date(folder, names)
    except OSError as error:
        return RunEntry(str(folder), "damaged", datetime.now().astimezone(), error.strerror)
    report = str(folder / REPORT_FILE) if REPORT_FILE in names else None
    problem = None
    if RESULT_FILE in names:
        try:
            return _compared(folder, date, report)
        except InputError as error:
            problem = str(error)
    status, found = _recorded(folder, names)
    if problem:
        status, found = "damaged", found | {"problem": problem}
    return RunEntry(str(folder), status, date, report=report, **found)


def _date(folder: Path, names: set[str]) -> datetime:
    """When the run began: by the name of its folder, its record, its bag, or when the bag was last changed."""
    stamp = _STAMP.search(folder.name)
    if stamp:
        try:
            return datetime.strptime(stamp[1], "%Y%m%d_%H%M%S").astimezone()
        except ValueError:  # no date
            pass
    from msg_analysis.bags.record_head import started  # here: where all folders have dates, no bag is touched

    if (recorded := started(folder)) is not None:
        return recorded.astimezone()
    start = starting_time(folder) if METADATA_FILE in names else None
    if start is not None and start > _CLOCKS:
        return datetime.fromtimestamp(start / 1e9, UTC).astimezone()
    return datetime.fromtimestamp((first_file(folder) or folder).stat().st_mtime).astimezone()


def _compared(folder: Path, date: datetime, report: str | None) -> RunEntry:
    """By the saved result; InputError: it cannot be used."""
    document = read_document(folder)
    row = result_row(folder, document)
    tested = tested_error(document, folder / RESULT_FILE)
    given = tested is not None and row.standard_error is None
    measured = tested["measured"] if tested else row.measured
    error = tested["standard_error"] if tested else None
    predicted = tested["predicted"] if tested else row.predicted
    known = measured is not None and error is not None
    half = HALF_WIDTH_95 * error if error is not None else 0.0
    return RunEntry(
        str(folder),
        "compared",
        date,
        name=row.experiment,
        seed=_whole(document.get("seed")),
        run=_text(document.get("run")),
        verdict=row.verdict,
        simulated_time=row.simulated_time,
        measured=measured,
        standard_error=error,
        low=measured - half if known and measured is not None else None,
        high=measured + half if known and measured is not None else None,
        predicted=predicted,
        z=(measured - predicted) / error if measured is not None and predicted is not None and error else None,
        given_path=given,
        report=report,
    )


def _recorded(folder: Path, names: set[str]) -> tuple[Status, dict[str, Any]]:
    """Status of a folder without a result, and what its run record says."""
    from msg_analysis.bags.writer import recording_pid  # here: where all runs have results, no bag is touched

    recording = recording_pid(folder) is not None
    if not any(name.endswith(BAG_SUFFIXES) for name in names):
        if recording:
            return "recording", {}
        return ("empty", {}) if names <= _OURS else ("foreign", {"problem": "no bag"})
    status: Status = "recording" if recording else "not compared" if METADATA_FILE in names else "torn"
    from msg_analysis.bags.record_head import record_document

    try:
        document = record_document(folder)
        experiment = document["experiment"]
        found = {"name": experiment["name"], "seed": experiment["run"]["seed"], "run": document["run"]}
        if not isinstance(found["name"], str):
            raise TypeError
    except BagError as error:
        return (status if recording else "foreign"), {"problem": str(error)}
    except InputError as error:
        return "damaged", {"problem": str(error)}
    except (KeyError, TypeError):
        return "damaged", {"problem": f"{folder}: its run record has no name, seed or id"}
    return status, found | {"seed": _whole(found["seed"]), "run": _text(found["run"])}


def _whole(value: Any) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None
