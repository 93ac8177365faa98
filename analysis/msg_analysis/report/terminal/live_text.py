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

"""A running network as one line or as a JSON document."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from msg_analysis.common.text.number_words import measured_text, number_text, z_text
from msg_analysis.model.run.record import RunRecord

if TYPE_CHECKING:  # these take long to import, while a network starts
    from msg_analysis.inference.errors.estimates import Estimate
    from msg_analysis.inference.online.running_errors import LiveReport


def live_document(report: LiveReport, record: RunRecord) -> dict[str, Any]:
    """The document of ``msg-agents live --json``; keys as in that of ``compare`` where both have them."""
    dt = record.experiment.step_length
    return {
        "run": str(record.run),
        "experiment": record.experiment.name,
        "names": record.experiment.names,
        "first_step": report.first,
        "last_step": report.last,
        "steps": report.steps,
        "missing": report.missing,
        "simulated_time": report.steps * dt,
        "system_error": report.system.to_json(),
        "node_errors": [node.to_json() for node in report.nodes],
        "any_time": report.any_time.to_json(),
        "refused": report.refused,
        "note": report.note,
    }


def live_line(report: LiveReport, last: int, rate: float) -> str:
    """Step, of ``last`` ones, system error and missing steps in one line; ``rate`` in steps per second."""
    parts = [f"step {min(max(report.newest, 0), last)} of {last}", f"system error {error_text(report.system)}"]
    if any_time := any_time_text(report):
        parts.append(any_time)
    return ", ".join(parts + (coverage(report) if report.steps else ["no complete step yet"]) + [f"{rate:.0f} steps/s"])


def any_time_text(report: LiveReport) -> str:
    """What is valid however often one looks: half-width of the interval, evidence; may be empty."""
    seen, parts = report.any_time, []
    if seen.half_width is not None:
        parts.append(f"any time ± {number_text(seen.half_width, 2)}")
    if seen.log_evidence is not None:
        evidence = seen.to_json()["evidence"]
        shown = "more than 1e300" if evidence is None else number_text(evidence, 2)
        limit = f"disagrees: {seen.strongest}" if seen.crossed else f"disagrees at {seen.threshold:g}"
        parts.append(f"evidence against the prediction {shown} ({limit})")
    return ", ".join(parts)


def coverage(report: LiveReport) -> list[str]:
    """Steps in the errors, incomplete ones, and refused messages by reason."""
    since = f" since step {report.first}" if report.first else ""
    parts = [f"{report.steps} steps{since}", f"{report.missing} missing"]
    return parts + [f"{reason}: {count}" for reason, count in report.refused.items()]


def error_text(estimate: Estimate) -> str:
    """An error next to its prediction: ``1.45 ± 0.059 (95 %), predicted 1.41, z = +1.33``."""
    text = measured_text(estimate.measured, estimate.interval)
    if estimate.predicted is not None:
        text += f", predicted {number_text(estimate.predicted)}"
    return text + (f", z = {z_text(estimate.z)}" if estimate.z is not None else "")
