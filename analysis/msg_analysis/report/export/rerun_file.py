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

"""Recordings for the viewer Rerun, whose library need not be installed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from msg_analysis.common.large_arrays import BLOCK_NUMBERS, release
from msg_analysis.common.long_work import tell
from msg_analysis.common.text.agent_names import agent_name
from msg_analysis.errors import NotAvailableError
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.report.export.run_tables import square_errors


def require_rerun() -> Any:
    """The library. NotAvailableError: it is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise NotAvailableError(
            "--rrd: rerun-sdk is not installed: expected it for recordings of Rerun: pip install rerun-sdk"
        ) from error
    return rerun


def write_recording(trajectory: Trajectory, file: Path, shown: str) -> None:
    """States, errors and graphs over the timelines ``step`` and ``time``; what is missing is left out."""
    rerun, experiment = require_rerun(), trajectory.record.experiment
    recording = rerun.RecordingStream(f"msg_analysis_{experiment.name}", recording_id=str(trajectory.record.run))
    recording.save(file)
    names = [agent_name(agent, experiment.names) for agent in range(1, experiment.agents + 1)]
    length = max(1, BLOCK_NUMBERS // max(1, trajectory.states[:1].size))
    for first in range(0, len(trajectory.states), length):
        end = min(first + length, len(trajectory.states))
        tell(f"writing {shown}", end, len(trajectory.states))
        values, errors = trajectory.values[first:end], square_errors(trajectory, first, end)
        for agent, name in enumerate(names):
            _send(rerun, recording, experiment.step_length, ("states", name), first, values[:, agent])
            _send(rerun, recording, experiment.step_length, ("errors", name), first, errors[:, agent, None])
        _send(rerun, recording, experiment.step_length, ("system_error",), first, errors.sum(axis=1)[:, None])
        release(trajectory.states)
    _send_graphs(rerun, recording, trajectory, names)
    recording.flush()
    recording.disconnect()


def _send(rerun: Any, recording: Any, dt: float, path: tuple[str, ...], first: int, values: Any) -> None:
    """Numbers (steps, k) of the steps from ``first`` on, those without gaps."""
    there = ~np.isnan(values).any(axis=1)
    steps, values = first + np.flatnonzero(there), values[there]
    if len(steps):
        index = [rerun.TimeColumn("step", sequence=steps), rerun.TimeColumn("time", duration=steps * dt)]
        columns = rerun.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(steps))
        recording.send_columns(rerun.new_entity_path(path), indexes=index, columns=[*columns])


def _send_graphs(rerun: Any, recording: Any, trajectory: Trajectory, names: list[str]) -> None:
    """The number of the graph, and its links, whenever it changes."""
    experiment, modes = trajectory.record.experiment, trajectory.modes
    recording.log("network", rerun.GraphNodes(node_ids=names, labels=names), static=True)
    links = [
        rerun.GraphEdges(
            edges=[(names[a - 1], names[b - 1]) for a, b, _ in (graph.edges if graph.symmetric else graph.arcs)],
            graph_type="undirected" if graph.symmetric else "directed",
        )
        for graph in experiment.graph_list
    ]
    for step in np.flatnonzero(np.diff(modes, prepend=-2)).tolist():
        if modes[step] >= 0:
            recording.set_time("step", sequence=step)
            recording.set_time("time", duration=step * experiment.step_length)
            recording.log("graph", rerun.Scalars(float(modes[step] + 1)))
            recording.log("network", links[modes[step]])
