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

import secrets
import uuid

import numpy as np

from msg_analysis.model.arithmetic.payload import from_payload
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.experiment.protocol_binding import AgentProtocol
from msg_analysis.model.run.agent_law import ProtocolLaw
from msg_analysis.model.run.graph_path import mode_path
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.run.trajectory import Completeness, Trajectory
from msg_analysis.model.step.air import LOST
from msg_analysis.model.step.air_reception import AirReception
from msg_analysis.model.step.step_model import StepMatrices, StepModel, build_model
from msg_analysis.twin.ideal_timers import ideal_log
from msg_analysis.twin.network_steps import states as states_of_all
from msg_analysis.twin.start import draw_start
from msg_analysis.types import BoolArray

KEY_SIZE = 32  # bytes


def new_record(experiment: ValidExperiment, run: uuid.UUID | None = None) -> RunRecord:
    """Everything that a new run of an experiment starts from; ``run``: its id, a new random one if not given."""
    model = build_model(experiment)
    modes = mode_path(experiment, model.initial)
    start = draw_start(experiment, model, int(modes[0]))
    if experiment.protocol and not isinstance(model, StepModel):
        start = np.array([AgentProtocol(experiment.protocol, i).start(x).ravel() for i, x in enumerate(start)])
    matrices = None
    if isinstance(model, StepModel) and (experiment.time == "discrete" or experiment.protocol):
        matrices = StepMatrices(model.nominal, model.noise_gain)
    return RunRecord(run or uuid.uuid4(), experiment, start, matrices=matrices, key=secrets.token_bytes(KEY_SIZE))


def simulate(experiment: ValidExperiment, *, record: RunRecord | None = None) -> Trajectory:
    """Run an experiment without ROS, or repeat the run of a record (then its experiment is used); see ``api``.

    The states equal those of a network run to the last bit: in lockstep, or with ideal timers and no delay.
    """
    experiment = record.experiment if record else experiment
    experiment.require_available()
    record = record or new_record(experiment)
    if experiment.protocol and not experiment.protocol.linear:
        return _simulate_agents(record)
    model = record.step_model
    modes = mode_path(experiment, model.initial)
    states = np.empty((experiment.steps + 1, *record.start.shape))
    states[0] = record.start
    reception = AirReception(experiment, model, experiment.steps) if experiment.noise.on_air else None
    known = 1
    for block in states_of_all(experiment, model, modes, record.start, reception=reception):
        states[known : known + len(block)] = block
        known += len(block)
    if experiment.run.pace == "realtime":
        agent_modes, used, made = ideal_log(experiment, model, modes)
        whole = Completeness(states.shape[0] * states.shape[1], states.shape[0] * states.shape[1], 0)
        return Trajectory(record, states, modes, whole, agent_modes, used=used, made=made)
    published, lost = reception.log(states[-1], modes) if reception else (None, None)
    expected = states.shape[0] * states.shape[1] * (1 if published is None else 2)
    return Trajectory(record, states, modes, Completeness(expected, expected, 0), published=published, lost=lost)


def _simulate_agents(record: RunRecord) -> Trajectory:
    """The same by the laws of the single agents, one after the other, as the network has them."""
    experiment, model, agents = record.experiment, record.model, range(record.model.agents)
    modes = mode_path(experiment, model.initial)
    laws = [ProtocolLaw(record, model, i) for i in agents]
    neighbours = [[law.neighbours(mode) for mode in range(model.modes)] for law in laws]
    states = np.empty((experiment.steps + 1, *record.start.shape))
    published = np.empty((experiment.steps + 1, model.agents, experiment.run.replicas))
    lost: BoolArray = np.zeros((experiment.steps, model.agents, model.most_neighbours), dtype=np.bool_)
    for k in range(experiment.steps + 1):
        values = [law.published(k, law.state) for law in laws]
        for i, law in enumerate(laws):
            states[k, i], published[k, i] = from_payload(law.state), from_payload(values[i])
        if k == experiment.steps:
            break
        mode = int(modes[k])
        for i, law in enumerate(laws):
            law.advance(mode, [values[j] for j in neighbours[i][mode]])
            lost[k, i, : len(law.heard)] = [step == LOST for step in law.heard]
    expected = states.shape[0] * states.shape[1] * (2 if experiment.truth else 1)
    return Trajectory(
        record,
        states,
        modes,
        Completeness(expected, expected, 0),
        published=published if experiment.truth else None,
        lost=lost if experiment.noise.loss.any else None,
    )
