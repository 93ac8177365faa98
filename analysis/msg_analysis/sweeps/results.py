# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The results of a sweep: on disk, tested together, as a table, and as the series of a figure."""

from __future__ import annotations

import csv
import fcntl
import io
import json
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from msg_analysis.common.files import lock, write_whole
from msg_analysis.common.resources import pyarrow_problem
from msg_analysis.common.text import HALF_WIDTH_95, agent_text, json_text
from msg_analysis.errors import ExitCode, InputError
from msg_analysis.experiment.problems import show
from msg_analysis.experiment.values import is_number
from msg_analysis.inference.statistics import holm
from msg_analysis.sweeps.grid import SweepGrid
from msg_analysis.sweeps.points import DONE, FAILED, Outcome

if TYPE_CHECKING:
    import pyarrow as pa

JOURNAL = "points.jsonl"
_FIELDS = {field.name for field in fields(Outcome)}

Row = dict[str, Any]
_LEFT_OUT = {"agents", "stationary", "failure", "bag", "verdict"}
_ESTIMATE = ("measured", "predicted", "standard_error", "z", "p", "p_adjusted")

_KEYS = {
    "agents": "number of agents",
    "leaders.agents": "leaders",
    "leaders.gain": "gain of the leaders",
    "noise.broadcast": "noise of published values",
    "noise.burst": "messages lost in a row",
    "noise.delay": "delay of messages, in steps",
    "noise.link": "noise of received values",
    "noise.loss": "loss of messages",
    "noise.loss.default": "loss of messages",
    "noise.on_loss": "in place of a lost value",
    "noise.process": "process noise",
    "run.dt": "step length dt",
    "run.duration": "simulated time",
    "run.processes": "number of processes",
    "run.replicas": "number of replicas",
    "run.speed": "speed of real time",
    "switching.initial": "first graph",
    "switching.scale": "factor of the switching rates",
    "switching.transition": "transition matrix",
}
_LAST_PART = {"leaders.reference", "run.pace", "run.delivery", "run.seed", "run.start", "switching.generator"}
_COLUMNS = {
    "node_errors": "error of {}",
    "rate": "decay rate",
    "seconds": "computing time [s]",
    "system_certainty": "system certainty",
    "system_error": "system error",
}
_LAWS = {"continuous": "continuous time", "discrete": "discrete time", "emulated": "with steps", "static": "one graph"}


@dataclass(slots=True)
class ResultStore:
    """The outcomes in a directory; a lock lets one process at a time write there."""

    directory: Path
    outcomes: dict[str, Outcome]  # by id of the job; the last one of each
    damaged: int  # lines that could not be read: their jobs are done again
    _descriptor: int

    @classmethod
    def open(cls, directory: str | Path) -> Self:
        """Read the outcomes in a directory, made if needed. InputError: it cannot be used, or another sweep does."""
        directory = Path(directory)
        path = directory / JOURNAL
        try:
            directory.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            place = error.filename or directory
            raise InputError(f"{place}: {error.strerror}: choose another place with --out") from error
        try:
            lock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, path)
            outcomes, damaged, whole = _read(path)
        except OSError as error:
            os.close(descriptor)
            if not isinstance(error, BlockingIOError):
                raise
            raise InputError(
                f"{path}: another sweep is writing it: wait for its end, or choose another --out"
            ) from error
        # A last line without its end was being written when a sweep was killed: drop it.
        os.truncate(descriptor, whole)
        os.lseek(descriptor, 0, os.SEEK_END)
        return cls(directory, outcomes, damaged, descriptor)

    def add(self, outcomes: Iterable[Outcome]) -> None:
        """Add outcomes: when this returns, they are on the disk."""
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

    def __exit__(self, *_: object) -> None:
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
        except ValueError:
            entry = None
        if isinstance(entry, dict) and set(entry) == _FIELDS:
            outcomes[entry["id"]] = Outcome(**entry)
        else:
            damaged += 1
    return outcomes, damaged, whole


