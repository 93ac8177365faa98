"""A small run, and rosbags as the independent judge of bytes and bags."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from msg_analysis.model.experiment import Experiment
from msg_analysis.model.record import RunRecord
from msg_analysis.model.trajectory import Completeness, Trajectory

ROOT = Path(__file__).parents[3]
INTERFACES = ROOT / "ros_ws" / "src" / "msg_agents_interfaces" / "msg"


@pytest.fixture(scope="session")
def typestore() -> Any:
    """Jazzy's types and ours, from the .msg files of the ROS package."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for file in sorted(INTERFACES.glob("*.msg")):
        store.register(get_types_from_msg(file.read_text(), f"msg_agents_interfaces/msg/{file.stem}"))
    return store


@pytest.fixture
def make_run() -> Callable[..., Trajectory]:
    """A trajectory with random states; no theory in it."""

    def make(agents: int = 3, steps: int = 40, replicas: int = 2, seed: int = 0, name: str = "small") -> Trajectory:
        everybody = list(range(1, agents + 1))
        experiment = Experiment.parse(
            {
                "name": name,
                "problem": "consensus",
                "time": "continuous",
                "graphs": {"line": {"path": everybody}, "star": {"star": {"center": 1}}},
                "agents": agents,
                "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
                "run": {"dt": 0.05, "duration": steps * 0.05, "replicas": replicas, "start": "zero"},
            }
        )
        rng = np.random.default_rng(seed)
        states = rng.standard_normal((steps + 1, agents, replicas))
        modes = np.repeat(rng.integers(0, 2, steps // 4 + 1), 4)[:steps]
        record = RunRecord(uuid.UUID(int=rng.integers(1, 2**62).item()), experiment, states[0])
        expected = (steps + 1) * agents
        return Trajectory(record, states, modes, Completeness(expected, expected, 0))

    return make
