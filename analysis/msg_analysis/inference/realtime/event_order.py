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

"""Order of the steps of a run in real time, and the state of the network at the sampling times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_analysis.inference.observed.observation import Observation, Timers
from msg_analysis.model.arithmetic.step_clock import StepClock
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class EventOrder:
    """The steps of all agents as one sequence of events."""

    position: IntArray  # (N, m) place of the event in which agent i makes x_i(k+1)
    contradiction: str | None  # why the times in the log contradict cause and effect; None where they do not


def order_events(observation: Observation) -> EventOrder:
    """Order the events of a run in real time by time; at equal times, a value comes before the steps that use it.

    Equal times are common where the agents' clock moves in jumps, and when a late agent catches up.
    """
    timers = _timers(observation)
    made = timers.made
    senders = neighbour_tables(observation.step).senders[timers.graphs, np.arange(made.shape[1])]
    heard = np.where(timers.used >= 0, made[timers.used, senders], np.int64(-1))
    after = made[1:]
    early = np.argwhere(heard > after[:, :, None])
    contradiction = None
    if len(early):
        k, i, d = early[0].tolist()
        contradiction = (
            f"in step {k} agent {i + 1} used a value that agent {senders[k, i, d] + 1} computed "
            f"{(heard[k, i, d] - after[k, i]) / 1e9:.3g} units of time later ({len(early)} such cases): their clocks "
            "disagree"
        )
    elif (np.diff(made, axis=0) < 0).any() or (after <= 0).any():
        contradiction = "the times of an agent's states decrease: its clock was set back"
    own = np.argwhere(after == made[:-1])
    own = own[own[:, 0] > 0]
    others = np.argwhere((heard == after[:, :, None]) & (timers.used > 0))
    k, i, d = others.T
    m = made.shape[1]
    target = np.concatenate([own, others[:, :2]]) @ [m, 1] + m
    source = np.concatenate([own[:, 0] * m + own[:, 1], timers.used[k, i, d] * m + senders[k, i, d]])
    turn, circular = _turns(source, target, made.size)
    if circular:
        contradiction = contradiction or "agents used new values of each other at the same time"
    level = turn.reshape(made.shape)
    agents = np.tile(np.arange(made.shape[1]), len(after))
    steps = np.repeat(np.arange(len(after)), made.shape[1])
    order = np.lexsort((agents, steps, level[1:].ravel(), after.ravel()))
    position = np.empty(len(order), dtype=np.int64)
    position[order] = np.arange(len(order))
    return EventOrder(position.reshape(after.shape), contradiction)


def _turns(source: IntArray, target: IntArray, count: int) -> tuple[IntArray, bool]:
    """A place for each of ``count`` items, every source before its target; and whether there is a cycle."""
    turn = np.zeros(count, dtype=np.int64)
    order = np.argsort(source, kind="stable")
    ends = np.searchsorted(source[order], np.arange(count + 1)).tolist()
    targets = target[order].tolist()
    waits_for = np.bincount(target, minlength=count)
    ready = np.setdiff1d(source, target).tolist()
    waiting = waits_for.tolist()
    for one in ready:  # grows during the loop
        for other in targets[ends[one] : ends[one + 1]]:
            waiting[other] -= 1
            if not waiting[other]:
                ready.append(other)
    turn[ready] = np.arange(1, len(ready) + 1)
    return turn, any(waiting)


def newest_steps(observation: Observation) -> IntArray:
    """(N + 1, m): step of each agent's newest state that was made at simulated time <= k dt."""
    made = np.maximum.accumulate(_timers(observation).made, axis=0)
    times = sampling_times(observation)
    newest = [np.searchsorted(made[:, i], times, side="right") - 1 for i in range(made.shape[1])]
    return np.stack(newest, axis=1)


def sampled(observation: Observation) -> FloatArray:
    """(N + 1, m, R): the newest states at simulated time k dt, which are compared in real time."""
    return np.asarray(observation.states[newest_steps(observation), np.arange(observation.step.agents)])


def sampling_times(observation: Observation) -> IntArray:
    """(N + 1,): k dt [ns of simulated time]."""
    return StepClock(observation.step.dt).times(np.arange(observation.steps + 1))


def _timers(observation: Observation) -> Timers:
    assert observation.timers is not None
    return observation.timers
