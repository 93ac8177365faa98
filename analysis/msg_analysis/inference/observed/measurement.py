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

"""Measured errors of a run without a prediction."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msg_analysis.common.large_arrays import BLOCK_NUMBERS
from msg_analysis.common.long_work import tell
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.model.step.step_model import Wiring
from msg_analysis.types import BoolArray, FloatArray, IntArray

BATCH = 5  # steps averaged when searching for the end of the transient


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """The complete beginning of a run, with errors after the transient at its start."""

    first: int  # step at which the errors begin
    step: Wiring
    system_series: FloatArray  # (N - first,): system error of every step, replicas averaged
    covariance: FloatArray  # (m, m): mean over steps and replicas of the products of the agents' deviations
    modes: IntArray  # (N,) g(0..N-1)
    lost: BoolArray | None  # (N, m, D) see ``Trajectory.lost``
    sure_messages: int  # see ``Observation.sure_messages``

    @classmethod
    def of(cls, trajectory: Trajectory) -> Measurement:
        """Everything before the first gap, of a run from a bag or from the twin."""
        experiment, steps = trajectory.record.experiment, max(trajectory.prefix, 0)
        series = np.empty(steps)
        numbers = int(trajectory.states[:1].size)
        for begin, end in _blocks(0, steps, numbers, "errors"):
            series[begin:end] = (_deviations(trajectory, begin, end) ** 2).sum(axis=1).mean(axis=1)
            trajectory.release()
        first = transient_length(series)
        products = np.zeros((experiment.agents, experiment.agents))
        for begin, end in _blocks(first, steps, numbers, "covariance"):
            flat = _deviations(trajectory, begin, end).transpose(1, 0, 2).reshape(experiment.agents, -1)
            products += flat @ flat.T
            trajectory.release()
        lost = trajectory.lost
        return cls(
            first=first,
            step=trajectory.record.model,
            system_series=series[first:],
            covariance=products / max(1, (steps - first) * experiment.run.replicas),
            modes=trajectory.modes[:steps],
            lost=None if lost is None else lost[:steps],
            sure_messages=experiment.noise.delay + (1 if experiment.noise.holds else 0),
        )

    @property
    def steps(self) -> int:
        """N."""
        return len(self.modes)

    def blocks(self, numbers_per_step: int, what: str) -> Iterator[tuple[int, int]]:
        """See ``Observation.blocks``."""
        return _blocks(0, self.steps, numbers_per_step, what)


def transient_length(series: FloatArray) -> int:
    """Steps at the start of a series without which its mean is more precise, by MSER-5 (White 1997).

    Of the means of 5 steps, the number left out minimises the variance of the mean of the others, as if these were
    independent. At most half are left out; 0 for series shorter than 20.

    Parameters
    ----------
    series
        (N,) in the order of time
    """
    count = len(series) // BATCH
    if count < 4:
        return 0
    means = series[: count * BATCH].reshape(count, BATCH).mean(axis=1)
    left = np.arange(count, 0, -1)
    tails = np.cumsum(means[::-1])[::-1], np.cumsum(means[::-1] ** 2)[::-1]
    scores = (tails[1] - tails[0] ** 2 / left) / left.astype(float) ** 2
    return BATCH * int(np.argmin(scores[: count // 2 + 1]))


def _blocks(first: int, end: int, numbers_per_step: int, what: str) -> Iterator[tuple[int, int]]:
    """Blocks of the steps first..end-1; other arguments as of ``Observation.blocks``."""
    length = max(1, BLOCK_NUMBERS // max(1, numbers_per_step))
    for begin in range(first, end, length):
        tell(what, begin, end)
        yield begin, min(begin + length, end)


def _deviations(trajectory: Trajectory, first: int, end: int) -> FloatArray:
    """(end - first, m, R) from the reference, or in consensus from the agents' mean."""
    experiment, values = trajectory.record.experiment, trajectory.values[first:end]
    consensus = experiment.problem == "consensus"
    return np.asarray(values - (values.mean(axis=1, keepdims=True) if consensus else experiment.reference))
