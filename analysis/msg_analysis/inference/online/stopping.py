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

"""Whether a running network may end before its duration (``--until``)."""

from __future__ import annotations

from msg_analysis.common.text.number_words import number_text
from msg_analysis.inference.online.running_errors import LiveReport
from msg_analysis.model.run.until import Until

LEAST_STEPS = 100  # before an interval counts


def reached(until: Until, report: LiveReport) -> str | None:
    """Why the run may end now, in words; None: it goes on."""
    seen, measured = report.any_time, report.system.measured
    if until.decided and seen.crossed is not None:
        return f"evidence against the prediction passed {seen.threshold:g} at step {report.last + 1}"
    if seen.half_width is None or not measured or report.steps < LEAST_STEPS:
        return None
    if seen.half_width > until.precision * measured:
        return None
    return f"precision {number_text(100 * until.precision)} % reached at step {report.last + 1}"


def precision_words(report: LiveReport) -> str:
    """How precisely the system error is known, in words."""
    half, measured = report.any_time.half_width, report.system.measured
    if half is None or not measured:
        return "the precision is not known"
    return f"precision {100 * half / measured:.2g} % at step {report.last + 1}"
