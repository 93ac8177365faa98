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

"""The interval of the system error of a running network that holds at all times at once."""

from __future__ import annotations

from msg_analysis.inference.errors.estimates import Estimate
from msg_analysis.inference.statistics.batch_means import RunningBatches
from msg_analysis.inference.statistics.confidence_sequence import simultaneous_half_width, steps_to_half_width
from msg_analysis.model.run.record import RunRecord
from msg_analysis.theory.prediction import Prediction
from msg_analysis.types import FloatArray

TUNING_STEPS = 500  # before the interval is given: their variances say how it is tuned


class RunningInterval:
    """Half-width of the 95 % interval of the system error that holds at all times at once.

    By the martingale where there is a standard error; else by batch means of the measured errors, as in real time.
    """

    def __init__(self, record: RunRecord, prediction: Prediction | None, variance: float | None) -> None:
        self._until, self._planned = record.until, record.planned_steps
        self._predicted = prediction.emulated.system_error if prediction is not None else None
        self._variance = variance  # of a step, as far as it is known before the run
        self._batches = RunningBatches()
        self._target: float | None = None  # sum of variances for which the interval is narrowest: set early, and kept

    def add(self, series: FloatArray) -> None:
        """Add the system errors of steps (b,)."""
        self._batches.add(series)

    def half_width(self, system: Estimate, steps: int) -> float | None:
        """Of the mean over so many steps, with this estimate; None: not known yet."""
        if steps < TUNING_STEPS:
            return None
        error = system.standard_error
        variance = self._batches.variance() if error is None else (error * steps) ** 2
        if not variance or not system.measured:
            return None
        if self._target is None:
            each, size = self._variance or variance / steps, self._predicted or system.measured
            wanted = self._planned if self._until is None else steps_to_half_width(each, self._until.precision * size)
            self._target = each * min(self._planned, wanted)
        return float(simultaneous_half_width(variance, self._target)) / steps
