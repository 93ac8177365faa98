# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The runs in a folder: found, filtered, with their results."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

from msg_analysis.bags.files import METADATA_FILE, first_file, starting_time
from msg_analysis.bags.stored_file import BAG_SUFFIXES
from msg_analysis.common.files import REPORT_FILE, RESULT_FILE, read_text, write_whole
from msg_analysis.common.text import HALF_WIDTH_95, agent_name, json_text, with_names
from msg_analysis.errors import BagError, InputError

_WANTED = "expected what `msg-analysis compare --json` or `msg-agents run` wrote"
LARGEST = 1e150  # of numbers: their squares are finite
LONGEST_INTEGER = 300  # digits; floats have 309
_RENAMED = {"blame": "causes", "strangers": "rejected_messages"}  # keys of results of before


@dataclass(frozen=True, slots=True)
class Result:
    """A row: one saved comparison; None where it has no such number."""

    file: str
    experiment: str
    seeds: str  # of all runs: "1 2"
    bags: int  # number of runs
    leaders: str  # names, or numbers from 1: "3" or "1 4"; empty without
    verdict: str
    simulated_time: float  # of all runs [units of simulated time]
    measured: float | None  # system error, like the next five
    standard_error: float | None
    low: float | None  # to high: the 95 % interval
    high: float | None
    predicted: float | None
    z: float | None
    least_p: float | None  # least adjusted p of the tests
    causes: str  # causes, separated by "; "; empty where nothing is wrong
    identity: str | None  # equal for runs of the same law


def read_result(path: Path) -> Result:
    """Read a saved result, from a file or the directory of a run; InputError if it is not there or not a result."""
    return result_row(path, read_document(path))


def read_document(path: Path) -> dict[str, Any]:
    """The document of a saved result, which only ``result_row`` checks; arguments and errors as of ``read_result``."""
    file = _file(path)
    if file != path and file.exists() and not file.is_file():
        raise InputError(f"{file}: not a regular file: {_WANTED}")
    try:
        document = json.loads(read_text(file), parse_int=_bounded)
        json.dumps(document, ensure_ascii=False).encode()  # UnicodeEncodeError: half of a surrogate pair
    except OSError as error:
        raise InputError(f"{file}: {error.strerror}: {_WANTED}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: not JSON ({error}): {_WANTED}") from error
    if not isinstance(document, dict):
        raise InputError(f"{file}: not a JSON object: {_WANTED}")
    return {_RENAMED.get(key) or key: value for key, value in document.items()}


def _bounded(digits: str) -> int:
    """An integer that is not too large for a float; ValueError: it is."""
    if len(digits) > LONGEST_INTEGER:
        raise ValueError(f"an integer of {len(digits)} digits")
    return int(digits)


def keep_result(bag: Path, document: dict[str, Any]) -> None:
    """Keep a comparison with its bag, as ``result.json``, beside what a network has said of it there; OSError."""
    try:
        before = read_document(bag)
    except InputError:
        before = {"bag": str(bag)}
    if before.get("run") not in (None, document["run"]):  # not of this run
        before = {"bag": str(bag)}
    until = before.get("until") or document["until"]
    write_whole(bag / RESULT_FILE, json_text(before | document | {"until": until}, 1).encode() + b"\n")


def _file(path: Path) -> Path:
    return path / RESULT_FILE if path.is_dir() else path


