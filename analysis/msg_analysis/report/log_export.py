# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""A log of any origin as files for other programs, by its map: columns are called as those of a run."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.bags.first_map import count_agents
from msg_analysis.bags.log_map import LogMap
from msg_analysis.bags.mapped_log import aligned, read_contents
from msg_analysis.common.arrays import AnyArray, FloatArray
from msg_analysis.common.files import require_place, written_whole
from msg_analysis.common.resources import require_pyarrow
from msg_analysis.report.export import Form, readable


@dataclass(frozen=True, slots=True, eq=False)
class MappedLog:
    """What a log has, without a law."""

    times: FloatArray  # (N,) [units of simulated time] after the first sample
    states: FloatArray  # (N, m, R); NaN: not measured
    starts: FloatArray  # (p,) from when on the log names a graph
    graphs: list[str]  # (p,)
    notes: list[str]

    @classmethod
    def read(cls, path: Path, mapped: LogMap) -> MappedLog:
        """InputError: the map does not fit."""
        contents = read_contents(path, mapped, mapped.sources(count_agents(path, mapped)))
        notes = list(contents.notes)
        every, states = aligned(contents, mapped, notes)
        unit = SECOND * mapped.units.time
        starts, graphs = np.empty(0), []
        if contents.graph:
            since, told = contents.graph.joined()
            order = np.argsort(since, kind="stable")
            starts, graphs = (since[order] - every[0]) / unit, [str(each) for each in told[order].tolist()]
        return cls((every - every[0]) / unit, states, starts, graphs, notes)

    @property
    def missing(self) -> int:
        """Number of values of agents that are not there at a time at which another one is."""
        return int(np.isnan(self.states).any(axis=2).sum())

    def tables(self) -> dict[str, dict[str, AnyArray]]:
        """``states``, a row for each value, and ``graphs``."""
        k, agent, replica = np.nonzero(~np.isnan(self.states))
        columns = {"time": self.times[k], "agent": agent + 1, "replica": replica + 1}
        tables: dict[str, dict[str, AnyArray]] = {"states": columns | {"state": self.states[k, agent, replica]}}
        if self.graphs:
            tables["graphs"] = {"time": self.starts, "graph_name": np.array(self.graphs, dtype=object)}
        return tables


def export_log(log: MappedLog, directory: Path, forms: Sequence[Form]) -> list[Path]:
    """Write the files into a directory; errors as of ``export_run``."""
    if "parquet" in forms:
        require_pyarrow("Parquet")
    with readable(directory):
        directory.mkdir(parents=True, exist_ok=True)
    path = np.array(log.graphs, dtype=str)
    whole = {"log": {"times": log.times, "states": log.states, "starts": log.starts, "path": path}}
    contents = {
        directory / f"{name}.{form}": (form, columns)
        for form in forms
        for name, columns in (whole if form == "npz" else log.tables()).items()
    }
    for file in contents:
        require_place(file)
    for file, (form, columns) in contents.items():
        with readable(file), written_whole(file) as temporary:
            _write(temporary, form, columns)
    return list(contents)


def _write(file: Path, form: Form, columns: Mapping[str, Any]) -> None:
    if form == "npz":
        with file.open("wb") as stream:
            np.savez(stream, **columns)
    elif form == "csv":
        with file.open("w", newline="", encoding="utf-8") as text:
            writer = csv.writer(text, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
    else:
        import pyarrow as pa
        import pyarrow.parquet

        arrays = {
            name: pa.array(column.tolist() if column.dtype == object else column) for name, column in columns.items()
        }
        pyarrow.parquet.write_table(pa.table(arrays), file, compression="zstd")
