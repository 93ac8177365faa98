"""A running network as one line, as a terminal table or as a JSON document."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from msg_analysis.common.number_words import half_width_text, measured_text, number_text, z_text
from msg_analysis.inference.errors.estimates import Estimate
from msg_analysis.inference.online.running_errors import LiveReport
from msg_analysis.model.run.record import RunRecord
from msg_analysis.report.documents.comparison_words import furthest

MOST_ROWS = 20  # agents in the table: a screen; of more, those with the largest abs(z)


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
    parts = [f"step {max(report.newest, 0)} of {record.experiment.steps}", _system(report.system)]
    return ", ".join(parts + _account(report, rate))


def live_table(report: LiveReport, record: RunRecord, rate: float) -> RenderableType:
    """A table of the errors, and below it what ``live_line`` counts; ``rate`` in steps per second."""
    experiment = record.experiment
    time = max(report.newest, 0) * experiment.step_length
    table = Table(
        title=f"{experiment.name}: step {max(report.newest, 0)} of {experiment.steps}, simulated time {time:g}",
        title_justify="left",
    )
    for name in ("error", "measured", "± (95 %)", "predicted", "z"):
        table.add_column(name, justify="left" if name == "error" else "right")
    table.add_row("system", *_cells(report.system))
    cut = len(report.nodes) > MOST_ROWS
    for agent in furthest([node.z for node in report.nodes], MOST_ROWS) if cut else range(len(report.nodes)):
        table.add_row(f"agent {agent + 1}", *_cells(report.nodes[agent]))
    lines = [Text(", ".join(_account(report, rate)))]
    if cut:
        lines.append(Text(f"the {MOST_ROWS} agents with the largest |z|, of {len(report.nodes)}"))
    if report.note:
        lines.append(Text(report.note))
    return Group(table, *lines)


def _account(report: LiveReport, rate: float) -> list[str]:
    if not report.steps:
        return ["no complete step yet"]
    since = f" since step {report.first}" if report.first else ""
    parts = [f"{report.steps} steps{since}", f"{report.missing} missing", f"{rate:.0f} steps/s"]
    return parts + [f"{reason}: {count}" for reason, count in report.refused.items()]


def _system(error: Estimate) -> str:
    text = f"system error {measured_text(error.measured, error.interval)}"
    if error.predicted is not None:
        text += f", predicted {number_text(error.predicted)}"
    return text + (f", z = {z_text(error.z)}" if error.z is not None else "")


def _cells(error: Estimate) -> list[str]:
    return [
        number_text(error.measured),
        half_width_text(error.interval),
        number_text(error.predicted),
        z_text(error.z),
    ]
