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

import numpy as np

from msg_analysis.model.arithmetic.step_clock import StepClock
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.air_reception import used_steps
from msg_analysis.model.step.phases import phases
from msg_analysis.model.step.step_model import Wiring
from msg_analysis.types import IntArray


def ideal_log(experiment: ValidExperiment, model: Wiring, modes: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """``agent_modes``, ``used`` and ``made`` of ``Trajectory`` for a run with these graphs (N,), from 0."""
    phase, steps = phases(experiment), len(modes)
    agent_modes = np.repeat(np.concatenate([[-1], modes])[:, None], model.agents, axis=1)
    made = np.zeros((steps + 1, model.agents), dtype=np.int64)
    for i in range(model.agents):
        made[1:, i] = StepClock(experiment.step_length, float(phase[i])).times(np.arange(steps))
    return agent_modes, used_steps(experiment, model, modes), made
