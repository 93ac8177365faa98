"""The built-in law as protocols of somebody else, and a network for them: for tests of what protocols are given."""

from typing import Any

import numpy as np

import experiments
from msg_analysis.common.arrays import FloatArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.protocol import Heard, LinearProtocol, Protocol

DIRECTED = {"a": {"arcs": [[1, 2], [2, 3], [3, 4], [4, 5], [5, 1]]}, "b": {"path": [1, 2, 3, 4, 5]}}


def document(protocol: dict[str, Any] | None, **changes: Any) -> dict[str, Any]:
    """Five agents on a line and a weighted ring."""
    run = {"dt": 0.1, "duration": 60, "replicas": 3, "seed": 5, "start": [1, 2, 3, 4, 5]} | changes.pop("run", {})
    ring = {"edges": [[1, 2], [2, 3, 0.5], [3, 4], [4, 5], [5, 1]]}
    default = {
        "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": ring},
        "switching": {"generator": [[-1, 1], [2, -2]]},
    }
    given = {"protocol": protocol} if protocol else {}
    return experiments.document(**default | given | changes, run=run)


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
