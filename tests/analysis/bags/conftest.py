"""A small run; rosbags parses what stands in every bag of ours once."""

from __future__ import annotations

import functools
import uuid
from collections.abc import Callable

import numpy as np
import pytest
from rosbags.highlevel import anyreader
from rosbags.rosbag2 import storage_mcap

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run import Completeness, Run
from msg_analysis.model.run_record import RunRecord

_QOS = functools.cache(storage_mcap.get_qos)
_TYPES = functools.cache(anyreader.get_types_from_msg)


@pytest.fixture(autouse=True)
def _parsed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each text of a quality of service or a definition: most of the time of rosbags, and of hundreds of small bags."""
    monkeypatch.setattr(storage_mcap, "get_qos", _QOS)
    monkeypatch.setattr(anyreader, "get_types_from_msg", _TYPES)


@pytest.fixture
def make_run() -> Callable[..., Run]:
    """A trajectory with random states; no theory in it."""

    def make(agents: int = 3, steps: int = 40, replicas: int = 2, seed: int = 0, name: str = "small") -> Run:
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
        return Run(record, states, modes, Completeness(expected, expected, 0))

    return make
