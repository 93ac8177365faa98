# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What a run measured, block by block."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from msg_analysis.arithmetic.reproducible import StepClock
from msg_analysis.common.arrays import BLOCK_NUMBERS, BoolArray, FloatArray, IntArray, large_zeros, pieces, release
from msg_analysis.common.resources import tell
from msg_analysis.common.text import agent_text
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run import Run
from msg_analysis.model.step_model import StepModel, Wiring
from msg_analysis.theory.prediction import Prediction

BATCH = 5  # steps averaged when searching for the end of the transient


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """The complete beginning of a run, with errors after the transient at its start."""

    first: int  # step at which the errors begin
    step: Wiring
    system_series: FloatArray  # (N - first,): system error of every step, replicas averaged
    covariance: FloatArray  # (m, m): mean over steps and replicas of the products of the agents' deviations
    modes: IntArray  # (N,) g(0..N-1)
    lost: BoolArray | None  # (N, m, D) see ``Run.lost``
    sure_messages: int  # see ``NoiseSpec.sure_messages``
    block_numbers: int = BLOCK_NUMBERS  # see ``Observation.block_numbers``
    timers: None = None  # in lockstep, or not used

    @classmethod
    def of(cls, trajectory: Run, block_numbers: int = BLOCK_NUMBERS) -> Measurement:
        """Everything before the first gap, of a run from a bag or from the twin."""
        experiment, steps = trajectory.record.experiment, max(trajectory.prefix, 0)
        series = np.empty(steps)
        numbers = int(trajectory.states[:1].size)
        for begin, end in _blocks(0, steps, numbers, "errors", block_numbers):
            series[begin:end] = (deviations(trajectory.values[begin:end], experiment) ** 2).sum(axis=1).mean(axis=1)
            trajectory.release()
        first = transient_length(series)
        products = np.zeros((experiment.agents, experiment.agents))
        for begin, end in _blocks(first, steps, numbers, "covariance", block_numbers):
            found = deviations(trajectory.values[begin:end], experiment)
            flat = found.transpose(1, 0, 2).reshape(experiment.agents, -1)
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
            sure_messages=experiment.noise.sure_messages,
            block_numbers=block_numbers,
        )

    @property
    def steps(self) -> int:
        """N."""
        return len(self.modes)

    def blocks(self, numbers_per_step: int, what: str) -> Iterator[tuple[int, int]]:
        """See ``Observation.blocks``."""
        return _blocks(0, self.steps, numbers_per_step, what, self.block_numbers)


