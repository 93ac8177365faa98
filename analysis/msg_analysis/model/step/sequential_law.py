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

"""Agents that step one after the other: what a period of a run in real time does when no agent is late.

With g the graph of the period, an agent uses the new states of the agents that are due before it and the old states of
the others. Row by row, in the order of the phases,

    A_i = W_ii e_i + sum_earlier W_ij A_j + sum_later W_ij e_j,    B_i = F_i + sum_earlier W_ij B_j,

and offsets like B. Rows of A sum to 1 where those of W do, so consensus stays consensus; but A is not symmetric.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal

import numpy as np

from msg_analysis.model.step.phases import phases
from msg_analysis.model.step.step_model import StepModel, build_step_model
from msg_analysis.types import FloatArray, IntArray

if TYPE_CHECKING:
    from msg_analysis.model.experiment.experiment import ValidExperiment

StepLaw = Literal["synchronous", "sequential"]


def step_law(experiment: ValidExperiment) -> StepLaw:
    """Whether the agents of a run step all at once (lockstep) or one after the other (real time)."""
    return "sequential" if experiment.run.pace == "realtime" else "synchronous"


def build_run_model(experiment: ValidExperiment, step: StepModel | None = None) -> StepModel:
    """What a step of all agents of a run with a linear law does to x(k), as one jump linear system.

    In real time the law is sequential: noise of an agent reaches those that are due later. With messages that are
    noisy, late or lost, the micro-steps stay apart (``turns``). ``step``: the model of the experiment, if it is known.
    """
    step = step or build_step_model(experiment)
    if step_law(experiment) == "synchronous":
        return step
    phase = phases(experiment)
    if experiment.noise.steps_only:
        return dataclasses.replace(step, turns=np.argsort(phase))
    return sequential(step, phase)


def sequential(step: StepModel, phase: FloatArray) -> StepModel:
    """The agents' micro-steps of one period, in the order of their phases (m,), all different, as one step.

    ``step`` is the synchronous step, without loss, delay or noise on the air.
    """
    weights, offsets, gain = np.empty_like(step.weights), np.empty_like(step.offsets), np.empty_like(step.noise_gain)
    done = np.zeros(step.agents, dtype=bool)
    for i in np.argsort(phase).tolist():
        row = step.nominal[:, i]
        new = row * done
        weights[:, i] = (row - new) + np.einsum("nj,njk->nk", new[:, done], weights[:, done])
        gain[:, i] = step.noise_gain[:, i] + np.einsum("nj,njk->nk", new[:, done], gain[:, done])
        offsets[:, i] = step.offsets[:, i] + np.einsum("nj,nj->n", new[:, done], offsets[:, done])
        done[i] = True
    return dataclasses.replace(
        step,
        weights=weights,
        nominal=weights,
        offsets=offsets,
        noise_gain=gain,
        noise=gain @ gain.transpose(0, 2, 1),
    )


def ideal_uses(model: StepModel, phase: FloatArray) -> IntArray:
    """(n, m, D) how many steps after x_i(k) the value of the d-th neighbour of agent i is, with ideal timers.

    1 for neighbours that are due earlier in the period, 0 for others; -1 where there is no d-th neighbour.
    """
    ahead = np.full((model.modes, model.agents, model.most_neighbours), -1, dtype=np.int64)
    for mode in range(model.modes):
        for i in range(model.agents):
            neighbours = model.neighbours(mode, i)
            ahead[mode, i, : len(neighbours)] = phase[neighbours] < phase[i]
    return ahead
