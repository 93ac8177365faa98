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

"""The tables of a run: states, graphs and errors, in pieces, so that a run may be longer than the memory.

Agents, graphs and replicas count from 1, as in all files. What is missing is null.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from msg_analysis.common.large_arrays import release
from msg_analysis.model.arithmetic.step_clock import SECOND
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.types import AnyArray, BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    import pyarrow as pa

ROWS = 2**17  # of a piece, or those of one step


@dataclass(frozen=True, slots=True)
class RunTable:
    """One table: its name, its columns, and how many steps it has; ``pieces`` makes its rows."""

    name: str
    trajectory: Trajectory
    schema: pa.Schema
    steps: int

    def pieces(self) -> Iterator[tuple[pa.RecordBatch, int]]:
        """The rows, step after step, and the step behind the last one of each piece."""
        import pyarrow as pa

        rows = {"states": _states, "graphs": _graphs, "errors": _errors}[self.name]
        trajectory = self.trajectory
        wide = trajectory.values[:1].size if self.name == "states" else trajectory.states[:1].size
        length = max(1, ROWS // max(wide, 1))
        for first in range(0, self.steps, length):
            end = min(first + length, self.steps)
            columns = rows(trajectory, first, end)
            arrays = [_arrow(columns[field.name], field.type) for field in self.schema]
            yield pa.RecordBatch.from_arrays(arrays, schema=self.schema), end
            for array in (trajectory.states, trajectory.published, trajectory.made):
                if array is not None:
                    release(array)


def run_tables(trajectory: Trajectory) -> list[RunTable]:
    """Tables ``states`` (a row per state and replica), ``graphs`` (per step k -> k+1) and ``errors`` (per x(k)).

    All columns are described in docs/commands.md.
    """
    import pyarrow as pa

    experiment = trajectory.record.experiment
    name = [("name", pa.string())] if experiment.names else []
    numbers = ["state", *(f"state_{row}" for row in range(2, experiment.width // experiment.run.replicas + 1))]
    others = [*(["published"] if trajectory.published is not None else []), *(["made"] if _timed(trajectory) else [])]
    columns = {
        "states": [
            *(("step", pa.int64()), ("time", pa.float64()), ("agent", pa.int32()), *name, ("replica", pa.int32())),
            *((number, pa.float64()) for number in [*numbers, *others]),
        ],
        "graphs": [("step", pa.int64()), ("time", pa.float64()), ("graph", pa.int32()), ("graph_name", pa.string())],
        "errors": [
            *(("step", pa.int64()), ("time", pa.float64()), ("system_error", pa.float64())),
            *((f"error_{agent}", pa.float64()) for agent in range(1, experiment.agents + 1)),
        ],
    }
    about = {b"msg_analysis.run_record": trajectory.record.to_json().encode()}
    lengths = {"states": len(trajectory.states), "graphs": len(trajectory.modes), "errors": len(trajectory.states)}
    return [
        RunTable(table, trajectory, pa.schema(fields, metadata=about), lengths[table])
        for table, fields in columns.items()
    ]


def _timed(trajectory: Trajectory) -> bool:
    return trajectory.made is not None and trajectory.record.experiment.run.pace == "realtime"


def _states(trajectory: Trajectory, first: int, end: int) -> dict[str, Any]:
    experiment = trajectory.record.experiment
    agents, replicas = experiment.agents, experiment.run.replicas
    states = trajectory.states[first:end]
    step = np.repeat(np.arange(first, end), agents * replicas)
    agent = np.tile(np.repeat(np.arange(agents), replicas), end - first)
    columns: dict[str, Any] = {
        "step": step,
        "time": step * experiment.step_length,
        "agent": agent + 1,
        "replica": np.tile(np.arange(1, replicas + 1), (end - first) * agents),
    }
    if experiment.names:
        columns["name"] = _Names(experiment.names, agent)
    for row in range(states.shape[2] // replicas):
        columns[f"state_{row + 1}" if row else "state"] = states[:, :, row * replicas : (row + 1) * replicas].ravel()
    if trajectory.published is not None:
        columns["published"] = trajectory.published[first:end].ravel()
    if trajectory.made is not None:
        made = trajectory.made[first:end].ravel()
        columns["made"] = np.repeat(np.where(made < 0, np.nan, made / SECOND), replicas)
    return columns


def _graphs(trajectory: Trajectory, first: int, end: int) -> dict[str, Any]:
    experiment = trajectory.record.experiment
    modes, step = trajectory.modes[first:end], np.arange(first, end)
    names = _Names([graph.name for graph in experiment.graph_list], modes)
    graph = np.ma.masked_less(modes + 1, 1)
    return {"step": step, "time": step * experiment.step_length, "graph": graph, "graph_name": names}


def _errors(trajectory: Trajectory, first: int, end: int) -> dict[str, Any]:
    step = np.arange(first, end)
    errors = square_errors(trajectory, first, end)
    columns: dict[str, Any] = {"step": step, "time": step * trajectory.record.experiment.step_length}
    columns["system_error"] = errors.sum(axis=1)
    return columns | {f"error_{agent + 1}": errors[:, agent] for agent in range(errors.shape[1])}


def square_errors(trajectory: Trajectory, first: int, end: int) -> FloatArray:
    """(end - first, m) mean over the replicas of the squares by which states are off the mean or the reference.

    NaN where a state that is needed for it is missing. Their means over time are the measured errors of a comparison.
    """
    experiment = trajectory.record.experiment
    values = trajectory.values[first:end]
    middle = values.mean(axis=1, keepdims=True) if experiment.problem == "consensus" else experiment.reference
    return np.asarray(np.square(values - middle).mean(axis=2))


class _Names:
    """A column of texts: ``texts[places]``; null where a place is -1."""

    def __init__(self, texts: Sequence[str], places: IntArray) -> None:
        self.texts, self.places = texts, places

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
