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

"""The offline twin: a run without ROS, by the same law and the same random numbers."""

from __future__ import annotations

import math
import secrets
import uuid

import numpy as np

from msg_analysis.common.large_arrays import large_zeros, release
from msg_analysis.model.arithmetic.payload import from_payload, to_payload
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.experiment.protocol_binding import AgentProtocol
from msg_analysis.model.run.agent_law import ProtocolLaw
from msg_analysis.model.run.graph_path import mode_path, sojourns
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.run.trajectory import Completeness, Trajectory
from msg_analysis.model.step.air_reception import add_broadcast_noise, ahead, lost_values, used_steps
from msg_analysis.model.step.step_model import StepMatrices, StepModel, build_model
from msg_analysis.twin.ideal_timers import ideal_log
from msg_analysis.twin.network_steps import states as states_of_all
from msg_analysis.twin.start import draw_start
from msg_analysis.types import FloatArray, IntArray

KEY_SIZE = 32  # bytes


def new_record(experiment: ValidExperiment, run: uuid.UUID | None = None) -> RunRecord:
    """Everything that a new run of an experiment starts from; ``run``: its id, a new random one if not given."""
    model = build_model(experiment)
    start = draw_start(experiment, model, next(sojourns(experiment, model.initial)).mode)
    if experiment.protocol and not isinstance(model, StepModel):
        start = np.array([AgentProtocol(experiment.protocol, i).start(x).ravel() for i, x in enumerate(start)])
    matrices = None
    if isinstance(model, StepModel) and (experiment.time == "discrete" or experiment.protocol):
        matrices = StepMatrices(model.nominal, model.noise_gain)
    record = RunRecord(run or uuid.uuid4(), experiment, start, matrices=matrices, key=secrets.token_bytes(KEY_SIZE))
    record.__dict__["model"] = model  # what this cached property would compute again
    return record


def simulate(experiment: ValidExperiment, *, record: RunRecord | None = None) -> Trajectory:
    """Run an experiment without ROS, or repeat the run of a record (then its experiment is used); see ``api``.

    The states equal those of a network run to the last bit: in lockstep, or with ideal timers and no latency.
    """
    experiment = record.experiment if record else experiment
    experiment.require_available()
    record = record or new_record(experiment)
    model = record.model
    modes = mode_path(experiment, model.initial)
    if isinstance(model, StepModel):
        states, published = _all_at_once(record, model, modes)
    else:
        states, published = _one_by_one(record, modes)
    noise = experiment.noise
    agent_modes = lost = used = made = None
    if experiment.run.pace == "realtime":
        agent_modes, used, made = ideal_log(experiment, model, modes)
    elif noise.delay or noise.holds:
        used = used_steps(experiment, model, modes)
    if experiment.run.pace == "lockstep" and noise.loss.any:
        lost = lost_values(experiment, model, modes)
    expected = states.shape[0] * states.shape[1] * (2 if experiment.truth else 1)
    return Trajectory(
        record,
        states,
        modes,
        Completeness(expected, expected, 0),
        agent_modes,
        published=published,
        lost=lost,
        used=used,
        made=made,
    )


def _all_at_once(record: RunRecord, model: StepModel, modes: IntArray) -> tuple[FloatArray, FloatArray | None]:
    """(N + 1, m, R) states, and what is published of them if that is something else, of a linear law."""
    experiment = record.experiment
    shape = (experiment.steps + 1, *record.start.shape)
    states = large_zeros(shape, np.float64, total=8 * math.prod(shape))
    states[0] = record.start
    known = 1
    for block in states_of_all(experiment, model, modes, record.start):
        states[known : known + len(block)] = block
        known += len(block)
        release(states)
    return states, add_broadcast_noise(experiment, states) if experiment.noise.broadcast else None


def _one_by_one(record: RunRecord, modes: IntArray) -> tuple[FloatArray, FloatArray | None]:
    """The same by the laws of the single agents, one after the other, as the network has them."""
    experiment, model = record.experiment, record.model
    laws = [ProtocolLaw(record, model, i) for i in range(model.agents)]
    neighbours = [[law.neighbours(mode) for mode in range(model.modes)] for law in laws]
    lead = ahead(experiment)
    states = np.empty((experiment.steps + 1, *record.start.shape))
    published = np.empty((experiment.steps + 1, model.agents, experiment.run.replicas))

    def note(k: int, i: int) -> None:
        states[k, i] = from_payload(laws[i].state)
        published[k, i] = from_payload(laws[i].published(k, laws[i].state))

    for i in range(model.agents):
        note(0, i)
    order = np.argsort(lead.sum(axis=1), kind="stable").tolist()
    for k, mode in enumerate(modes.tolist()):
        for i in order:
            senders = neighbours[i][mode]
            used = [laws[i].air.source(j, k + int(lead[i, j])) for j in senders]
            heard = [to_payload(published[step, j]) for step, j in zip(used, senders, strict=True)]
            laws[i].advance(mode, heard, used)
            note(k + 1, i)
    return states, published if experiment.truth else None
