# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The bit-for-bit check: whether a bag holds exactly what the law and the seed give."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from msg_analysis.arithmetic.reproducible import SECOND, StepClock
from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.common.resources import tell
from msg_analysis.errors import NotAvailableError
from msg_analysis.model.graph_path import mode_path
from msg_analysis.model.reception import Air, by_sender_and_block, neighbour_tables
from msg_analysis.model.run import Run
from msg_analysis.twin.log_replay import replay
from msg_analysis.twin.simulate import RunBlock, run_blocks


@dataclass(frozen=True, slots=True)
class Check:
    """Result of ``check``."""

    compared: int  # states; where the run logs both exact and published states, both count
    # States that are not in the bag or, in real time, without all their inputs; steps whose graph is not in the bag.
    missing: int
    difference: str | None  # the first one in words (lowest step, then lowest agent; agents from 1)


def check(trajectory: Run) -> Check:
    """Compute a run again with the offline twin, and compare every state, lost message and graph bit for bit.

    In lockstep the twin needs only the run record, and every state has the stamp of its step. In real time it also
    takes from the log which values every agent used in every step, and no value may be used before it was made, by the
    stamps. States of external agents are not compared.

    Parameters
    ----------
    trajectory
        the run, as read from its bag

    Raises
    ------
    NotAvailableError
        the twin cannot repeat a run of this kind, such as one in lockstep with external agents
    """
    record, count = trajectory.record, trajectory.completeness
    path = mode_path(record.experiment, record.model.initial)
    if record.experiment.run.pace == "realtime":
        difference, compared = _in_real_time(trajectory, path)
        agents = record.experiment.agents
        expected = count.expected * (agents - len(record.experiment.external)) // agents
        return Check(compared, expected - compared + count.missing_modes, difference)
    record.experiment.require_available()
    if record.experiment.external:
        raise NotAvailableError(
            "run.external: the states of a run in lockstep follow from those of its external agents, which the twin "
            "cannot compute"
        )
    return Check(count.received, count.missing + count.missing_modes, _in_lockstep(trajectory, path))


_Found = tuple[float, str] | None
"""When the cause of a difference was there, a step, and the difference in words."""


def _in_lockstep(trajectory: Run, path: IntArray) -> str | None:
    """The first difference: states follow from graphs and losses of earlier steps; the earliest is the cause."""
    for block in _with_progress(trajectory, run_blocks(trajectory.record, path)):
        found = [
            *(_first_state(trajectory, block.first, *states) for states in _states(trajectory, block)),
            *_first_messages(trajectory, block, path),
            _first_stamp(trajectory, block),
            _first_graph(trajectory, block, path),
        ]
        if difference := _earliest(found):
            return difference
    return None


def _in_real_time(trajectory: Run, path: IntArray) -> tuple[str | None, int]:
    """The first difference, and how many states could be compared."""
    difference, compared, air = None, 0, Air(trajectory.record.experiment)
    for block in _with_progress(trajectory, replay(trajectory)):
        both = _states(trajectory, block)
        compared += sum(int((~np.isnan(logged) & ~np.isnan(law)).all(axis=2).sum()) for _, logged, law in both)
        if difference is None:
            uses = _uses(trajectory, block)
            found = [
                *(_first_state(trajectory, block.first, *states) for states in both),
                _first_early_use(trajectory, *uses),
                _first_lost_use(air, *uses),
                _first_graph(trajectory, block, path),
            ]
            difference = _earliest(found)
    return difference, compared


def _states(trajectory: Run, block: RunBlock) -> list[tuple[str, FloatArray, FloatArray]]:
    """What is compared of states: a word for it, the logged ones of the block's steps, and those of the law."""
    arrays = ("logged", trajectory.states, block.states), ("published", trajectory.published, block.published)
    external = sorted(trajectory.record.experiment.external)
    found = []
    for word, log, law in arrays:
        if log is not None and law is not None:
            known = law.copy() if external else law
            known[:, external] = np.nan
            found.append((word, log[block.steps], known))
    return found


def _with_progress(trajectory: Run, blocks: Iterable[RunBlock]) -> Iterable[RunBlock]:
    """The blocks; the memory of what was read of the log is given back after each."""
    for block in blocks:
        tell("comparing with the twin", block.first, len(trajectory.states))
        yield block
        trajectory.release()


def _earliest(found: Iterable[_Found]) -> str | None:
    """The earliest difference in words."""
    differences = [difference for difference in found if difference is not None]
    return min(differences, key=lambda difference: difference[0])[1] if differences else None


def _first(wrong: BoolArray, when: float, describe: Callable[..., str]) -> _Found:
    """The first True entry; ``when``: the time of the first row."""
    if not wrong.any():
        return None
    where = [int(i) for i in np.argwhere(wrong)[0]]
    return when + where[0], describe(*where)