@dataclass(frozen=True, slots=True)
class SweepVerdict:
    """What the runs of a sweep say together; the tuples are in the order of the outcomes."""

    p_adjusted: tuple[float | None, ...]  # p-values, adjusted over all of them (Holm); None where there is none
    verdicts: tuple[str | None, ...]  # "agrees", "disagrees", "late", "unpredicted"; None for predictions and failures
    # "disagrees" if any run does; else "incomplete" if anything failed; else "late" if any run is; else "agrees", or
    # None for predictions. Runs that are all "unpredicted" count as "agrees".
    verdict: str | None

    @property
    def exit_code(self) -> int:
        """0 agrees or only predictions, 1 disagrees, 3 something failed, 4 late."""
        codes = {"disagrees": ExitCode.DISAGREES, "incomplete": ExitCode.INCOMPLETE, "late": ExitCode.LATE}
        return codes.get(self.verdict or "", ExitCode.FINE)


def evaluate_sweep(outcomes: Sequence[Outcome], level: float) -> SweepVerdict:
    """Test all runs together (Holm): the probability of any false "disagrees" is at most ``level``."""
    p_values = {place: outcome.result.get("p") for place, outcome in enumerate(outcomes) if outcome.status == DONE}
    tested = {place: p for place, p in p_values.items() if p is not None}
    adjusted: list[float | None] = [None] * len(outcomes)
    if tested:
        for place, p in zip(tested, holm(np.array([*tested.values()], dtype=float)), strict=True):
            adjusted[place] = float(p)
    verdicts: list[str | None] = []
    for outcome, p in zip(outcomes, adjusted, strict=True):
        late = outcome.result.get("verdict") == "late"
        verdict = "unpredicted" if outcome.result.get("unpredicted") else "late" if late else "agrees"
        verdict = "disagrees" if p is not None and p < level else verdict
        verdicts.append(None if outcome.status == FAILED or "verdict" not in outcome.result else verdict)
    whole = "late" if "late" in verdicts else "agrees" if any(verdicts) else None
    if any(outcome.status == FAILED for outcome in outcomes):
        whole = "incomplete"
    return SweepVerdict(tuple(adjusted), tuple(verdicts), "disagrees" if "disagrees" in verdicts else whole)


def rows_of(sweep: SweepGrid, outcomes: Sequence[Outcome], verdict: SweepVerdict) -> list[Row]:
    """One row for each point, by name of the column; without columns that are empty in all."""
    rows = []
    for number, (point, outcome) in enumerate(zip(sweep.points, outcomes, strict=True)):
        row: Row = {"point": number + 1, **point.values}
        if point.repetition is not None:
            row |= {"repetition": point.repetition + 1, "seed": point.seed}
        row |= {"status": outcome.status, "reason": outcome.reason}
        if sweep.kind != "predict":
            row |= {"verdict": verdict.verdicts[number], "p_adjusted": verdict.p_adjusted[number]}
        for key, value in outcome.result.items():
            if key not in _LEFT_OUT:
                row |= _columns(key, value)
        if sweep.kind == "network":
            row["bag"] = outcome.result.get("bag")
        rows.append(row | {"seconds": outcome.seconds, "software": outcome.software})
    used = {name for row in rows for name, value in row.items() if value is not None} | {"reason", *sweep.keys}
    return [{name: value for name, value in row.items() if name in used} for row in rows]


def _columns(name: str, value: Any) -> Row:
    """Columns of one key of a result: of an estimate, of a law, or of each agent (from 1)."""
    if isinstance(value, Mapping) and "interval" in value:
        low, high = value["interval"]
        numbers = {key: value[key] for key in _ESTIMATE if value.get(key) is not None}
        return {f"{name}.{key}": entry for key, entry in (numbers | {"low": low, "high": high}).items()}
    if isinstance(value, list):
        parts = {f"{name}[{place}]": part for place, part in enumerate(value, start=1)}
    elif isinstance(value, Mapping):
        parts = {f"{name}.{key}": part for key, part in value.items()}
    else:
        return {name: value}
    return {column: entry for key, part in parts.items() for column, entry in _columns(key, part).items()}


