# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Sweeps from Python, with the points, the work and the table of the command."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from msg_analysis.common.resources import require_pyarrow
from msg_analysis.common.text import markdown_table
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.graph_sources import plain
from msg_analysis.experiment.values import is_number
from msg_analysis.sweeps import grid
from msg_analysis.sweeps.points import JobKind, evaluate, options
from msg_analysis.sweeps.results import ResultStore, Row, SweepVerdict, arrow_table, evaluate_sweep, rows_of
from msg_analysis.sweeps.workers import run_jobs

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Sweep:
    """An experiment at many values of its keys.

    Attributes
    ----------
    points
        what was done: values of the keys, and the experiment of every point
    rows
        a mapping for each point, with the columns of ``results.csv`` of the command
    judgement
        what the runs say together: ``verdict``, ``verdicts`` and ``p_adjusted`` (None for predictions)
    """

    points: grid.SweepGrid
    rows: list[Row]
    judgement: SweepVerdict

    def __repr__(self) -> str:
        verdict = f"; {self.judgement.verdict}" if self.judgement.verdict else ""
        what = f"{', '.join(self.points.keys)}: {len(self.rows)} points, {self.points.kind}"
        return f"<Sweep of {self.points.experiment!r} over {what}{verdict}>"

    def _repr_markdown_(self) -> str:
        shown = [*self.points.keys, *(name for name in self.rows[0] if name.endswith("system_error"))]
        cells = [
            [f"{value:.6g}" if is_number(value := row.get(name)) else str(value) for name in shown] for row in self.rows
        ]
        return f"{self!r}\n\n{markdown_table(shown, cells, names=0)}"

    def to_dataframe(self) -> pd.DataFrame:
        """The points as a data frame of pandas, a row each.

        Returns
        -------
        pandas.DataFrame
            the swept keys, ``system_error`` and the others under their law: ``emulated.system_error``, ...

        Raises
        ------
        NotAvailableError
            pandas is not installed
        """
        from msg_analysis.report.export import require_pandas

        require_pandas()
        require_pyarrow("to_dataframe")
        return arrow_table(self.rows).to_pandas()

    def plot(self, column: str | None = None) -> Figure:
        """Draw a column over the first key, a line for each value of the second.

        Parameters
        ----------
        column
            of the table; None: the system error

        Returns
        -------
        matplotlib.figure.Figure
            notebooks show it; ``figure.savefig("sweep.png")`` writes it

        Raises
        ------
        InputError
            it is not a column of numbers
        """
        import matplotlib as mpl

        from msg_analysis.report.figures import STYLE
        from msg_analysis.report.sweep_plots import draw
        from msg_analysis.sweeps.results import picture

        with mpl.rc_context(STYLE):
            return draw(picture(self.points, self.rows, column), f"{self.points.experiment}: {self.points.kind}")


def sweep(
    experiment: str | Path | Experiment,
    over: Mapping[str, Any],
    *,
    kind: JobKind = "predict",
    combine: Literal["grid", "zip"] = "grid",
    repetitions: int = 1,
    level: float = 0.01,
    workers: int | None = None,
) -> Sweep:
    """Predict, simulate or run an experiment at many values of its keys, as ``msg-analysis sweep`` does.

    Parameters
    ----------
    experiment
        the experiment, the path of its file, or the name of an example
    over
        values by dotted key, such as ``{"switching.scale": [0.1, 1, 10]}``
    kind
        "predict", "simulate" (and compare), or "network" (run with ROS 2, and compare)
    combine
        "grid": every value with every value of the other keys; "zip": the first values together, then the second, ...
    repetitions
        runs at every point, each with a seed of its own
    level
        probability of a false "disagrees", all runs together; above 0, at most 0.5
    workers
        worker processes; None: in this process

    Returns
    -------
    Sweep
        ``to_dataframe()``, ``plot()``, ``rows``

    Raises
    ------
    ExperimentError
        a key or a value is not valid; names every mistake and its points
    """
    if not isinstance(experiment, Experiment):
        experiment = Experiment.load(experiment)
    document = experiment.to_document()
    given = {
        "experiment": document,
        "over": {key: plain(values) for key, values in over.items()},
        "kind": kind,
        "combine": combine,
        "repetitions": repetitions,
        "level": level,
    }
    points = grid.points_of(Path(experiment.name), grid.spec_of(given, "sweep"), document, Path(), lambda *_: None)
    jobs = [point.job for point in points.points]
    if workers is None and kind != "network":
        outcomes = tuple(evaluate(job) for job in jobs)
    else:
        with tempfile.TemporaryDirectory() as folder, closing(ResultStore.open(folder)) as store:
            network = options(Path(folder), False, workers or 1) if kind == "network" else None
            outcomes = run_jobs(jobs, store, workers=workers, network=network).outcomes
    judgement = evaluate_sweep(outcomes, level)
    return Sweep(points, rows_of(points, outcomes, judgement), judgement)
