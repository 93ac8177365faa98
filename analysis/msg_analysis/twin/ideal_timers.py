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

"""The offline twin in real time: ideal timers, so that the agents step one after the other.

Every agent steps when it is due, and hears at once what others made.
"""

from __future__ import annotations

import math

import numpy as np

from msg_analysis.common.large_arrays import large_zeros, release
from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK
from msg_analysis.model.arithmetic.step_clock import StepClock
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.air_reception import MessagesUsed
from msg_analysis.model.step.phases import phases
from msg_analysis.model.step.step_model import Wiring
from msg_analysis.types import IntArray


def ideal_log(experiment: ValidExperiment, model: Wiring, modes: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """``agent_modes``, ``used`` and ``made`` of ``Trajectory`` for a run with these graphs (N,), from 0."""
    agent_modes, made = ideal_times(experiment, modes)
    messages, shape = MessagesUsed(experiment, model), (len(modes), model.agents, model.most_neighbours)
    used = large_zeros(shape, np.int64, total=8 * math.prod(shape))
    for first in range(0, len(modes), STEPS_PER_BLOCK):
        now = slice(first, first + STEPS_PER_BLOCK)
        used[now] = messages.used(first, modes[now])
        release(used)
    return agent_modes, used, made


def ideal_times(experiment: ValidExperiment, modes: IntArray) -> tuple[IntArray, IntArray]:
    """``agent_modes`` and ``made`` alone."""
    shape = len(modes) + 1, experiment.agents
    agent_modes, made = (large_zeros(shape, np.int64, total=8 * shape[0] * shape[1]) for _ in range(2))
    agent_modes[0] = -1
    agent_modes[1:] = modes[:, None]
    for i, phase in enumerate(phases(experiment).tolist()):
        made[1:, i] = StepClock(experiment.step_length, phase).times(np.arange(len(modes)))
    return agent_modes, made
