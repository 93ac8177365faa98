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
from msg_analysis.model.step.air import NOTHING
from msg_analysis.types import FloatArray


def replay(trajectory: Trajectory) -> tuple[FloatArray, FloatArray | None]:
    """What the law gives from the logged inputs of every step: ``states`` and ``published``; NaN where inputs miss.

    By induction, a log in real time that equals this from x(0) on is what the law gives for the start, the seed, and
    the values that the agents used. ValueError: the log does not have these (a run in lockstep).
    """
    used, modes = trajectory.used, trajectory.agent_modes
    if used is None or modes is None or trajectory.made is None:
        raise ValueError("a run in lockstep: its twin is `simulate`")
    record, states = trajectory.record, trajectory.states
    model = record.model
    heard_of = states if trajectory.published is None else trajectory.published
    there = np.asarray(~np.isnan(states).any(axis=2))
    readable = np.asarray(~np.isnan(heard_of).any(axis=2))
    law_gives = np.full_like(states, np.nan)
    law_gives[0] = record.start
    published = None if trajectory.published is None else np.full_like(heard_of, np.nan)
    for i in range(model.agents):
        law = agent_law(record, model, i)
        neighbours = [law.neighbours(mode) for mode in range(model.modes)]
        if published is not None:
            for k in np.flatnonzero(there[:, i]).tolist():
                published[k, i] = from_payload(law.published(k, to_payload(states[k, i])))
        for k in range(len(used)):
            mode = int(modes[k + 1, i])
            if mode < 0 or not there[k, i]:
                continue
            senders = neighbours[mode]
            steps = used[k, i, : len(senders)].tolist()
            if not all(step == NOTHING or readable[step, j] for step, j in zip(steps, senders, strict=True)):
                continue
            if law.step != k:
                law.resume(k, to_payload(states[k, i]))
            law.state = to_payload(states[k, i])
            values = [to_payload(heard_of[max(step, 0), j]) for step, j in zip(steps, senders, strict=True)]
            law_gives[k + 1, i] = from_payload(law.advance(mode, values, steps))
    return law_gives, published
