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


"""Length and replicas of a run for a precision of the system error, or the best replicas for a number of steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

from msg_analysis.common.intervals import HALF_WIDTH_95
from msg_analysis.inference.statistics.confidence_sequence import simultaneous_half_width
from msg_analysis.theory.prediction import Prediction
from msg_analysis.theory.settling import settling_time
from msg_analysis.theory.time_mean_variance import MeanVariance, mean_variance
from msg_analysis.theory.transient import start_of

REPLICAS: tuple[int, ...] = tuple(2**k for k in range(9))  # that are tried: 1 to 256
HARDLY_WORSE = 1.05  # a half-width up to so many times the least one is as good, if it needs fewer replicas
# Half-width of the 95 % interval that holds at all times at once, in standard errors, at the length it is made for
ANY_TIME_95: float = float(simultaneous_half_width(1.0, 1.0))


@dataclass(frozen=True, slots=True)
class Precision:
    """How precisely a run of any length measures the system error.

    Attributes
    ----------
    error
        predicted system error
    variance
        of its time mean
    warm_up
        steps until the effect of the start is within the precision that is sought; 0 from the stationary start
    any_time
        whether there is an interval that holds at all times at once
    """

    error: float
    variance: MeanVariance
    warm_up: int
    any_time: bool

    def standard_error(self, steps: float, replicas: float) -> float:
        """Standard error of the mean after so many steps, relative to the error; infinite within the warm-up.

        Parameters
        ----------
        steps
            length of the run, with the warm-up
        replicas
            of the run
        """
        counted = max(steps - self.warm_up, 0.0)
        return math.sqrt(self.variance.of(replicas) / counted) / self.error if counted else math.inf

    def steps(self, precision: float, replicas: int, *, any_time: bool = False) -> int:
        """Steps after which the half-width of the 95 % interval, relative to the error, is ``precision``.

        Parameters
        ----------
        precision
            half-width, above 0
        replicas
            of the run
        any_time
            of the interval that holds at all times at once, for a run that is planned for this length
        """
        width = ANY_TIME_95 if any_time else HALF_WIDTH_95
        needed = self.variance.of(replicas) * math.pow(width / (precision * self.error), 2.0)
        return self.warm_up + max(1, math.ceil(needed))

    def best_replicas(self, steps: int) -> int:
        """The fewest of ``REPLICAS`` with nearly the least half-width after so many steps.

        A step of a network takes nearly the same time with 1 and with 256 replicas (docs/planning.md).

        Parameters
        ----------
        steps
            length of the run
        """
        least = self.standard_error(steps, REPLICAS[-1])
        return next(r for r in REPLICAS if self.standard_error(steps, r) <= HARDLY_WORSE * least)


def precision_of(prediction: Prediction, sought: float) -> Precision:
    """Precision of the runs of an experiment.

    Parameters
    ----------
    prediction
        of the experiment
    sought
        precision for the warm-up: the expected error is then within this share of the steady one

    Raises
    ------
    InputError
        fourth moments of the states do not exist, or the errors take too long to settle
    """
    experiment = prediction.experiment
    stationary = experiment.run.start == "stationary" and experiment.switching.initial == "stationary"
    error = prediction.emulated.system_error
    warm_up = 0.0
    if not stationary and error > 0.0:
        start = start_of(experiment, prediction.system, prediction.steady)
        warm_up = settling_time(prediction.system, prediction.steady, start, sought)
    noise = experiment.noise
    plain = not (noise.on_air or noise.delay or experiment.run.pace == "realtime")
    return Precision(error, mean_variance(prediction), math.ceil(warm_up), plain)
