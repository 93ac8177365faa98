"""The offline twin in real time: ideal timers, so that the agents step one after the other.

Every agent steps when it is due, and hears at once what others made.
"""

from __future__ import annotations

import numpy as np

from msg_analysis.model.arithmetic.step_clock import StepClock
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.phases import phases
from msg_analysis.model.step.sequential_law import ideal_uses
from msg_analysis.model.step.step_model import StepModel
from msg_analysis.types import IntArray


def ideal_log(experiment: ValidExperiment, model: StepModel, modes: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """``agent_modes``, ``used`` and ``made`` of ``Trajectory`` for a run with these graphs (N,), from 0."""
    phase, steps = phases(experiment), len(modes)
    agent_modes = np.repeat(np.concatenate([[-1], modes])[:, None], model.agents, axis=1)
    ahead = ideal_uses(model, phase)[modes]
    used = np.where(ahead >= 0, np.arange(steps)[:, None, None] + ahead, -1)
    made = np.zeros((steps + 1, model.agents), dtype=np.int64)
    for i in range(model.agents):
        made[1:, i] = StepClock(experiment.step_length, float(phase[i])).times(np.arange(steps))
    return agent_modes, used, made
