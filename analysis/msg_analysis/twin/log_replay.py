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

"""The twin of a run in real time: from what every agent logged of each step, what must have come out of it."""

from __future__ import annotations

import numpy as np

from msg_analysis.model.arithmetic.payload import from_payload, to_payload
from msg_analysis.model.run.agent_law import agent_law
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.types import FloatArray


def replay(trajectory: Trajectory) -> FloatArray:
    """(N + 1, m, R) states that the law gives from the logged inputs of every step; NaN where inputs are missing.

    By induction, a log in real time that equals this from x(0) on is what the law gives for the start, the seed, and
    the values that the agents used. ValueError: the log does not have these (a run in lockstep).
    """
    used, modes = trajectory.used, trajectory.agent_modes
    if used is None or modes is None:
        raise ValueError("a run in lockstep: its twin is `simulate`")
    record, states = trajectory.record, trajectory.states
    model = record.step_model
    there = np.asarray(~np.isnan(states).any(axis=2))
    law_gives = np.full_like(states, np.nan)
    law_gives[0] = record.start
    for i in range(model.agents):
        law = agent_law(record, model, i)
        neighbours = [law.neighbours(mode) for mode in range(model.modes)]
        for k in range(len(used)):
            mode = int(modes[k + 1, i])
            if mode < 0 or not there[k, i]:
                continue
            heard = list(zip(used[k, i].tolist(), neighbours[mode], strict=False))
            if not all(step < 0 or there[step, j] for step, j in heard):
                continue
            own = to_payload(states[k, i])
            if law.step != k:
                law.resume(k, own)
            law.state = own
            values = [own if step < 0 else to_payload(states[step, j]) for step, j in heard]
            law_gives[k + 1, i] = from_payload(law.advance(mode, values))
    return law_gives