def column_names(rows: Sequence[Row]) -> list[str]:
    """Of all rows, in the order in which they first appear."""
    return list(dict.fromkeys(name for row in rows for name in row))


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
            texts = [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
            columns[name] = pa.array(texts, pa.string())
    return pa.table(columns)


def write_tables(rows: Sequence[Row], document: Mapping[str, Any], directory: Path) -> list[Path]:
    """Write ``results.csv``, ``results.json`` and, where pyarrow can be loaded, ``results.parquet``, each whole."""
    content = {"json": json_text(document, 1).encode() + b"\n"}
    if pyarrow_problem():
        text = io.StringIO()
        writer = csv.DictWriter(text, column_names(rows), lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _cell(value) for key, value in row.items()} for row in rows)
        content = {"csv": text.getvalue().encode()} | content
    else:
        import pyarrow.csv
        import pyarrow.parquet

        table = arrow_table(rows)
        parquet, data = io.BytesIO(), io.BytesIO()
        pyarrow.parquet.write_table(table, parquet)
        pyarrow.csv.write_csv(table, data, pyarrow.csv.WriteOptions(quoting_style="needed"))
        content = {"parquet": parquet.getvalue(), "csv": data.getvalue()} | content
    return [write_whole(directory / f"results.{name}", data) for name, data in content.items()]


def _cell(value: Any) -> Any:
    """A value in CSV as pyarrow writes it."""
    return json.dumps(value) if isinstance(value, bool | list | dict) else value


@dataclass(frozen=True, slots=True)
class PlotPoint:
    """The rows of one combination of values, repetitions taken together."""

    x: Any  # value of the key along the axis
    value: float | None  # mean over the repetitions
    low: float | None  # 95 % interval of a measured value
    high: float | None
    predicted: float | None  # mean of the exact expectations of what is measured
    reference: float | None  # of a predicted value: the same in continuous time
    reason: str | None = None  # why there is no value


@dataclass(frozen=True, slots=True)
class Series:
    """Places along the axis."""

    values: tuple[tuple[str, Any], ...]  # of the other keys that have several
    places: tuple[PlotPoint, ...]  # in the order of the axis

    @property
    def label(self) -> str:
        """Keys and values; empty where there are none."""
        return ", ".join(f"{key} = {value_text(value)}" for key, value in self.values)


@dataclass(frozen=True, slots=True)
class Picture:
    """What a figure shows: one column of the table over a swept key, for each value of the other keys."""

    x: str  # the key along the axis
    y: str  # the column
    logarithmic: bool  # the axis of x
    measured: bool  # whether it is of runs, which have intervals
    series: tuple[Series, ...]  # one for each combination of values of the other keys
    names: Sequence[str] | None = None  # of the agents, if all points have the same

    @property
    def intervals(self) -> bool:
        """Whether some value has one: a run, or a prediction that is sampled."""
        return any(place.low is not None for place in self.places)

    def words(self, values: Iterable[tuple[str, Any]]) -> str:
        """Keys in words, with their values; empty where there are none."""
        return ", ".join(f"{key_words(key, self.names)} = {value_text(value)}" for key, value in values)

    @property
    def places(self) -> list[PlotPoint]:
        """Those of all series."""
        return [place for series in self.series for place in series.places]

    @property
    def labels(self) -> list[str]:
        """The values along the axis, as texts."""
        return list(dict.fromkeys(show(place.x) for place in self.places))

    @property
    def numeric(self) -> bool:
        """Whether all values along the axis are numbers."""
        return all(is_number(place.x) for place in self.places)


def several_values(sweep: SweepGrid) -> list[str]:
    """The keys with several values, in the order of the file."""
    return [key for key, values in sweep.spec.over.items() if len(values) > 1]


def picture(sweep: SweepGrid, rows: Sequence[Row], column: str | None = None, along: str | None = None) -> Picture:
    """What to draw of ``rows_of``: a column over the key ``along``. InputError: it is not a column of numbers."""
    wanted = column or "system_error"  # stands for what is measured or predicted of it
    names = _drawn_columns(rows, wanted)
    if not names["value"]:
        if column is not None:
            short = {name.removesuffix(".measured") for name in _numeric(rows)}
            offer = sorted(name for name in short if "[" not in name or "[1]" in name)  # of agents, the first one
            raise InputError(f"--column {wanted}: not a column of numbers: expected one of {', '.join(offer)}")
        names["value"] = wanted  # nothing but failures
    several = several_values(sweep)
    along = along or next(iter(several), sweep.keys[0])
    others = [key for key in several if key != along] if sweep.spec.combine == "grid" else []
    groups: dict[tuple[str, ...], dict[str, list[Row]]] = {}
    values: dict[tuple[str, ...], tuple[tuple[str, Any], ...]] = {}
    for row in rows:
        group = tuple(show(row[key]) for key in others)
        values.setdefault(group, tuple((key, row[key]) for key in others))
        groups.setdefault(group, {}).setdefault(show(row[along]), []).append(row)
    found = tuple(
        Series(values[group], tuple(_place(along, rows_here, names) for rows_here in places.values()))
        for group, places in groups.items()
    )
    measured = sweep.kind != "predict" and names["error"] is not None
    return Picture(along, wanted, _logarithmic(sweep, along), measured, found, sweep.names)