def _first_state(trajectory: Run, first: int, what: str, here: FloatArray, law: FloatArray) -> _Found:
    """Of the states from step ``first`` on, (K, m, R) as logged and by the law."""
    there = ~(np.isnan(here) | np.isnan(law)).any(axis=2)

    def describe(k: int, agent: int) -> str:
        where = int(np.argmax(here[k, agent] != law[k, agent]))
        row, replica = divmod(where, trajectory.record.experiment.run.replicas)
        number = f", number {row + 1} of the state" if row else ""
        return (
            f"agent {agent + 1} at step {first + k}, replica {replica + 1}{number}: {what} "
            f"{float(here[k, agent, where])!r}, the law gives {float(law[k, agent, where])!r}"
        )

    return _first(there & (here != law).any(axis=2), first, describe)


def _first_graph(trajectory: Run, block: RunBlock, path: IntArray) -> _Found:
    graphs = [graph.name for graph in trajectory.record.experiment.graph_list]
    logged, law = trajectory.modes[block.steps], path[block.steps]
    return _first(
        (logged >= 0) & (logged != law),
        block.first,
        lambda k: f"graph of step {block.first + k}: logged {graphs[logged[k]]}, the seed gives {graphs[law[k]]}",
    )


def _first_stamp(trajectory: Run, block: RunBlock) -> _Found:
    if trajectory.wrong_stamp is None or trajectory.wrong_stamp[0] not in range(block.steps.start, block.steps.stop):
        return None
    step, agent, stamp = trajectory.wrong_stamp
    due = StepClock(trajectory.record.experiment.step_length).nanoseconds(step)
    return step, (
        f"agent {agent + 1} at step {step}: stamped {stamp / SECOND} s of simulated time, expected {due / SECOND} s"
    )


def _first_messages(trajectory: Run, block: RunBlock, path: IntArray) -> Iterable[_Found]:
    """In lockstep: the first message that was lost, or used, otherwise than by the seed."""
    if trajectory.agent_modes is None:
        return
    # Under another graph than that of the seed the neighbours differ.
    same = np.asarray(trajectory.agent_modes[1:][block.steps] == path[block.steps, None])[:, :, None]

    def differing(logged: AnyArray, law: AnyArray, words: str, value: Callable[[int], str]) -> _Found:
        def describe(k: int, agent: int, which: int) -> str:
            step = block.first + k
            sender = int(trajectory.record.model.neighbours(int(path[step]), agent)[which]) + 1
            mine, other = (value(int(of[k, agent, which])) for of in (logged, law))
            return words.format(sender=sender, agent=agent + 1, step=step, logged=mine, law=other)

        # After the graph of this step, before the states of the next one.
        wrong = same & (logged >= 0) & (law >= 0) & (logged != law)
        return _first(wrong, block.first + 0.5, describe)

    if trajectory.lost is not None and block.lost is not None:
        words = (
            "the message of agent {sender} to agent {agent} in step {step}: logged as {logged}, the seed gives {law}"
        )
        yield differing(trajectory.lost[block.steps], block.lost, words, lambda lost: "lost" if lost else "heard")
    if trajectory.used is not None and block.used is not None:
        words = "the value of agent {sender} that agent {agent} used in step {step}: logged as that of {logged}, "
        words += "the seed gives {law}"
        yield differing(trajectory.used[block.steps], block.used, words, lambda used: f"step {used}")


def _uses(trajectory: Run, block: RunBlock) -> tuple[int, IntArray, IntArray]:
    """In real time: the first of these states that was made by a step; (K, m, D) ``used`` for them, and the senders."""
    assert trajectory.used is not None
    assert trajectory.agent_modes is not None
    first, end = max(1, block.steps.start), block.steps.stop
    modes = trajectory.agent_modes[first:end]
    # Where a state is missing its mode is -1, which picks the last graph: harmless, since ``used`` is -1 there too.
    senders = neighbour_tables(trajectory.record.model).senders[modes, np.arange(trajectory.record.model.agents)]
    return first, trajectory.used[first - 1 : end - 1], senders


def _first_early_use(trajectory: Run, first: int, used: IntArray, senders: IntArray) -> _Found:
    """The first value that was used in a state made before it, or at the same time."""
    assert trajectory.made is not None
    made, heard = trajectory.made[first : first + len(used)], trajectory.made[used, senders]

    def describe(k: int, agent: int, which: int) -> str:
        return (
            f"agent {agent + 1} at step {first + k}: stamped {made[k, agent] / 1e9} s of simulated time, and "
            f"used step {used[k, agent, which]} of agent {senders[k, agent, which] + 1}, stamped "
            f"{heard[k, agent, which] / 1e9} s"
        )

    return _first((used >= 0) & (made >= 0)[:, :, None] & (heard >= made[:, :, None]), first, describe)


def _first_lost_use(air: Air, first: int, used: IntArray, senders: IntArray) -> _Found:
    """In real time: the first message that was used although it was lost."""
    if not air.loss:
        return None
    lost = np.zeros(used.shape, dtype=np.bool_)
    for i in range(used.shape[1]):
        for j, number, these, within in by_sender_and_block(senders[:, i], used[:, i]):
            lost[:, i][these] = air.losses(i, j, number)[within]

    def describe(k: int, agent: int, which: int) -> str:
        return (
            f"agent {agent + 1} at step {first + k}: used the message with step {used[k, agent, which]} of agent "
            f"{senders[k, agent, which] + 1}, which the seed loses"
        )

    return _first(lost, first, describe)
