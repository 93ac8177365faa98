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


"""Document of ``msg-analysis spectrum``: predicted, and of a bag also measured and tested."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msg_analysis.bags.reader import read_bag
from msg_analysis.inference.errors.autocovariance import (
    LoggedAutocovariance,
    LoggedDensity,
    logged_autocovariance,
    why_not_tested,
)
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.theory.prediction import predict
from msg_analysis.theory.spectrum import Spectrum, spectrum


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredSpectrum:
    """A predicted spectrum, and what a log says of it."""

    predicted: Spectrum
    level: float | None = None
    log: LoggedAutocovariance | None = None
    density: LoggedDensity | None = None
    note: str | None = None  # why the log is not tested, or not all of it
    complete: bool = True

    @property
    def disagrees(self) -> bool:
        """Whether the test rejects."""
        return self.log is not None and self.log.p is not None and self.level is not None and self.log.p < self.level

    def to_json(self) -> dict[str, Any]:
        """The document."""
        return self.predicted.to_json() | {
            "level": self.level,
            "agrees": None if self.log is None or self.log.p is None else not self.disagrees,
            "log": self.log and self.log.to_json(),
            "log_density": self.density
            and {"frequencies": self.density.frequencies.tolist(), "system": self.density.system.tolist()},
            "note": self.note,
        }


def predicted_spectrum(experiment: ValidExperiment) -> MeasuredSpectrum:
    """Of an experiment; errors as of ``spectrum`` and ``predict``."""
    experiment.require_available("predict")
    return MeasuredSpectrum(spectrum(predict(experiment)))


def measure_spectrum(bag: Path, level: float) -> MeasuredSpectrum:
    """Of the run in a bag, of a torn one of what is before the first gap."""
    trajectory = read_bag(bag)
    experiment = trajectory.record.experiment
    experiment.require_available("predict")
    prediction = predict(experiment, trajectory.record.step_model)
    predicted, complete = spectrum(prediction), trajectory.completeness.complete
    observation = Observation.of(trajectory, prediction)
    reason = why_not_tested(observation)
    density = LoggedDensity.of(observation) if observation.steps >= 8 else None
    log = logged_autocovariance(observation) if reason is None else None
    note = None
    if reason is not None:
        note = f"the log is not tested: {reason}"
    elif log is None:
        note = "the log is not tested: lost messages make too many kinds of steps"
    elif log.steps < observation.steps:
        note = f"the first {log.steps} of {observation.steps} steps are tested"
    return MeasuredSpectrum(predicted, level, log, density, note, complete)
