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

"""Files of a run for other programs: CSV, Parquet, numpy, Rerun; each written whole or not at all, piece by piece."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from msg_analysis.common.files import require_place, written_whole
from msg_analysis.common.large_arrays import BLOCK_NUMBERS, pieces, release
from msg_analysis.common.long_work import tell
from msg_analysis.errors import InputError
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.report.export.rerun_file import require_rerun, write_recording
from msg_analysis.report.export.run_tables import RunTable, run_tables, square_errors
from msg_analysis.types import AnyArray

Form = Literal["csv", "parquet", "npz", "rrd"]
FORMS: tuple[Form, ...] = get_args(Form)
ARRAY_FILE, RECORDING_FILE = "run.npz", "run.rrd"
_OLDEST = (1980, 1, 1, 0, 0, 0)  # of files in an archive: the same run gives the same bytes


def export_run(trajectory: Trajectory, directory: Path, forms: Sequence[Form]) -> list[Path]:
    """Write the files of these forms into a directory, made if need be; files of the same names are replaced.

    InputError: a file cannot be written; NotAvailableError: the library for it is not installed.
    """
    writers = {
        directory / f"{table.name}.{form}": _table_writer(table, form)
        for form in forms
        if form in ("csv", "parquet")
        for table in run_tables(trajectory)
    }
    if "npz" in forms:
        writers[directory / ARRAY_FILE] = lambda file, shown: _write_arrays(trajectory, file, shown)
    if "rrd" in forms:
        require_rerun()
        writers[directory / RECORDING_FILE] = lambda file, shown: write_recording(trajectory, file, shown)
    with _readable(directory):
        directory.mkdir(parents=True, exist_ok=True)
    for path in writers:
        require_place(path)
    for path, write in writers.items():
        with _readable(path), written_whole(path) as temporary:
            write(temporary, path.name)
    return list(writers)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Errors of the system as one of bad input that names the path."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be written ({reason}): choose another place with --out") from error


def _table_writer(table: RunTable, form: Form) -> Callable[[Path, str], None]:
    def write(file: Path, shown: str) -> None:
        import pyarrow.csv
        import pyarrow.parquet

        if form == "csv":
            options = pyarrow.csv.WriteOptions(quoting_style="needed")
            writer: Any = pyarrow.csv.CSVWriter(file, table.schema, write_options=options)
        else:
            writer = pyarrow.parquet.ParquetWriter(file, table.schema, compression="zstd")
        with writer:
            for rows, done in table.pieces():
                tell(f"writing {shown}", done, table.steps)
                writer.write_batch(rows)

    return write


def _write_arrays(trajectory: Trajectory, file: Path, shown: str) -> None:
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
            length = max(1, BLOCK_NUMBERS // max(1, trajectory.states[:1].size))
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
