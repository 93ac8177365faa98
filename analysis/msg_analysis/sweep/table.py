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

"""The results of a sweep as a table: Parquet, CSV and JSON, for other tools."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msg_analysis.common.files import write_whole
from msg_analysis.common.text.json_numbers import json_text
from msg_analysis.sweep.conduct import Judgement
from msg_analysis.sweep.jobs.job import Outcome
from msg_analysis.sweep.plan import Sweep

if TYPE_CHECKING:
    import pyarrow as pa

Row = dict[str, Any]
_LEFT_OUT = {"agents", "stationary", "failure", "bag", "verdict"}
_ESTIMATE = ("measured", "predicted", "standard_error", "z", "p", "p_holm")


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
