"""The offline twin in real time: ideal timers, so that the agents step one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from msg_analysis.model.arithmetic.step_clock import StepClock
from msg_analysis.model.arithmetic.update_law import step
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.air_reception import padded_inputs
from msg_analysis.model.step.phases import phases
from msg_analysis.model.step.sequential_law import ideal_uses
from msg_analysis.model.step.step_model import StepModel
from msg_analysis.types import FloatArray, IntArray


class IdealTimers:
    """A run in real time in which every agent steps when it is due, and hears at once what others made."""

    def __init__(self, experiment: ValidExperiment, model: StepModel) -> None:
        self._phase = phases(experiment)
        self._dt = experiment.step_length
        self._model = model
        self._rounds = [_rounds(model, mode, self._phase) for mode in range(model.modes)]

    def states(self, modes: IntArray, start: FloatArray, drives: Iterable[FloatArray]) -> Iterator[FloatArray]:
        """(m, R) each: x(1), x(2), ... under the graphs ``modes`` (N,), from x(0) = ``start`` (m, R).

        ``drives`` has noise plus offset (m, R) of every step. Every sum is the one that an agent computes alone, to the
        last bit.
        """
        m = len(start)
        both = np.concatenate([start, start])  # x(k) above x(k+1)
        for mode, drive in zip(modes, drives, strict=True):
            both[:m] = both[m:]
            for agents, weights, inputs in self._rounds[mode]:
                both[m + agents] = step(weights, [both[row] for row in inputs], drive[agents])
            yield both[m:].copy()

    def log(self, modes: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        """``agent_modes``, ``used`` and ``made`` of ``Trajectory`` for a run with these graphs (N,), from 0."""
        model, phase, steps = self._model, self._phase, len(modes)
        agent_modes = np.repeat(np.concatenate([[-1], modes])[:, None], model.agents, axis=1)
        ahead = ideal_uses(model, phase)[modes]
        used = np.where(ahead >= 0, np.arange(steps)[:, None, None] + ahead, -1)
        made = np.zeros((steps + 1, model.agents), dtype=np.int64)
        for i in range(model.agents):
            made[1:, i] = StepClock(self._dt, float(phase[i])).times(np.arange(steps))
        return agent_modes, used, made


def _rounds(model: StepModel, mode: int, phase: FloatArray) -> list[tuple[IntArray, list[FloatArray], list[IntArray]]]:
    """Agents that can step together, round after round: (agents, weights, rows of [x(k); x(k+1)]), padded.

    An agent is in the first round after those of the neighbours that are due before it.
    """
    m = model.agents
    columns, there = padded_inputs(model, mode)
    agents = np.arange(m)
    earlier = there & (phase[columns] < phase)
    weights = np.where(there, model.nominal[mode, agents, columns], 0.0)[:, :, None]
    number = np.zeros(m, dtype=np.int64)
    for i in np.argsort(phase).tolist():
        number[i] = 1 + max(number[columns[earlier[:, i], i]], default=-1)
    rounds = []
    for one in range(int(number.max()) + 1):
        chosen = np.flatnonzero(number == one)
        rows = columns[:, chosen] + m * earlier[:, chosen]
        rounds.append((chosen, list(weights[:, chosen]), list(rows)))
    return rounds