def result_row(path: Path, document: dict[str, Any]) -> Result:
    """The row of a document of ``read_document``; InputError if it is not a result."""
    try:
        return _row(path, document)
    except (ArithmeticError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{_file(path)}: {error}: {_WANTED}") from error


def _row(path: Path, document: dict[str, Any]) -> Result:
    file = _file(path)
    total = _part(document, "system_error", dict, file)
    interval = total.get("interval")
    if not isinstance(interval, list) or len(interval) != 2:
        raise InputError(f"{file}: system_error.interval: {_short(interval)}: {_WANTED}")
    bags = _parts(document, "bags", file)
    seeds = [run.get("seed") for run in bags or [document]]
    tests = [_number(test, "p_adjusted", file) for test in _parts(document, "tests", file)]
    given = document.get("names")
    if given is not None and not (isinstance(given, list) and all(isinstance(name, str) for name in given)):
        raise InputError(f"{file}: names: {_short(given)}: expected a list of texts, or null: {_WANTED}")
    names = given
    causes = [with_names(str(cause.get("words")), names) for cause in _parts(document, "causes", file)]
    leaders = document["leaders"] if isinstance(document.get("leaders"), list) else ()
    identity = document.get("experiment_identity")
    return Result(
        file=str(path),
        experiment=_part(document, "experiment", str, file),
        seeds=" ".join(str(seed) for seed in seeds if seed is not None),
        bags=len(bags) or 1,
        leaders=" ".join(
            agent_name(leader, names) if isinstance(leader, int) else str(leader) for leader in leaders or ()
        ),
        verdict=_part(document, "verdict", str, file),
        simulated_time=_number(document, "simulated_time", file) or 0.0,
        measured=_number(total, "measured", file),
        standard_error=_number(total, "standard_error", file),
        low=_number({"interval": interval[0]}, "interval", file),
        high=_number({"interval": interval[1]}, "interval", file),
        predicted=_number(total, "predicted", file),
        z=_number(total, "z", file),
        least_p=min((p for p in tests if p is not None), default=None),
        causes="; ".join(causes),
        identity=identity if isinstance(identity, str) else None,
    )


def _short(value: Any) -> str:
    try:
        text = repr(value)
    except RecursionError:
        text = "lists or objects in each other"
    return text if len(text) <= 100 else f"{text[:100]}..."


def _part(document: dict[str, Any], key: str, kind: type, file: Path) -> Any:
    value = document.get(key)
    if not isinstance(value, kind):
        raise InputError(f"{file}: {key}: {_short(value)}: expected that of a result of `msg-analysis compare --json`")
    return value


def _parts(document: dict[str, Any], key: str, file: Path) -> list[dict[str, Any]]:
    """The objects of a list; none where it is null or not there."""
    value = document.get(key) or []
    if not isinstance(value, list) or not all(isinstance(part, dict) for part in value):
        raise InputError(f"{file}: {key}: expected a list of objects, as `msg-analysis compare --json` writes it")
    return value


def _number(document: Any, key: str, file: Path) -> float | None:
    value = document.get(key) if isinstance(document, dict) else document
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < LARGEST:
        raise InputError(f"{file}: {key}: {_short(value)}: expected a number")
    return float(value)


def tested_error(document: dict[str, Any], file: Path) -> dict[str, float | None] | None:
    """The system error of a document with the standard error that tests use; None where it has none."""
    # In runs that are too short for one over all paths of the graphs: that given the path, with the error corrected.
    given = document.get("given_path")
    for part in (document, given if isinstance(given, dict) else {}):
        error = part.get("system_error")
        if isinstance(error, dict) and error.get("standard_error") is not None:
            return {key: _number(error, key, file) for key in ("measured", "standard_error", "predicted")}
    return None


Status = Literal["compared", "not compared", "recording", "torn", "empty", "foreign", "damaged"]

_STAMP = re.compile(r"_(\d{8}_\d{6})(?:_\d+)?$")  # of the folder of a run: its start, in UTC
_CLOCKS = 10**18  # ns: a bag that starts earlier, in 2001, has the simulated time of the twin
_OURS = {"log", ".recording"}  # what a run makes before anything is recorded


@dataclass(frozen=True, slots=True)
class RunEntry:
    """A folder of a run, with the system error of its saved result; None where it has no such thing."""

    folder: str
    status: Status
    date: datetime  # of the start, in UTC
    problem: str | None = None  # why the folder is foreign or damaged
    name: str | None = None  # of the experiment
    seed: int | None = None
    run: str | None = None  # id
    verdict: str | None = None
    prediction: str | None = None  # for real time, made before the run: supported, not supported, not decided
    simulated_time: float | None = None  # that was compared
    measured: float | None = None
    standard_error: float | None = None
    low: float | None = None  # to high: the 95 % interval
    high: float | None = None
    predicted: float | None = None
    z: float | None = None
    given_path: bool = False  # whether the standard error is that given the path of the graphs
    report: str | None = None  # file

    def to_json(self) -> dict[str, Any]:
        """The document of one run."""
        return asdict(self) | {"date": self.date.isoformat(timespec="seconds")}


def list_runs(folder: Path) -> list[RunEntry]:
    """The runs in a folder, oldest first: each of its folders. InputError: it is not there, no folder, or a bag."""
    try:
        with os.scandir(folder) as entries:
            inside = list(entries)
    except OSError as error:
        problem = "a file" if isinstance(error, NotADirectoryError) else error.strerror
        wanted = "expected a folder with the folders of runs in it, as `msg-agents run --out` makes it"
        raise InputError(f"{folder}: {problem}: {wanted}") from error
    if any(entry.name == METADATA_FILE or entry.name.endswith(BAG_SUFFIXES) for entry in inside):
        raise InputError(f"{folder}: a bag: give the folder it is in: {folder.absolute().parent}")
    inner = (Path(entry) for entry in inside if entry.is_dir() and not entry.name.startswith("."))
    return sorted(map(_entry, inner), key=lambda entry: (entry.date, entry.folder))


def _entry(folder: Path) -> RunEntry:
    try:
        names = {entry.name for entry in folder.iterdir()}
        date = _date(folder, names)
    except OSError as error:
        return RunEntry(str(folder), "damaged", datetime.now(UTC), error.strerror)
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
    """When the run began, in UTC: by its record, the name of its folder, its bag, or when the bag was last changed."""
    from msg_analysis.bags.reading import started

    if (recorded := started(folder)) is not None:
        return recorded.astimezone(UTC)
    stamp = _STAMP.search(folder.name)
    if stamp:
        try:
            return datetime.strptime(stamp[1], "%Y%m%d_%H%M%S").replace(tzinfo=UTC)
        except ValueError:  # no date
            pass
    start = starting_time(folder) if METADATA_FILE in names else None
    if start is not None and start > _CLOCKS:
        return datetime.fromtimestamp(start / 1e9, UTC)
    return datetime.fromtimestamp((first_file(folder) or folder).stat().st_mtime, UTC)


def _compared(folder: Path, date: datetime, report: str | None) -> RunEntry:
    """By the saved result; InputError: it cannot be used."""
    document = read_document(folder)
    row = result_row(folder, document)
    untested = {"measured": row.measured, "standard_error": None, "predicted": row.predicted}
    tested = tested_error(document, folder / RESULT_FILE) or untested
    measured, error, predicted = tested["measured"], tested["standard_error"], tested["predicted"]
    if row.verdict == "incomplete" and not row.simulated_time:
        measured = error = None  # nothing was compared
    low = high = z = None
    if measured is not None and error is not None:
        low, high = measured - HALF_WIDTH_95 * error, measured + HALF_WIDTH_95 * error
        z = (measured - predicted) / error if predicted is not None and error else None
    return RunEntry(
        str(folder),
        "compared",
        date,
        name=row.experiment,
        seed=_whole(document.get("seed")),
        run=_text(document.get("run")),
        verdict=row.verdict,
        prediction=_of_prediction(document),
        simulated_time=row.simulated_time,
        measured=measured,
        standard_error=error,
        low=low,
        high=high,
        predicted=predicted,
        z=z,
        given_path=error is not None and row.standard_error is None,
        report=report,
    )


def _of_prediction(document: dict[str, Any]) -> str | None:
    """Whether a run in real time supports what was predicted before it, in words."""
    real_time = document.get("real_time")
    if not isinstance(real_time, dict):
        return None
    found = real_time.get("prediction")
    return "not decided" if found is None else "supported" if found is True else "not supported"


def _recorded(folder: Path, names: set[str]) -> tuple[Status, dict[str, Any]]:
    """Status of a folder without a result, and what its run record says."""
    from msg_analysis.bags.writing import recording_pid  # here: where all runs have results, no bag is touched

    recording = recording_pid(folder) is not None
    if not any(name.endswith(BAG_SUFFIXES) for name in names):
        if recording:
            return "recording", {}
        return ("empty", {}) if names <= _OURS else ("foreign", {"problem": "no bag"})
    status: Status = "recording" if recording else "not compared" if METADATA_FILE in names else "torn"
    from msg_analysis.bags.reading import record_document

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


SortKey = Literal["date", "name", "seed", "verdict", "error"]
NO_VERDICT = "none"

_AGE = re.compile(r"(\d{1,6})([mhd])")
_UNITS = {"m": "minutes", "h": "hours", "d": "days"}
_SORT_KEYS: dict[SortKey, Callable[[RunEntry], Any]] = {
    "date": lambda run: (run.date, run.folder),
    "name": lambda run: (run.name is None, run.name),
    "seed": lambda run: (run.seed is None, run.seed),
    "verdict": lambda run: (run.verdict is None, run.verdict),
    "error": lambda run: math.inf if run.measured is None else run.measured,
}


@dataclass(frozen=True, slots=True)
class RunFilter:
    """What a run must have; empty or None: anything."""

    name: str | None = None  # of the experiment, or a pattern such as line_*
    verdicts: tuple[str, ...] = ()  # one of them; ``NO_VERDICT``: none
    since: datetime | None = None
    until: datetime | None = None  # not included
    seed: int | None = None
    last: int | None = None  # how many at most: the newest

    def choose(self, runs: Sequence[RunEntry], sort: SortKey = "date") -> list[RunEntry]:
        """Those that have it, sorted; runs without the key come last, equal ones are in the order of their dates."""
        chosen = sorted(filter(self._has, runs), key=_SORT_KEYS["date"])
        if self.last is not None:
            chosen = chosen[max(0, len(chosen) - self.last) :]
        return sorted(chosen, key=_SORT_KEYS[sort])

    def _has(self, run: RunEntry) -> bool:
        return (
            (self.name is None or (run.name is not None and fnmatchcase(run.name, self.name)))
            and (not self.verdicts or (run.verdict or NO_VERDICT) in self.verdicts)
            and (self.since is None or run.date >= self.since)
            and (self.until is None or run.date < self.until)
            and (self.seed is None or run.seed == self.seed)
        )


def moment(text: str, option: str, now: datetime, *, end: bool = False) -> datetime:
    """A date (its beginning, or its ``end``), a time in UTC or with a zone, or an age before ``now``; InputError."""
    age = _AGE.fullmatch(text)
    try:
        if age:
            return now - timedelta(**{_UNITS[age[2]]: int(age[1])})
        found = datetime.fromisoformat(text)
        if end and not re.search(r"[T: ]", text):
            found += timedelta(days=1)
        return found if found.tzinfo else found.replace(tzinfo=UTC)
    except (ValueError, OverflowError):
        raise InputError(
            f"{option} {text}: expected a date (2026-11-25), a date and a time (2026-11-25T14:30), or an age in "
            "minutes, hours or days (30m, 12h, 7d)"
        ) from None
