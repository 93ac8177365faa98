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

"""The bit-for-bit check: whether a bag holds exactly what the law and the seed give."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from msg_analysis.common.large_arrays import pieces, release
from msg_analysis.model.run.graph_path import mode_path
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.model.step.air_reception import lost_messages
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.twin.log_replay import replay
from msg_analysis.twin.simulate import simulate
from msg_analysis.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Check:
    """Result of ``check``.

    Attributes
    ----------
    compared
        states that were compared; where the run logs both exact and published states, both count
    missing
        what could not be compared: states that are not in the bag or, in real time, without all their inputs; steps
        whose graph is not in the bag
    difference
        the first difference in words (lowest step, then lowest agent; agents from 1), or None
    """

    compared: int
    missing: int
    difference: str | None


def check(trajectory: Trajectory) -> Check:
    """Compute a run again with the offline twin, and compare every state, lost message and graph bit for bit.

    In lockstep the twin needs only the run record. In real time it also takes from the log which values every agent
    used in every step, and no value may be used before it was made, according to the stamps.

    Parameters
    ----------
    trajectory
        the run, as read from its bag

    Raises
    ------
    NotAvailableError
        the twin cannot repeat a run of this kind
    """
    if trajectory.record.experiment.run.pace == "realtime":
        return _check_realtime(trajectory)
    twin = simulate(trajectory.record.experiment, record=trajectory.record)
    # The states of step k follow from graphs and losses of earlier steps: the earliest difference is the cause.
    found = [
        _first_state(trajectory, trajectory.states, twin.states, "logged"),
        _first_state(trajectory, trajectory.published, twin.published, "published"),
        _first_loss(trajectory, twin),
        _first_use(trajectory, twin),
        _first_graph(trajectory, twin.modes),
    ]
    count = trajectory.completeness
    return Check(count.received, count.missing + count.missing_modes, _earliest(found))


def _check_realtime(trajectory: Trajectory) -> Check:
    experiment = trajectory.record.experiment
    law, published = replay(trajectory)
    path = mode_path(experiment, trajectory.record.model.initial)
    found = [
        _first_state(trajectory, trajectory.states, law, "logged"),
        _first_state(trajectory, trajectory.published, published, "published"),
        _first_early_use(trajectory),
        _first_lost_use(trajectory),
        _first_graph(trajectory, path),
    ]
    compared = int((trajectory.present & ~np.isnan(law).any(axis=2)).sum())
    if published is not None and trajectory.published is not None:
        compared += int((~np.isnan(published) & ~np.isnan(trajectory.published)).all(axis=2).sum())
    count = trajectory.completeness
    return Check(compared, count.expected - compared + count.missing_modes, _earliest(found))


def _earliest(found: Sequence[tuple[float, str] | None]) -> str | None:
    """The earliest of some (step, words), without the step."""
    differences = [difference for difference in found if difference is not None]
    return min(differences, key=lambda difference: difference[0])[1] if differences else None


def _first_graph(trajectory: Trajectory, modes: IntArray) -> tuple[float, str] | None:
    graphs = [graph.name for graph in trajectory.record.experiment.graph_list]
    return _first(
        (trajectory.modes >= 0) & (trajectory.modes != modes),
        lambda step: (
            f"graph of step {step}: logged {graphs[trajectory.modes[step]]}, the seed gives {graphs[modes[step]]}"
        ),
    )


def _first_early_use(trajectory: Trajectory) -> tuple[float, str] | None:
    """The first value that was used in a state made before it, or at the same time."""
    used, made, modes = trajectory.used, trajectory.made, trajectory.agent_modes
    assert used is not None
    assert made is not None
    assert modes is not None
    model = trajectory.record.model
    # Where a state is missing its mode is -1, which picks the last graph: harmless, since ``used`` is -1 there too.
    sender = neighbour_tables(model).senders[modes[1:], np.arange(model.agents)]
    early = (used >= 0) & (made[1:] >= 0)[:, :, None] & (made[used, sender] >= made[1:, :, None])

    def describe(step: int, agent: int, which: int) -> str:
        return (
            f"agent {agent + 1} at step {step + 1}: stamped {made[step + 1, agent] / 1e9} s of simulated time, and "
            f"used step {used[step, agent, which]} of agent {sender[step, agent, which] + 1}, stamped "
            f"{made[used[step, agent, which], sender[step, agent, which]] / 1e9} s"
        )

    found = _first(early, describe)
    return found and (found[0] + 1, found[1])


def _first(wrong: BoolArray, describe: Callable[..., str]) -> tuple[float, str] | None:
    """Step (first index) and description of the first True entry; None if there is none."""
    if not wrong.any():
        return None
    where = [int(i) for i in np.argwhere(wrong)[0]]
    return where[0], describe(*where)


def _first_state(
    trajectory: Trajectory, logged: FloatArray | None, law: FloatArray | None, what: str
) -> tuple[float, str] | None:
    if logged is None or law is None:
        return None

    def describe(step: int, agent: int) -> str:
        here, expected = logged[step, agent], law[step, agent]
        where = int(np.argmax(here != expected))
        row, replica = divmod(where, trajectory.record.experiment.run.replicas)
        number = f", number {row + 1} of the state" if row else ""
        return (
            f"agent {agent + 1} at step {step}, replica {replica + 1}{number}: {what} {float(here[where])!r}, "
            f"the law gives {float(expected[where])!r}"
        )

    for piece in pieces(logged):
        here, expected = logged[piece], law[piece]
        there = ~(np.isnan(here) | np.isnan(expected)).any(axis=2)
        wrong = np.argwhere(there & (here != expected).any(axis=2))
        release(law)
        if len(wrong):
            step, agent = piece.start + int(wrong[0, 0]), int(wrong[0, 1])
            return step, describe(step, agent)
    return None


def _first_loss(trajectory: Trajectory, twin: Trajectory) -> tuple[float, str] | None:
    if trajectory.lost is None or twin.lost is None or trajectory.agent_modes is None:
        return None
    model = trajectory.record.model
    # Only states that are there and used the right graph: under another one the neighbours differ.
    comparable = trajectory.agent_modes[1:] == twin.modes[:, None]
    logged, law = trajectory.lost, twin.lost

    def describe(step: int, agent: int, which: int) -> str:
        sender = int(model.neighbours(int(twin.modes[step]), agent)[which]) + 1
        words = ("heard", "lost")
        return (
            f"the message of agent {sender} to agent {agent + 1} in step {step}: logged as "
            f"{words[int(logged[step, agent, which])]}, the seed gives {words[int(law[step, agent, which])]}"
        )

    # After the graph of this step, before the states of the next one.
    found = _first(comparable[:, :, None] & (logged != law), describe)
    return found and (found[0] + 0.5, found[1])


def _first_use(trajectory: Trajectory, twin: Trajectory) -> tuple[float, str] | None:
    """In lockstep, where values of several steps can be used: the first that is not the one which the seed gives."""
    if trajectory.used is None or twin.used is None or trajectory.agent_modes is None:
        return None
    logged, law = trajectory.used, twin.used
    comparable = (trajectory.agent_modes[1:] == twin.modes[:, None])[:, :, None] & (logged >= 0) & (law >= 0)

    def describe(step: int, agent: int, which: int) -> str:
        sender = int(trajectory.record.model.neighbours(int(twin.modes[step]), agent)[which]) + 1
        return (
            f"the value of agent {sender} that agent {agent + 1} used in step {step}: logged as that of step "
            f"{logged[step, agent, which]}, the seed gives step {law[step, agent, which]}"
        )

    found = _first(comparable & (logged != law), describe)
    return found and (found[0] + 0.5, found[1])


def _first_lost_use(trajectory: Trajectory) -> tuple[float, str] | None:
    """In real time: the first message that was used although it was lost."""
    experiment, used, modes = trajectory.record.experiment, trajectory.used, trajectory.agent_modes
    if not experiment.noise.loss.any:
        return None
    assert used is not None
    assert modes is not None
    model, lost = trajectory.record.model, np.zeros(used.shape, dtype=np.bool_)
    senders = neighbour_tables(model).senders[modes[1:], np.arange(model.agents)]
    for i, j in np.argwhere(model.listens()).tolist():
        gone = lost_messages(experiment, i, j, len(used) + 1)
        at = (senders[:, i] == j) & (used[:, i] >= 0)
        lost[:, i] |= at & gone[used[:, i]]

    def describe(step: int, agent: int, which: int) -> str:
        return (
            f"agent {agent + 1} at step {step + 1}: used the message with step {used[step, agent, which]} of agent "
            f"{senders[step, agent, which] + 1}, which the seed loses"
        )

    found = _first(lost, describe)
    return found and (found[0] + 1, found[1])
