# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Runs as tables, data frames and files for other programs, in pieces: a run may be longer than the memory.

Agents, graphs and replicas count from 1, as in all files. What is missing is null.
"""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.common.arrays import BLOCK_NUMBERS, AnyArray, BoolArray, FloatArray, IntArray, pieces, release
from msg_analysis.common.files import require_place, written_whole
from msg_analysis.common.resources import pyarrow_problem, require_pyarrow, tell
from msg_analysis.common.text import agent_name
from msg_analysis.errors import InputError, NotAvailableError
from msg_analysis.inference.observation import deviations
from msg_analysis.model.run import Run

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


ROWS = 2**17  # of a piece, or those of one step


@dataclass(frozen=True, slots=True)
class RunTable:
    """One table of a run, in pieces."""

    name: str
    trajectory: Run

    @property
    def schema(self) -> pa.Schema:
        """Of Arrow, with the run record."""
        import pyarrow as pa

        kinds = {"step": pa.int64(), "agent": pa.int32(), "replica": pa.int32(), "graph": pa.int32()}
        kinds |= {"name": pa.string(), "graph_name": pa.string()}
        names = _COLUMNS[self.name](self.trajectory, 0, 0)
        about = {b"msg_analysis.run_record": self.trajectory.record.to_json().encode()}
        return pa.schema([(name, kinds.get(name, pa.float64())) for name in names], metadata=about)

    @property
    def steps(self) -> int:
        """How many it has: a graph belongs to a step k -> k+1, the others to a state x(k)."""
        return len(self.trajectory.modes if self.name == "graphs" else self.trajectory.states)

    def pieces(self, rows: int = ROWS) -> Iterator[tuple[pa.RecordBatch, int]]:
        """The rows, step after step, and the step behind the last one of each piece."""
        import pyarrow as pa

        schema = self.schema
        for columns, end in self.columns(rows):
            arrays = [_arrow(columns[field.name], field.type) for field in schema]
            yield pa.RecordBatch.from_arrays(arrays, schema=schema), end

    def columns(self, rows: int = ROWS) -> Iterator[tuple[dict[str, Any], int]]:
        """The same as arrays of numpy; missing is masked or NaN."""
        trajectory = self.trajectory
        wide = trajectory.values[:1].size if self.name == "states" else trajectory.states[:1].size
        length = max(1, rows // max(wide, 1))
        for first in range(0, self.steps, length):
            end = min(first + length, self.steps)
            yield _COLUMNS[self.name](trajectory, first, end), end
            for array in (trajectory.states, trajectory.published, trajectory.made):
                if array is not None:
                    release(array)


def run_tables(trajectory: Run) -> list[RunTable]:
    """``states`` (a row per state and replica), ``graphs`` and ``errors``; their columns are in docs/commands.md."""
    return [RunTable(table, trajectory) for table in _COLUMNS]


def _states(trajectory: Run, first: int, end: int) -> dict[str, Any]:
    experiment = trajectory.record.experiment
    agents, replicas = experiment.agents, experiment.run.replicas
    states = trajectory.states[first:end]
    step = np.repeat(np.arange(first, end), agents * replicas)
    agent = np.tile(np.repeat(np.arange(agents), replicas), end - first)
    columns: dict[str, Any] = {"step": step, "time": step * experiment.step_length, "agent": agent + 1}
    if experiment.names:
        columns["name"] = _Names(experiment.names, agent)
    columns["replica"] = np.tile(np.arange(1, replicas + 1), (end - first) * agents)
    for row in range(states.shape[2] // replicas):
        columns[f"state_{row + 1}" if row else "state"] = states[:, :, row * replicas : (row + 1) * replicas].ravel()
    if trajectory.published is not None:
        columns["published"] = trajectory.published[first:end].ravel()
    if trajectory.made is not None and experiment.run.pace == "realtime":
        made = trajectory.made[first:end].ravel()
        columns["made"] = np.repeat(np.where(made < 0, np.nan, made / SECOND), replicas)
    return columns


def _graphs(trajectory: Run, first: int, end: int) -> dict[str, Any]:
    experiment = trajectory.record.experiment
    modes, step = trajectory.modes[first:end], np.arange(first, end)
    names = _Names([graph.name for graph in experiment.graph_list], modes)
    graph = np.ma.masked_less(modes + 1, 1)
    return {"step": step, "time": step * experiment.step_length, "graph": graph, "graph_name": names}


def _errors(trajectory: Run, first: int, end: int) -> dict[str, Any]:
    step, errors = np.arange(first, end), square_errors(trajectory, first, end)
    columns = {
        "step": step,
        "time": step * trajectory.record.experiment.step_length,
        "system_error": errors.sum(axis=1),
    }
    return columns | {f"error_{agent + 1}": errors[:, agent] for agent in range(errors.shape[1])}


_COLUMNS: dict[str, Callable[[Run, int, int], dict[str, Any]]] = {
    "states": _states,  # of the steps from one to another
    "graphs": _graphs,
    "errors": _errors,
}


def square_errors(trajectory: Run, first: int, end: int) -> FloatArray:
    """(end - first, m) mean square over the replicas of the distances from the mean or the reference; NaN: unknown."""
    return np.asarray(np.square(deviations(trajectory.values[first:end], trajectory.record.experiment)).mean(axis=2))


class _Names:
    """A column of texts: ``texts[places]``; null where a place is -1."""

    def __init__(self, texts: Sequence[str], places: IntArray) -> None:
        self.texts, self.places = texts, places

    def tolist(self) -> list[str | None]:
        return [self.texts[place] if place >= 0 else None for place in self.places.tolist()]

    def arrow(self) -> pa.Array:
        import pyarrow as pa

        encoded = [*(text.encode() for text in self.texts), b""]
        ends = np.cumsum(np.array([len(text) for text in encoded])[self.places])
        offsets = np.concatenate(([0], ends)).astype(np.int32)
        content = b"".join([encoded[place] for place in self.places.tolist()])
        known = _known(self.places >= 0)
        return pa.StringArray.from_buffers(len(self.places), pa.py_buffer(offsets), pa.py_buffer(content), known)


def _arrow(values: AnyArray | _Names, kind: pa.DataType) -> pa.Array:
    """Without ``pyarrow.array``, which imports pandas, if it is installed: that takes longer than most exports."""
    import pyarrow as pa

    if isinstance(values, _Names):
        return values.arrow()
    plain = np.ascontiguousarray(np.ma.getdata(values), dtype=kind.to_pandas_dtype())
    missing = np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else np.isnan(plain)
    return pa.Array.from_buffers(kind, len(plain), [_known(~missing), pa.py_buffer(plain)])


def _known(known: BoolArray) -> pa.Buffer | None:
    """Arrow's bitmap of what is not null; None where all is known."""
    import pyarrow as pa

    return None if known.all() else pa.py_buffer(np.packbits(known, bitorder="little"))


