"""A small run; rosbags parses what stands in every bag of ours once."""

import functools
import uuid
from collections.abc import Callable

import numpy as np
import pytest
from rosbags.highlevel import anyreader
from rosbags.rosbag2 import storage_mcap

from experiments import Completeness, Run, RunRecord, line_ring

_QOS = functools.cache(storage_mcap.get_qos)
_TYPES = functools.cache(anyreader.get_types_from_msg)


@pytest.fixture(autouse=True)
def _parsed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each text of a quality of service or a definition: most of the time of rosbags, and of hundreds of small bags."""
    monkeypatch.setattr(storage_mcap, "get_qos", _QOS)
    monkeypatch.setattr(anyreader, "get_types_from_msg", _TYPES)


@pytest.fixture(scope="session")
def make_run() -> Callable[..., Run]:
    """A trajectory with random states; no theory in it."""

    def make(agents: int = 3, steps: int = 40, replicas: int = 2, seed: int = 0, name: str = "small") -> Run:
        graphs = {"line": {"path": list(range(1, agents + 1))}, "star": {"star": {"center": 1}}}
        run = {"duration": steps * 0.05, "replicas": replicas, "start": "zero"}
        experiment = line_ring(agents, 0.5, name=name, graphs=graphs, agents=agents, run=run)
        rng = np.random.default_rng(seed)
        states = rng.standard_normal((steps + 1, agents, replicas))
        modes = np.repeat(rng.integers(0, 2, steps // 4 + 1), 4)[:steps]
        record = RunRecord(uuid.UUID(int=rng.integers(1, 2**62).item()), experiment, states[0])
        expected = (steps + 1) * agents
        return Run(record, states, modes, Completeness(expected, expected, 0))

    return make
