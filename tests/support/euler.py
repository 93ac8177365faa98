"""The built-in law as protocols of somebody else, and a network for them: for tests of what protocols are given."""

from __future__ import annotations

from typing import Any

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.protocol import Heard, LinearProtocol, Protocol

DIRECTED = {"a": {"arcs": [[1, 2], [2, 3], [3, 4], [4, 5], [5, 1]]}, "b": {"path": [1, 2, 3, 4, 5]}}


def document(protocol: dict[str, Any] | None, **changes: Any) -> dict[str, Any]:
    """Five agents on a line and a ring; ``run`` is merged, other keys are replaced."""
    run = {"dt": 0.1, "duration": 60, "replicas": 3, "seed": 5, "start": [1, 2, 3, 4, 5]} | changes.pop("run", {})
    return {
        "name": "net",
        "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"edges": [[1, 2], [2, 3, 0.5], [3, 4], [4, 5], [5, 1]]}},
        "switching": {"generator": [[-1, 1], [2, -2]]},
        **({"protocol": protocol} if protocol else {}),
        **changes,
        "run": run,
    }


def experiment(protocol: dict[str, Any] | None, **changes: Any) -> Experiment:
    return Experiment.parse(document(protocol, **changes))


class Euler(LinearProtocol):
    """The built-in law, declared."""

    def weights(self, mode: int) -> FloatArray:
        return np.eye(self.network.agents) - self.network.dt * self.network.graphs[mode].laplacian


class EulerSteps(Protocol):
    """The built-in law, step by step."""

    tracking = True

    def step(self, k: int, mode: int, state: FloatArray, heard: Heard, noise: FloatArray) -> FloatArray:
        gain = self.network.leader_gains[self.agent]
        pull = heard.weighted_sum(heard.values - state[0]) + gain * (self.network.reference - state[0])
        return state + self.network.dt * pull + noise