def transient_length(series: FloatArray) -> int:
    """Steps at the start of a series (N,) without which its mean is more precise, by MSER-5 (White 1997).

    Of the means of 5 steps, the number left out minimises the variance of the mean of the others, as if these were
    independent. At most half are left out; 0 for series shorter than 20.
    """
    count = len(series) // BATCH
    if count < 4:
        return 0
    means = series[: count * BATCH].reshape(count, BATCH).mean(axis=1)
    left = np.arange(count, 0, -1)
    tails = np.cumsum(means[::-1])[::-1], np.cumsum(means[::-1] ** 2)[::-1]
    scores = (tails[1] - tails[0] ** 2 / left) / left.astype(float) ** 2
    return BATCH * int(np.argmin(scores[: count // 2 + 1]))


def _blocks(first: int, end: int, numbers_per_step: int, what: str, most: int) -> Iterator[tuple[int, int]]:
    """Blocks of the steps first..end-1; other arguments as of ``Observation.blocks``."""
    length = max(1, most // max(1, numbers_per_step))
    for begin in range(first, end, length):
        tell(what, begin, end)
        yield begin, min(begin + length, end)


def deviations(values: FloatArray, experiment: Experiment) -> FloatArray:
    """(b, m, R) from the reference, or in consensus from the agents' mean."""
    consensus = experiment.problem == "consensus"
    return np.asarray(values - (values.mean(axis=1, keepdims=True) if consensus else experiment.reference))


# States are clipped to this: fourth powers of much larger numbers overflow, and no test could be computed
LARGEST = 1e60
SPACED = 400  # steps at which curves over a run are given


@dataclass(frozen=True, slots=True, eq=False)
class Timers:
    """What the agents of a run in real time log about each of their steps."""

    graphs: IntArray  # (N, m) index of the graph that the agent used
    used: IntArray  # (N, m, D) see ``Run.used``
    made: IntArray  # (N + 1, m) [ns of simulated time] see ``Run.made``


@dataclass(frozen=True, eq=False)  # no slots, for cached_property
class Observation:
    """The complete beginning of a run, and its prediction."""

    prediction: Prediction  # of the experiment in the record
    states: FloatArray  # (N + 1, m, R) x(0..N), clipped by ``bounded``
    modes: IntArray  # (N,) g(0..N-1)
    start: FloatArray  # (m, R) x(0) of the record
    published: FloatArray | None = None  # (N + 1, m, R) what others received of x(0..N); None where that is x
    lost: BoolArray | None = None  # (N, m, D) see ``Run.lost``
    timers: Timers | None = None  # None in lockstep
    used: IntArray | None = None  # (N, m, D) in lockstep, see ``Run.used``
    wrong_stamp: tuple[int, int, int] | None = None  # see ``Run.wrong_stamp``
    block_numbers: int = BLOCK_NUMBERS  # of temporary arrays of a block of steps, at most

    @classmethod
    def of(cls, trajectory: Run, prediction: Prediction, block_numbers: int = BLOCK_NUMBERS) -> Observation:
        """Everything before the first gap; InputError if a log in real time does not say what the agents used."""
        real_time = trajectory.record.experiment.run.pace == "realtime"
        steps = _known_steps(trajectory) if real_time else trajectory.prefix
        published, lost, used = trajectory.published, trajectory.lost, trajectory.used
        timers = None
        if real_time:
            assert trajectory.agent_modes is not None
            assert trajectory.used is not None
            assert trajectory.made is not None
            timers = Timers(
                trajectory.agent_modes[1 : steps + 1], trajectory.used[:steps], trajectory.made[: steps + 1]
            )
        return cls(
            prediction,
            bounded(trajectory.states[: steps + 1]),
            trajectory.modes[:steps],
            bounded(trajectory.record.start),
            None if published is None else bounded(published[: steps + 1]),
            None if lost is None else lost[:steps],
            timers,
            None if used is None or real_time else used[:steps],
            trajectory.wrong_stamp,
            block_numbers,
        )

    @property
    def step(self) -> StepModel:
        """The law of one step."""
        return self.prediction.step

    @property
    def steps(self) -> int:
        """N."""
        return len(self.modes)

    @property
    def timed(self) -> Timers:
        """The timers, in real time."""
        assert self.timers is not None
        return self.timers

    @property
    def sure_messages(self) -> int:
        """See ``NoiseSpec.sure_messages``."""
        return self.prediction.experiment.noise.sure_messages

    @cached_property
    def largest(self) -> float:
        """Size of the largest state."""
        return _largest(self.states)

    @property
    def replicas(self) -> int:
        """R."""
        return int(self.states.shape[2])

    def as_timed(self) -> Observation:
        """A run in lockstep as one in real time in which all agents step together, always on time."""
        steps, m, most = self.steps, self.step.agents, self.step.most_neighbours
        total = 8 * steps * m * (2 + most)
        used = self.used
        if used is None:
            used = large_zeros((steps, m, most), np.int64, total=total)
        graphs, made = (large_zeros((count, m), np.int64, total=total) for count in (steps, steps + 1))
        clock = StepClock(self.step.dt)
        for first, last in self.blocks((2 + most) * m, "times of the steps"):
            graphs[first:last] = self.modes[first:last, None]
            made[first : last + 1] = clock.times(np.arange(first, last + 1))[:, None]
            if self.used is None:
                used[first:last] = np.arange(first, last)[:, None, None]
                if self.lost is not None:
                    used[first:last][self.lost[first:last]] = -1
            for array in (graphs, used, made):
                release(array)
        return replace(self, timers=Timers(graphs, used, made), used=None)

    def blocks(self, numbers_per_step: int, what: str) -> Iterator[tuple[int, int]]:
        """(first, last + 1) of blocks of steps with few temporary numbers; ``what`` is done, for those who watch."""
        for block in _blocks(0, self.steps, numbers_per_step, what, self.block_numbers):
            yield block
            self.release()

    def release(self) -> None:
        """Give back the memory of a long run, whose states are in a file: after every block."""
        timers = (self.timers.graphs, self.timers.used, self.timers.made) if self.timers else ()
        for array in (self.states, self.published, self.lost, self.used, *timers):
            if array is not None:
                release(array)


def spaced_steps(steps: int, most: int = SPACED) -> IntArray:
    """(T,): at most so many numbers of steps up to all of them, denser at the beginning."""
    half = most // 2
    spaced = np.concatenate([np.geomspace(1, steps, half), np.linspace(1, steps, half)])
    return np.unique(np.rint(spaced).astype(np.int64))


def bounded(states: FloatArray) -> FloatArray:
    """The array, of any shape, clipped to ``LARGEST`` either way: such states are wrong, but can be computed with."""
    return states if _largest(states) <= LARGEST else np.clip(states, -LARGEST, LARGEST)


def _largest(states: FloatArray) -> float:
    """Size of the largest number; 0 where there is none."""
    largest = 0.0
    for piece in pieces(states):
        largest = max(largest, float(states[piece].max(initial=0.0)), -float(states[piece].min(initial=0.0)))
    return largest


def _known_steps(trajectory: Run) -> int:
    """Steps of the longest complete beginning in which no agent uses a value from after its end."""
    steps = trajectory.prefix
    if trajectory.agent_modes is None or trajectory.used is None or trajectory.made is None:
        raise InputError(
            "log of a run in real time: expected graph, values used and time in every state: record it again with this "
            "version"
        )
    end = max(steps, 0)
    graphs, used, made = trajectory.agent_modes[1 : end + 1], trajectory.used[:end], trajectory.made[1 : end + 1]
    newest = np.empty(end, dtype=np.int64)
    for piece in pieces(used):
        unknown = np.argwhere((graphs[piece] < 0) | (made[piece] < 0))
        if len(unknown):
            step, agent = unknown[0].tolist()
            named = agent_text(agent + 1, trajectory.record.experiment.names)
            wanted = "expected in the log of a run in real time"
            raise InputError(f"{named}: graph or time of step {piece.start + step} missing: {wanted}")
        newest[piece] = used[piece].max(axis=(1, 2), initial=-1)
        trajectory.release()
    while (beyond := newest[:steps] > steps).any():  # only where the run is not complete
        steps = int(np.argmax(beyond))
    return steps
