"""A run beside its prediction: what every test looks at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from msg_analysis.model.step import StepModel
from msg_analysis.model.trajectory import Trajectory
from msg_analysis.theory.prediction import Prediction
from msg_analysis.types import BoolArray, FloatArray, IntArray

BLOCK_NUMBERS = 2_000_000
"""Numbers of temporary arrays per block of steps: 16 MB each, however long the run."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """The complete beginning of a run, and what theory says about it.

    Attributes
    ----------
    prediction : of the experiment that the record says was run
    states : (N + 1, m, R) x(0..N)
    modes : (N,) g(0..N-1)
    start : (m, R) x(0) of the record
    published : (N + 1, m, R) what others heard of x(0..N), where that is not the truth; else None
    lost : (N, m, D) see ``Trajectory.lost``
    """

    prediction: Prediction
    states: FloatArray
    modes: IntArray
    start: FloatArray
    published: FloatArray | None = None
    lost: BoolArray | None = None

    @classmethod
    def of(cls, trajectory: Trajectory, prediction: Prediction) -> Observation:
        """Everything before the first gap."""
        steps = trajectory.prefix
        published, lost = trajectory.published, trajectory.lost
        return cls(
            prediction,
            trajectory.states[: steps + 1],
            trajectory.modes[:steps],
            trajectory.record.start,
            None if published is None else published[: steps + 1],
            None if lost is None else lost[:steps],
        )

    @property
    def step(self) -> StepModel:
        """What one step of the run does."""
        return self.prediction.step

    @property
    def steps(self) -> int:
        """N."""
        return len(self.modes)

    @property
    def replicas(self) -> int:
        """R."""
        return int(self.states.shape[2])

    def blocks(self, numbers_per_step: int) -> Iterator[tuple[int, int]]:
        """(first, last + 1) of blocks of steps that keep temporary arrays small.

        Parameters
        ----------
        numbers_per_step : size of the largest temporary array, per step
        """
        length = max(1, BLOCK_NUMBERS // max(1, numbers_per_step))
        for first in range(0, self.steps, length):
            yield first, min(first + length, self.steps)