Table = Literal["states", "graphs", "errors"]


def require_pandas() -> None:
    """NotAvailableError where pandas, which pyarrow needs for data frames, is not installed."""
    try:
        import pandas  # noqa: F401
    except ImportError:
        raise NotAvailableError(
            "to_dataframe: pandas is not installed: expected it for data frames: pip install pandas"
        ) from None


def data_frame(trajectory: Run, table: Table) -> pd.DataFrame:
    """One of the tables of a run. InputError: no such table; NotAvailableError: pandas is not installed."""
    import pyarrow as pa

    require_pandas()
    require_pyarrow("to_dataframe")
    found = {each.name: each for each in run_tables(trajectory)}
    if table not in found:
        raise InputError(f"to_dataframe: {table!r}: expected one of {', '.join(found)}")
    chosen = found[table]
    frame: pd.DataFrame = pa.Table.from_batches((rows for rows, _ in chosen.pieces()), chosen.schema).to_pandas()
    return frame


def require_rerun() -> Any:
    """The library. NotAvailableError: it is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise NotAvailableError(
            "--rrd: rerun-sdk is not installed: expected it for recordings of Rerun: pip install rerun-sdk"
        ) from error
    return rerun


def write_recording(trajectory: Run, file: Path, shown: str) -> None:
    """States, errors and graphs over the timelines ``step`` and ``time``; what is missing is left out."""
    rerun, experiment = require_rerun(), trajectory.record.experiment
    recording = rerun.RecordingStream(f"msg_analysis_{experiment.name}", recording_id=str(trajectory.record.run))
    recording.save(file)
    names = [agent_name(agent, experiment.names) for agent in range(1, experiment.agents + 1)]
    length = max(1, BLOCK_NUMBERS // max(1, trajectory.states[:1].size))
    for first in range(0, len(trajectory.states), length):
        end = min(first + length, len(trajectory.states))
        tell(f"writing {shown}", end, len(trajectory.states))
        values, errors = trajectory.values[first:end], square_errors(trajectory, first, end)
        send = partial(_send, rerun, recording, experiment.step_length, first)
        for agent, name in enumerate(names):
            send(("states", name), values[:, agent])
            send(("errors", name), errors[:, agent, None])
        send(("system_error",), errors.sum(axis=1)[:, None])
        release(trajectory.states)
    _send_graphs(rerun, recording, trajectory, names)
    recording.flush()
    recording.disconnect()


def _send(rerun: Any, recording: Any, dt: float, first: int, path: tuple[str, ...], values: Any) -> None:
    """Numbers (steps, k) of the steps from ``first`` on, those without gaps."""
    there = ~np.isnan(values).any(axis=1)
    steps, values = first + np.flatnonzero(there), values[there]
    if len(steps):
        index = [rerun.TimeColumn("step", sequence=steps), rerun.TimeColumn("time", duration=steps * dt)]
        columns = rerun.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(steps))
        recording.send_columns(rerun.new_entity_path(path), indexes=index, columns=[*columns])


def _send_graphs(rerun: Any, recording: Any, trajectory: Run, names: list[str]) -> None:
    """The number of the graph, and its links, whenever it changes."""
    experiment, modes = trajectory.record.experiment, trajectory.modes
    recording.log("network", rerun.GraphNodes(node_ids=names, labels=names), static=True)
    links = [
        rerun.GraphEdges(
            edges=[(names[a - 1], names[b - 1]) for a, b, _ in (graph.edges if graph.symmetric else graph.arcs)],
            graph_type="undirected" if graph.symmetric else "directed",
        )
        for graph in experiment.graph_list
    ]
    for step in np.flatnonzero(np.diff(modes, prepend=-2)).tolist():
        if modes[step] >= 0:
            recording.set_time("step", sequence=step)
            recording.set_time("time", duration=step * experiment.step_length)
            recording.log("graph", rerun.Scalars(float(modes[step] + 1)))
            recording.log("network", links[modes[step]])


Form = Literal["csv", "parquet", "npz", "rrd"]
FORMS: tuple[Form, ...] = get_args(Form)
_OLDEST = (1980, 1, 1, 0, 0, 0)  # of files in an archive: the same run gives the same bytes


def export_run(trajectory: Run, directory: Path, forms: Sequence[Form], rows: int = ROWS) -> list[Path]:
    """Write the files into a directory. InputError: one cannot be written; NotAvailableError: no library for it."""
    writers = {
        directory / f"{table.name}.{form}": _table_writer(table, form, rows)
        for form in forms
        if form in ("csv", "parquet")
        for table in run_tables(trajectory)
    }
    if "npz" in forms:
        writers[directory / "run.npz"] = lambda file, shown: _write_arrays(trajectory, file, shown, rows)
    if "parquet" in forms:
        require_pyarrow("Parquet")
    if "rrd" in forms:
        require_rerun()
        writers[directory / "run.rrd"] = lambda file, shown: write_recording(trajectory, file, shown)
    with readable(directory):
        directory.mkdir(parents=True, exist_ok=True)
    for path in writers:
        require_place(path)
    for path, write in writers.items():
        with readable(path), written_whole(path) as temporary:
            write(temporary, path.name)
    return list(writers)


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Errors of the system as one of bad input that names the path."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be written ({reason}): choose another place with --out") from error


def _table_writer(table: RunTable, form: Form, rows: int) -> Callable[[Path, str], None]:
    def write_text(file: Path, shown: str) -> None:
        with file.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(_COLUMNS[table.name](table.trajectory, 0, 0))
            for columns, done in table.columns(rows):
                tell(f"writing {shown}", done, table.steps)
                # Of what is missing, masked or NaN, nothing is written.
                cells = [[None if cell != cell else cell for cell in column.tolist()] for column in columns.values()]
                writer.writerows(zip(*cells, strict=True))

    def write(file: Path, shown: str) -> None:
        import pyarrow.csv
        import pyarrow.parquet

        if form == "csv":
            options = pyarrow.csv.WriteOptions(quoting_style="needed")
            writer: Any = pyarrow.csv.CSVWriter(file, table.schema, write_options=options)
        else:
            writer = pyarrow.parquet.ParquetWriter(file, table.schema, compression="zstd")
        with writer:
            for piece, done in table.pieces(rows):
                tell(f"writing {shown}", done, table.steps)
                writer.write_batch(piece)

    return write_text if form == "csv" and pyarrow_problem() else write  # pyarrow is much faster


def _write_arrays(trajectory: Run, file: Path, shown: str, rows: int) -> None:
    """What ``numpy.savez`` writes, but in pieces; agents and graphs count from 0, as in Python."""
    experiment = trajectory.record.experiment
    small = {
        "times": np.arange(len(trajectory.states)) * experiment.step_length,
        "adjacency": np.stack([graph.adjacency for graph in experiment.graph_list]),
        "graph_names": np.array([graph.name for graph in experiment.graph_list]),
        "names": np.array(experiment.names or []),
        "run_record": np.array(trajectory.record.to_json()),
    }
    large = {
        key: array
        for key in ("states", "modes", "agent_modes", "published", "lost", "used", "made")
        if (array := getattr(trajectory, key)) is not None
    }
    with zipfile.ZipFile(file, "w", allowZip64=True) as archive:
        for key, array in (small | large).items():
            tell(f"writing {shown}: {key}", 0, 1)
            with _entry(archive, key, array.shape, array.dtype) as write:
                for piece in pieces(array) if array.ndim else [...]:
                    write(array[piece])
        shape = trajectory.states.shape[:2]
        with _entry(archive, "errors", shape, np.dtype(np.float64)) as write:
            length = max(1, rows // max(1, trajectory.states[:1].size))
            for first in range(0, shape[0], length):
                write(square_errors(trajectory, first, min(first + length, shape[0])))
                release(trajectory.states)


@contextmanager
def _entry(
    archive: zipfile.ZipFile, key: str, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> Iterator[Callable[[AnyArray], None]]:
    """An array of an archive, of which the pieces are written."""
    with archive.open(zipfile.ZipInfo(f"{key}.npy", _OLDEST), "w", force_zip64=True) as stream:
        head = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_2_0(stream, head)
        yield lambda piece: (stream.write(np.ascontiguousarray(piece).tobytes()), None)[1]
