"""A running network as one line, as a terminal table or as a JSON document."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from msg_analysis.inference.errors.estimates import Estimate
from msg_analysis.inference.online.running_errors import LiveReport
from msg_analysis.model.run.record import RunRecord

MOST_ROWS = 20
"""Most agents in the table; of more, those with the largest abs(z)."""


def live_document(report: LiveReport, record: RunRecord) -> dict[str, Any]:
    """The document of ``msg-agents live --json``; keys as in that of ``compare`` where both have them."""
    dt = record.experiment.step_length
    return {
        "run": str(record.run),
        "experiment": record.experiment.name,
        "first_step": report.first,
        "last_step": report.last,
        "steps": report.steps,
        "missing": report.missing,
        "simulated_time": report.steps * dt,
        "system_error": report.system.to_json(),
        "node_errors": [node.to_json() for node in report.nodes],
        "refused": report.refused,
        "note": report.note,
    }


def live_line(report: LiveReport, record: RunRecord, rate: float) -> str:
    """Step, system error and missing steps in one line; ``rate`` in steps per second."""
    parts = [f"step {max(report.newest, 0)} of {record.experiment.steps}", f"system error {_beside(report.system)}"]
    return ", ".join(parts + _account(report, rate))


def live_table(report: LiveReport, record: RunRecord, rate: float) -> RenderableType:
    """A table of the errors, and below it what ``live_line`` counts; ``rate`` in steps per second."""
    experiment = record.experiment
    time = max(report.newest, 0) * experiment.step_length
    table = Table(
        title=f"{experiment.name}: step {max(report.newest, 0)} of {experiment.steps}, simulated time {time:g}",
        title_justify="left",
    )
    for name in ("error", "measured", "predicted", "standard error", "z"):
        table.add_column(name, justify="left" if name == "error" else "right")
    table.add_row("system", *_cells(report.system))
    nodes = list(enumerate(report.nodes, start=1))
    if len(nodes) > MOST_ROWS:
        nodes = sorted(nodes, key=lambda node: -abs(node[1].z or 0.0))[:MOST_ROWS]
    for number, node in nodes:
        table.add_row(f"agent {number}", *_cells(node))
    lines = [Text(", ".join(_account(report, rate)))]
    if len(nodes) < len(report.nodes):
        lines.append(Text(f"the {len(nodes)} agents furthest off, of {len(report.nodes)}"))
    if report.note:
        lines.append(Text(report.note))
    return Group(table, *lines)


def _account(report: LiveReport, rate: float) -> list[str]:
    if not report.steps:
        return ["nothing has come whole yet"]
    since = f" since step {report.first}" if report.first else ""
    parts = [f"{report.steps} steps{since}", f"{report.missing} missing", f"{rate:.0f} steps/s"]
    return parts + [f"{reason}: {count}" for reason, count in report.refused.items()]


def _beside(estimate: Estimate) -> str:
    measured, predicted, error, z = _cells(estimate)
    text = measured
    if estimate.standard_error is not None:
        text += f" +- {error}"
    if estimate.predicted is not None:
        text += f", predicted {predicted}"
    return text + (f", z = {z}" if estimate.z is not None else "")


def _cells(estimate: Estimate) -> list[str]:
    numbers = [estimate.measured, estimate.predicted, estimate.standard_error]
    cells = ["-" if number is None else f"{number:.5g}" for number in numbers]
    return [*cells, "-" if estimate.z is None else f"{estimate.z:+.1f}"]
