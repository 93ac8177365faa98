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

"""Runs as data frames of pandas, which need not be installed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from msg_analysis.errors import InputError, NotAvailableError
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.report.export.run_tables import run_tables

if TYPE_CHECKING:
    import pandas as pd

Table = Literal["states", "graphs", "errors"]


def data_frame(trajectory: Trajectory, table: Table) -> pd.DataFrame:
    """One of the tables of a run. InputError: no such table; NotAvailableError: pandas is not installed."""
    import pyarrow as pa

    try:
        import pandas  # noqa: F401  pyarrow needs it below
    except ImportError as error:
        raise NotAvailableError(
            "to_dataframe: pandas is not installed: expected it for data frames: pip install pandas"
        ) from error
    found = {each.name: each for each in run_tables(trajectory)}
    if table not in found:
        raise InputError(f"to_dataframe: {table!r}: expected one of {', '.join(found)}")
    chosen = found[table]
    frame: pd.DataFrame = pa.Table.from_batches((rows for rows, _ in chosen.pieces()), chosen.schema).to_pandas()
    return frame