def _drawn_columns(rows: Sequence[Row], wanted: str) -> dict[str, str | None]:
    """Names of the columns of a value, its standard error, its expectation and its reference; None: not there."""
    numeric = _numeric(rows)
    for value, error, predicted, reference in (
        (f"{wanted}.measured", f"{wanted}.standard_error", f"{wanted}.predicted", None),
        (f"emulated.{wanted}", f"emulated.{wanted}.standard_error", None, f"continuous.{wanted}"),
        (f"discrete.{wanted}", f"discrete.{wanted}.standard_error", None, None),
        (wanted, None, None, None),
    ):
        if value in numeric:
            names = {"value": value, "error": error, "predicted": predicted, "reference": reference}
            return {key: name if name in numeric else None for key, name in names.items()}
    return dict.fromkeys(("value", "error", "predicted", "reference"))


def _numeric(rows: Sequence[Row]) -> set[str]:
    """The columns of numbers."""
    given = {name: [row[name] for row in rows if row.get(name) is not None] for name in column_names(rows)}
    return {name for name, values in given.items() if values and all(map(is_number, values))}


def _place(along: str, rows: Sequence[Row], names: Mapping[str, str | None]) -> PlotPoint:
    """The mean of repetitions, and the 95 % interval of the mean."""
    numbers = {
        key: [float(row[name]) for row in rows if row.get(name) is not None] if name else []
        for key, name in names.items()
    }
    value, predicted, reference = (
        math.fsum(found) / len(found) if (found := numbers[key]) else None
        for key in ("value", "predicted", "reference")
    )
    errors = numbers["error"]
    half = HALF_WIDTH_95 * math.hypot(*errors) / len(errors) if errors else None
    known = value is not None and half is not None
    low, high = (value - half, value + half) if known else (None, None)  # type: ignore[operator]
    reason = next((row["reason"] for row in rows if row.get("reason")), None) if value is None else None
    return PlotPoint(rows[0][along], value, low, high, predicted, reference, reason)


def _logarithmic(sweep: SweepGrid, along: str) -> bool:
    """As the file says; else whether all values are numbers > 0 that span a factor of 50 or more."""
    axis = sweep.spec.over[along]
    if axis.logarithmic is not None:
        return axis.logarithmic
    numbers = list(filter(is_number, axis))
    return len(numbers) == len(axis) and min(numbers) > 0 and max(numbers) / min(numbers) >= 50


def value_text(value: Any) -> str:
    """A value of a key for a table or a label: numbers with six digits."""
    return f"{value:.6g}" if isinstance(value, float) else show(value)


def key_words(key: str, names: Sequence[str] | None = None) -> str:
    """A key in words, such as "step length dt"; the key itself if it has none. ``names``: of the agents."""
    if key in _KEYS or key in _LAST_PART:
        return _KEYS.get(key, key.rpartition(".")[2])
    if found := re.fullmatch(r"noise\.process\[(\d+)\]", key):
        return f"process noise of {agent_text(int(found[1]), names)}"
    if found := re.fullmatch(r"switching\.rates\.([^.]+)\.([^.]+)", key):
        return f"switching rate from {found[1]} to {found[2]}"
    return key


def axis_name(key: str, names: Sequence[str] | None = None) -> str:
    """A key in words, with the key in brackets, such as "step length dt [run.dt]"."""
    words = key_words(key, names)
    return words if words == key else f"{words} [{key}]"


def column_words(column: str, names: Sequence[str] | None = None) -> str:
    """A column in words, such as "error of agent 3"; the column itself if it has none."""
    law, _, rest = column.partition(".")
    if law in _LAWS and rest:
        return f"{column_words(rest, names)}, {_LAWS[law]}"
    found = re.fullmatch(r"(\w+?)(?:\[(\d+)\])?", column)
    words = _COLUMNS.get(found[1]) if found else None
    if found is None or words is None or ("{}" in words) != (found[2] is not None):
        return column
    return words.format(agent_text(int(found[2]), names)) if found[2] else words
