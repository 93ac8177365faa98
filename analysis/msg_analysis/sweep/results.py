# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""A sweep from its start to its table of results.

Conducting a sweep: outcomes that are there are kept, the other jobs are done, and all are judged together.

``jobs.workers`` decides where a job runs, ``jobs.evaluate`` what is done in it.
"""

from __future__ import annotations

import dataclasses
import fcntl
import io
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from msg_analysis.common.files import write_whole
from msg_analysis.common.text import json_text
from msg_analysis.errors import ExitCode, InputError
from msg_analysis.inference.statistics import holm
from msg_analysis.sweep.grid import Sweep
from msg_analysis.sweep.points import DONE, FAILED, Job, NetworkOptions, Outcome, evaluate, installed_software
from msg_analysis.sweep.workers import Lost, Workers, deferring_interrupts

if TYPE_CHECKING:
    import pyarrow as pa


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


OtherSoftware = Literal["refuse", "redo", "keep"]
NETWORK_PATIENCE = 60.0  # s that running networks have to end in order

SweepProgress = Callable[[int, int, int], None]  # outcomes available, total, how many of them failed


@dataclass(frozen=True, slots=True)
class Conducted:
    """What was done."""

    outcomes: tuple[Outcome, ...]  # in the order of the jobs
    kept: int  # jobs that had been done before
    others: int  # outcomes in the store that belong to none of the jobs


def conduct(
    jobs: Sequence[Job],  # equal ones are done once
    store: OutcomeStore,
    *,
    workers: int | None = None,  # processes here; None: one per CPU, or a single one where networks run
    scheduler: str | None = None,  # of a Dask cluster, whose workers are used instead
    network: NetworkOptions | None = None,  # needed where jobs run networks
    other_software: OtherSoftware = "refuse",  # what to do with outcomes that other software made
    retry: bool = False,  # whether failed jobs are done again
    watch: SweepProgress = lambda _done, _total, _failed: None,
) -> Conducted:
    """Do all jobs that have not been done; outcomes are kept in ``store`` as soon as they come.

    InputError: outcomes of other software ("refuse"), or no workers. WorkersLostError: the cluster went away.
    """
    todo = _todo(jobs, store, other_software, retry)
    kept = len(jobs) - sum(job.id in todo for job in jobs)
    total = len({job.id for job in jobs})
    failed = sum(store.outcomes[job.id].status == FAILED for job in jobs if job.id not in todo)
    done = total - len(todo)
    watch(done, total, failed)
    if todo:
        runs_networks = any(job.kind == "network" for job in todo.values())
        if runs_networks and not scheduler:
            workers = workers or 1
        items = [dataclasses.replace(job, network=network) for job in todo.values()]
        patience = {"patience": NETWORK_PATIENCE} if runs_networks else {}
        with Workers(workers, scheduler) as pool, closing(pool.outcomes(evaluate, items, **patience)) as batches:
            for batch in batches:
                found = [_lost(job, result) if isinstance(result, Lost) else result for job, result in batch]
                with deferring_interrupts():  # what is said to be kept is what is on the disk
                    store.add(found)
                done += len(found)
                failed += sum(outcome.status == FAILED for outcome in found)
                watch(done, total, failed)
    outcomes = tuple(store.outcomes[job.id] for job in jobs)
    return Conducted(outcomes, kept, len(store.outcomes.keys() - {job.id for job in jobs}))


def _todo(jobs: Sequence[Job], store: OutcomeStore, other_software: OtherSoftware, retry: bool) -> dict[str, Job]:
    """The jobs that have to be done, by id."""
    todo, others = {}, {}
    for job in jobs:
        known = store.outcomes.get(job.id)
        if known is None or (retry and known.status == FAILED):
            todo[job.id] = job
        elif known.software != installed_software() and other_software != "keep":
            others[job.id] = known.software
            todo[job.id] = job
    if others and other_software == "refuse":
        was = " and ".join(sorted(set(others.values())))
        raise InputError(
            f"{store.directory}: {len(others)} results were made with other software ({was}), not "
            f"{installed_software()}: choose another --out, or use --other-software redo or keep"
        )
    return todo


def _lost(job: Job, lost: Lost) -> Outcome:
    return Outcome(job.id, FAILED, lost.reason, {}, 0.0, "", installed_software())


@dataclass(frozen=True, slots=True)
class Judgement:
    """What the runs of a sweep say together; the tuples are in the order of the outcomes."""

    p_holm: tuple[float | None, ...]  # p-values, adjusted over all of them (Holm); None where there is none
    verdicts: tuple[str | None, ...]  # "agrees", "disagrees", "unpredicted"; None for predictions and failures
    # "disagrees" if any run does; else "incomplete" if anything failed; else "agrees", or None for predictions. Runs
    # that are all "unpredicted" count as "agrees".
    verdict: str | None

    @property
    def exit_code(self) -> int:
        """0 agrees or only predictions, 1 disagrees, 3 something failed."""
        if self.verdict == "disagrees":
            return ExitCode.DISAGREES
        return ExitCode.INCOMPLETE if self.verdict == "incomplete" else ExitCode.FINE


def judge_sweep(outcomes: Sequence[Outcome], level: float) -> Judgement:
    """Judge all runs together (Holm): the chance of any false "disagrees" is at most ``level``."""
    p_values: list[float | None] = [outcome.result.get("p") if outcome.status == DONE else None for outcome in outcomes]
    tested = [place for place, p in enumerate(p_values) if p is not None]
    adjusted: list[float | None] = [None] * len(outcomes)
    if tested:
        for place, p in zip(tested, holm(np.array([p_values[place] for place in tested], dtype=float)), strict=True):
            adjusted[place] = float(p)
    verdicts = tuple(_verdict(outcome, p, level) for outcome, p in zip(outcomes, adjusted, strict=True))
    whole: str | None = "agrees" if any(verdicts) else None
    if any(outcome.status == FAILED for outcome in outcomes):
        whole = "incomplete"
    if "disagrees" in verdicts:
        whole = "disagrees"
    return Judgement(tuple(adjusted), verdicts, whole)


def _verdict(outcome: Outcome, p_holm: float | None, level: float) -> str | None:
    result: Mapping[str, Any] = outcome.result
    if outcome.status == FAILED or "verdict" not in result:
        return None
    if p_holm is not None and p_holm < level:
        return "disagrees"
    return "unpredicted" if result.get("unpredicted") else "agrees"


Row = dict[str, Any]
_LEFT_OUT = {"agents", "stationary", "failure", "bag", "verdict"}
_ESTIMATE = ("measured", "predicted", "standard_error", "z", "p", "p_adjusted")


def rows_of(sweep: Sweep, outcomes: Sequence[Outcome], judgement: Judgement) -> list[Row]:
    """One row for each point, by name of the column; what a row does not have is empty there.

    Columns that are empty in all rows are left out, except ``reason`` and the swept keys.
    """
    rows = []
    for number, (point, outcome) in enumerate(zip(sweep.points, outcomes, strict=True)):
        row: Row = {"point": number + 1, **point.values}
        if point.repetition is not None:
            row |= {"repetition": point.repetition + 1, "seed": point.seed}
        row |= {"status": outcome.status, "reason": outcome.reason}
        if sweep.kind != "predict":
            row |= {"verdict": judgement.verdicts[number], "p_holm": judgement.p_holm[number]}
        for key, value in outcome.result.items():
            if key not in _LEFT_OUT:
                row |= _columns(key, value)
        if sweep.kind == "network":
            row["bag"] = outcome.result.get("bag")
        row |= {"seconds": outcome.seconds, "software": outcome.software}
        rows.append(row)
    used = {name for row in rows for name, value in row.items() if value is not None} | {"reason", *sweep.keys}
    return [{name: value for name, value in row.items() if name in used} for row in rows]


def _columns(name: str, value: Any) -> Row:
    """Columns of one key of a result: of an estimate, of a law, or of each agent (from 1)."""
    if isinstance(value, list):
        return {
            column: entry
            for place, part in enumerate(value, start=1)
            for column, entry in _columns(f"{name}[{place}]", part).items()
        }
    if not isinstance(value, Mapping):
        return {name: value}
    if "interval" not in value:
        return {
            column: entry for key, part in value.items() for column, entry in _columns(f"{name}.{key}", part).items()
        }
    low, high = value["interval"]
    if "p_holm" in value:  # results of older versions
        value = {**value, "p_adjusted": value["p_holm"]}
    numbers = {key: value[key] for key in _ESTIMATE if value.get(key) is not None}
    return {f"{name}.{key}": entry for key, entry in (numbers | {"low": low, "high": high}).items()}


def column_names(rows: Sequence[Row]) -> list[str]:
    """Of all rows, in the order in which they first appear."""
    return list(dict.fromkeys(name for row in rows for name in row))


def is_number(value: object) -> bool:
    """Whether it is a number; a boolean is not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def arrow_table(rows: Sequence[Row]) -> pa.Table:
    """The table: booleans or numbers where all of a column are, else texts; values that are not text become JSON."""
    import pyarrow as pa

    columns = {}
    for name in column_names(rows):
        values = [row.get(name) for row in rows]
        given = [value for value in values if value is not None]
        if given and all(isinstance(value, bool) for value in given):
            columns[name] = pa.array(values, pa.bool_())
        elif given and all(is_number(value) and isinstance(value, int) for value in given):
            columns[name] = pa.array(values, pa.int64() if max(map(abs, given)) < 2**63 else pa.float64())
        elif given and all(map(is_number, given)):
            columns[name] = pa.array([None if value is None else float(value) for value in values], pa.float64())
        else:
            columns[name] = pa.array([value if value is None else _text(value) for value in values], pa.string())
    return pa.table(columns)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def write_tables(rows: Sequence[Row], document: Mapping[str, Any], directory: Path) -> list[Path]:
    """Write ``results.parquet``, ``results.csv`` and ``results.json``, each whole or not at all."""
    import pyarrow.csv
    import pyarrow.parquet

    table = arrow_table(rows)
    parquet, text = io.BytesIO(), io.BytesIO()
    pyarrow.parquet.write_table(table, parquet)
    pyarrow.csv.write_csv(table, text, pyarrow.csv.WriteOptions(quoting_style="needed"))
    content = {
        "parquet": parquet.getvalue(),
        "csv": text.getvalue(),
        "json": json_text(document, 1).encode() + b"\n",
    }
    return [write_whole(directory / f"results.{name}", data) for name, data in content.items()]
