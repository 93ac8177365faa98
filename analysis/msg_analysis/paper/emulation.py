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

"""Real networks on the paper's curves: which runs are made, and how their results compare with theory."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.inference.statistics.holm import holm
from msg_analysis.paper import examples
from msg_analysis.paper.examples import CENTRALITY, NODE, SYSTEM
from msg_analysis.sweep.jobs.job import DONE, Job, Outcome
from msg_analysis.sweep.plan import own_seed

DT = 0.025
"""Simulated time of a step: its errors are about 2 % above those of continuous time."""

REPLICAS = 32
DURATION = 100.0
CYCLES = 30
"""Least length of a run, in sums of the mean holding times of all graphs: intervals of shorter runs are unreliable."""

LEVEL = 0.01
"""Probability that any point is said to disagree although all networks follow their law."""


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a network, in lockstep, with ``REPLICAS`` replicas."""

    example: int  # 1, 2 or 3
    network: str  # key of _NETWORKS
    epsilon: float  # [1 / unit of simulated time], scales r12 and r21
    r12: float
    r21: float
    leader: int | None = None  # from 0, held at the reference; None: consensus
    duration: float | None = None  # [units of simulated time]; None: DURATION, or CYCLES if longer

    def job(self) -> Job:
        """The run as a job for a sweep worker."""
        graphs, generator = _NETWORKS[self.network]
        rates = generator(self.epsilon, self.r12, self.r21)
        least = CYCLES * float(np.sum(-1.0 / np.diag(rates)))
        duration = self.duration or DT * round(max(DURATION, least) / DT)
        document: dict[str, Any] = {
            "name": self.network,
            "graphs": graphs,
            "switching": {"generator": rates.tolist()},
            "run": {"dt": DT, "duration": duration, "replicas": REPLICAS},
        }
        if self.leader is not None:
            document |= {"problem": "tracking", "leaders": {"agents": [self.leader + 1], "gain": "inf"}}
        document["run"]["seed"] = own_seed(self.example, document, 0)
        return Job.of("network", document)

    @property
    def quantities(self) -> list[tuple[str, int | None]]:
        """What is drawn of the run: quantity, and agent from 0 (None: the system)."""
        if self.leader is not None:
            return [(CENTRALITY, self.leader)]
        nodes: list[tuple[str, int | None]] = [(NODE, agent) for agent in range(5)]
        if self.example == 3:
            return nodes
        drawn = 1.0 in (self.r12, self.r21) if self.example == 1 else self.epsilon in examples.NODE_SCALES
        return [(SYSTEM, None), *(nodes if drawn else [])]


_NETWORKS: dict[str, tuple[dict[str, Any], examples.Generator]] = {
    "line_ring": (examples.LINE_RING, examples.two_graphs),
    "three_lines": (examples.THREE_LINES, examples.three_graphs),
    "knife_edge": (examples.KNIFE_EDGE, examples.two_graphs),
    "smallest": (examples.SMALLEST, examples.two_graphs),
}


def runs_of(example: int) -> list[Run]:
    """The runs for an example (1, 2 or 3), at rates that the paper's curves go through."""
    if example == 1:
        # Each of these is on one curve over r12 and on one over r21.
        levels = [level for level in examples.LEVELS if level >= 0.5]
        pairs = [(r12, r21) for r12 in levels for r21 in levels] + [(0.1, 1.0), (1.0, 0.1)]
        return [Run(1, "line_ring", 0.5, *pair) for pair in pairs]
    if example == 2:
        swept = {0.5: (0.25, 0.55, 0.9), 1.0: (0.4, 0.8), 5.0: (0.2, 0.6), 10.0: (0.16, 0.5, 0.9)}
        return [Run(2, "three_lines", scale, r12, examples.R2J) for scale, values in swept.items() for r12 in values]
    runs = []
    for network in ("knife_edge", "smallest"):
        runs += [Run(3, network, epsilon, 1.0, 1.0, agent) for epsilon in (0.5, 5.0) for agent in range(5)]
        runs += [Run(3, network, epsilon, 1.0, 1.0) for epsilon in (0.1, 0.5, 2.0, 10.0, 50.0)]
    return runs


@dataclass(frozen=True, slots=True)
class Measured:
    """A measured certainty next to its prediction."""

    run: Run
    quantity: str  # SYSTEM, NODE or CENTRALITY
    agent: int | None  # from 0; None: the system
    value: float  # 1 / E [1 / variance]
    low: float  # to high: the 95 % interval of the value
    high: float
    predicted: float  # exact for the steps of the run
    z: float  # of the error E, like p
    p: float
    p_holm: float = 1.0  # adjusted over all points that were measured together


def measured(runs: Sequence[Run], outcomes: Sequence[Outcome]) -> list[Measured]:
    """The points that are drawn, of all runs that did not fail; Holm's adjustment is over all of them."""
    found = []
    for run, outcome in zip(runs, outcomes, strict=True):
        if outcome.status != DONE:
            continue
        for quantity, agent in run.quantities:
            result = outcome.result
            error = result["node_errors"][agent] if quantity == NODE else result["system_error"]
            low, high = error["interval"]
            numbers = (1.0 / error["measured"], 1.0 / high, 1.0 / low if low > 0 else np.inf, 1.0 / error["predicted"])
            found.append(Measured(run, quantity, agent, *numbers, error["z"], error["p"]))
    if not found:
        return []
    adjusted = holm(np.array([point.p for point in found]))
    return [dataclasses.replace(point, p_holm=float(p)) for point, p in zip(found, adjusted, strict=True)]


COLUMNS = (
    "network",
    "quantity",
    "agent",
    "epsilon [1/time]",
    "r12",
    "r21",
    "value [1/variance]",
    "low",
    "high",
    "predicted",
    "z",
    "p",
    "p_holm",
)


def csv_text(number: int, points: Sequence[Measured]) -> str:
    """The points of one example as CSV: comment lines, a header, a row per point."""
    comments = (
        f"Example {number}: networks of ROS 2 processes in lockstep, dt = {DT:g}, {REPLICAS} replicas, F = I",
        "agent 0 is the system; low to high is the 95 % interval; predicted is exact for the steps of the run",
    )
    rows = [
        (
            *(point.run.network, point.quantity, 0 if point.agent is None else point.agent + 1),
            *(point.run.epsilon, point.run.r12, point.run.r21),
            *(point.value, point.low, point.high, point.predicted, point.z, point.p, point.p_holm),
        )
        for point in points
        if point.run.example == number
    ]
    return examples.commented_csv(comments, COLUMNS, rows)


def summary(points: Sequence[Measured], runs: int, level: float = LEVEL) -> str:
    """One sentence: whether all points agree with theory; ``runs`` is the number of networks."""
    apart = disagreeing(points, level)
    within = np.mean([point.low <= point.predicted <= point.high for point in points])
    least = min(point.p_holm for point in points)
    verdict = f"{len(apart)} disagree with theory" if apart else "all agree with theory"
    return (
        f"{len(points)} points of {runs} networks: {verdict} (Holm over all points, level {level:g}; smallest adjusted "
        f"p {least:.3g}); {100 * within:.0f} % of the 95 % intervals contain the prediction"
    )


def disagreeing(points: Sequence[Measured], level: float = LEVEL) -> list[Measured]:
    """The points whose adjusted p is below ``level``."""
    return [point for point in points if point.p_holm < level]
