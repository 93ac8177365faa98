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
from collections.abc import Iterable

import numpy as np

from msg_analysis.common.large_arrays import large_zeros, release
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.experiment.protocol_binding import AgentProtocol
from msg_analysis.model.run.graph_path import mode_path, sojourns
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.run.trajectory import Completeness, Trajectory
from msg_analysis.model.step.step_model import StepMatrices, StepModel, build_model
from msg_analysis.twin.ideal_timers import ideal_times
from msg_analysis.twin.run_blocks import RunBlock, run_blocks
from msg_analysis.twin.start import draw_start
from msg_analysis.types import AnyArray

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
    modes = mode_path(experiment, record.model.initial)
    arrays = _whole(run_blocks(record, modes), len(modes))
    states = arrays["states"]
    agent_modes = made = None
    if experiment.run.pace == "realtime":
        agent_modes, made = ideal_times(experiment, modes)
    expected = states.shape[0] * states.shape[1] * (2 if experiment.truth else 1)
    return Trajectory(
        record,
        states,
        modes,
        Completeness(expected, expected, 0),
        agent_modes,
        published=arrays.get("published"),
        lost=arrays.get("lost"),
        used=arrays.get("used"),
        made=made,
    )


def _whole(blocks: Iterable[RunBlock], steps: int) -> dict[str, AnyArray]:
    """The arrays of ``Trajectory`` of a run of so many steps, by name, from its blocks."""
    length = {"states": steps + 1, "published": steps + 1, "lost": steps, "used": steps}
    arrays: dict[str, AnyArray] = {}
    for block in blocks:
        parts = {name: getattr(block, name) for name in length if getattr(block, name) is not None}
        if not arrays:
            total = sum(length[name] * part[0].nbytes for name, part in parts.items())
            for name, part in parts.items():
                arrays[name] = large_zeros((length[name], *part.shape[1:]), part.dtype, total=total)
        for name, part in parts.items():
            arrays[name][block.first : block.first + len(part)] = part
            release(arrays[name])
    return arrays
