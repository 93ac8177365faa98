# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Saved results side by side, and which of their system errors differ significantly."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from msg_analysis.common.files import RESULT_FILE
from msg_analysis.common.text import half_width_text, markdown_table, measured_text, number_text, p_text, z_text
from msg_analysis.inference.estimates import Estimate, Ranking, rank_estimates
from msg_analysis.inference.statistics import two_sided
from msg_analysis.report.comparison_text import order_statements
from msg_analysis.report.tables import number_table, print_table, that_fit
from msg_analysis.runs import Result


def merge_results(rows: Sequence[Result]) -> list[dict[str, Any]]:
    """Several results of one experiment as one, every unit of simulated time with the same weight.

    Without those that have no number, or the seed of an earlier one.
    """
    groups: dict[str, list[Result]] = {}
    for row in rows:
        if row.identity is None or row.measured is None or row.predicted is None or not row.standard_error:
            continue
        group = groups.setdefault(row.identity, [])
        if not any(set(row.seeds.split()) & set(other.seeds.split()) for other in group):
            group.append(row)
    found = []
    for group in groups.values():
        if len(group) < 2:
            continue
        time = np.array([row.simulated_time for row in group])
        share = time / time.sum()
        measured = float(share @ [row.measured for row in group])
        predicted = float(share @ [row.predicted for row in group])
        error = float(np.linalg.norm(share * [row.standard_error for row in group]))
        z = (measured - predicted) / error
        found.append(
            {
                "experiment": group[0].experiment,
                "files": [row.file for row in group],
                "simulated_time": float(time.sum()),
                "measured": measured,
                "standard_error": error,
                "predicted": predicted,
                "z": z,
                "p": float(two_sided(z)),
            }
        )
    return found


def order_of_results(rows: Sequence[Result], level: float) -> Ranking | None:
    """Which system errors of independent runs (from 1) are smaller than which; None: some have no standard error.

    With leaders of infinite gain in every row, that is the order of their joint robustness centrality.
    """
    measured, deviations, predicted = (
        np.array([getattr(row, key) for row in rows], dtype=float)  # None: nan
        for key in ("measured", "standard_error", "predicted")
    )
    if np.isnan(measured + deviations).any():
        return None
    return rank_estimates(measured, np.diag(deviations**2), None if np.isnan(predicted).any() else predicted, level)


def to_json(rows: Sequence[Result], level: float) -> dict[str, Any]:
    """The document: ``results``, ``merged``, and ``order``, whose numbers are places among the results, from 1."""
    order = order_of_results(rows, level)
    return {
        "results": [asdict(row) for row in rows],
        "merged": merge_results(rows),
        "order": order.to_json() if order else None,
    }


def to_csv(rows: Sequence[Result]) -> str:
    """A line per result under the names of the columns, with all digits."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([field.name for field in fields(Result)])
    for row in rows:
        writer.writerow(["" if value is None else value for value in asdict(row).values()])
    return stream.getvalue()


def to_markdown(rows: Sequence[Result]) -> str:
    """The results as a Markdown table."""
    heads, body = _shown(rows)
    return markdown_table(heads, body, names=4)


_OPTIONAL = ("smallest p", "time", "seed", "experiment", "leaders", "± (95 %)")  # as in ``that_fit``


def print_results(rows: Sequence[Result], level: float, console: Console) -> None:
    """Print the results as a table, and which system errors differ at ``level`` (all pairs together)."""
    heads, body = _shown(rows)
    columns: dict[str, Sequence[str]] = dict(zip(heads, zip(*body, strict=True), strict=True))
    if console.is_terminal:
        columns["result"] = short_names([row.file for row in rows])
    columns = that_fit(console, columns, _OPTIONAL)
    table = number_table(console, "Results", *columns)
    table.columns[0].min_width = max(map(len, columns["result"]))
    for line in zip(*columns.values(), strict=True):
        table.add_row(*map(Text, line))
    print_table(console, table)
    for row in rows:
        if row.causes:
            console.print(Text(f"{row.file}: {row.causes}."))
    for one in merge_results(rows):
        error = Estimate(one["measured"], standard_error=one["standard_error"])
        merged = f"{len(one['files'])} results merged ({number_text(one['simulated_time'])} units of time)"
        numbers = f"predicted {number_text(one['predicted'])}, z = {z_text(one['z'])}, p = {p_text(one['p'])}."
        text = f"{one['experiment']}, {merged}: {measured_text(error.measured, error.interval)}, {numbers}"
        console.print(Text(text))
    if order := order_of_results(rows, level):
        for sentence in order_statements(
            order.to_json(), [row.file for row in rows], "has a smaller system error than"
        ):
            console.print(Text(sentence))


def short_names(files: Sequence[str]) -> list[str]:
    """The files without what all of them begin with, and without the name that a result has in its folder."""
    parts = [Path(file).parts for file in files]
    parts = [each[:-1] if each[-1:] == (RESULT_FILE,) and len(each) > 1 else each for each in parts]
    common = 0
    while len(parts) > 1 and all(len(each) > common + 1 and each[common] == parts[0][common] for each in parts):
        common += 1
    return [str(Path(*each[common:])) for each in parts]


def _shown(rows: Sequence[Result]) -> tuple[list[str], list[list[str]]]:
    heads = ["result", "experiment", "leaders", "verdict", "seed", "time"]
    heads += ["system error", "± (95 %)", "predicted", "z", "smallest p"]
    body = []
    for row in rows:
        seed = f"{row.bags} runs" if row.bags > 1 else row.seeds or "-"
        names = [row.file, row.experiment, row.leaders or "-", row.verdict, seed]
        numbers = [number_text(row.simulated_time), number_text(row.measured), half_width_text((row.low, row.high))]
        body.append([*names, *numbers, number_text(row.predicted), z_text(row.z), p_text(row.least_p)])
    return heads, body
