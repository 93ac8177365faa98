# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Writes a trajectory as a bag with the topics and the layout of a recorded network run.

States that are missing in the trajectory are missing in the bag.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from msg_analysis.arithmetic.step_clock import StepClock
from msg_analysis.arithmetic.update_law import to_payload
from msg_analysis.bags.mcap_chunks import DEFAULT_STORAGE, Storage
from msg_analysis.bags.writing import BagWriter, exists_already
from msg_analysis.common.arrays import BLOCK_NUMBERS, IntArray, release
from msg_analysis.common.files import require_utf8
from msg_analysis.errors import BagError
from msg_analysis.messages.messages import ActiveGraph, StateCodec, encode_string
from msg_analysis.messages.topics import EXPERIMENT, GRAPH, STATE, TRUTH, Topic, network_topics
from msg_analysis.model.reception import LOST
from msg_analysis.model.run import Run

AT_ONCE = 4096  # messages
# Topic, CDR bytes, time [ns], and of a sojourn the time of the first state behind it [ns].
_Message = tuple[str, bytes, int, int | None]


def write_trajectory(
    trajectory: Run,
    directory: str | Path,
    storage: Storage = DEFAULT_STORAGE,
    block_numbers: int = BLOCK_NUMBERS,
) -> None:
    """Write a bag, whole or not at all; BagError where the directory exists or cannot be written.

    InputError for a name that is not UTF-8.
    """
    directory = Path(directory).absolute()
    require_utf8(directory)
    if directory.exists():
        raise exists_already(directory)
    record = trajectory.record.to_json()
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{directory.name}.", dir=directory.parent) as workshop:
            # It has its final name already: the name of its file derives from it.
            unfinished = Path(workshop) / directory.name
            noisy = trajectory.published is not None
            topics = network_topics(trajectory.record.experiment.agents, truth=noisy)
            with BagWriter(unfinished, topics, record=record, storage=storage) as bag:
                bag.write(f"/{EXPERIMENT.name}", encode_string(record), 0)
                _write(bag, [topic.name for topic in topics], _messages(trajectory, block_numbers))
            unfinished.rename(directory)
    except OSError as error:
        raise BagError(f"{directory}: cannot be written ({error.strerror}): choose another place") from error


def _write(bag: BagWriter, names: Sequence[str], messages: Iterator[_Message]) -> None:
    """Write many messages at once: a fraction of the time of writing each. Sojourns come a little early."""
    number = {name: index for index, name in enumerate(names)}
    while part := list(islice(messages, AT_ONCE)):
        for topic, content, stamp, until in part:
            if until is not None:
                bag.write(topic, content, stamp, until)
        states = [message for message in part if message[3] is None]
        if not states:
            continue
        topics, contents, times, _ = zip(*states, strict=True)
        size = np.array([len(content) for content in contents], dtype=np.int64)
        of = np.array([number[topic] for topic in topics], dtype=np.int64)
        time = np.array(times, dtype=np.int64)
        bag.write_many(names, of, time, b"".join(contents), np.cumsum(size) - size, size)


def _messages(trajectory: Run, block_numbers: int = BLOCK_NUMBERS) -> Iterator[_Message]:
    """The messages in the order of time."""
    experiment = trajectory.record.experiment
    run, dt = trajectory.record.run.bytes, experiment.step_length
    time = StepClock(dt).nanoseconds
    truth = STATE if trajectory.published is None else TRUTH
    streams = [(_names(truth, experiment.agents), trajectory.states)]
    if trajectory.published is not None:
        streams.append((_names(STATE, experiment.agents), trajectory.published))
    codecs = [[StateCodec(run, i + 1, states.shape[2], dt) for i in range(experiment.agents)] for _, states in streams]
    heard = _heard(trajectory)
    sojourns = _sojourns(trajectory)
    sojourn = next(sojourns, None)
    for steps, agents, times in _in_order(trajectory, block_numbers):
        if trajectory.agent_modes is not None:
            graphs = trajectory.agent_modes[steps, agents]
        else:
            graphs = np.where(steps > 0, trajectory.modes[steps - 1], -1)
        values = [states[steps, agents] for _, states in streams]
        there = [np.asarray(~np.isnan(each).any(axis=1)).tolist() for each in values]
        cells = zip(steps.tolist(), agents.tolist(), times.tolist(), graphs.tolist(), strict=True)
        for place, (k, i, now, graph) in enumerate(cells):
            while sojourn is not None and sojourn.stamp <= now:
                yield _graph_message(sojourn, time)
                sojourn = next(sojourns, None)
            for (topics, _), codec, is_there, value in zip(streams, codecs, there, values, strict=True):
                if is_there[place]:
                    payload = to_payload(value[place])
                    yield topics[i], codec[i].wrap(k, graph + 1, payload, heard(k, i, graph), now), now, None
        trajectory.release()
    while sojourn is not None:
        yield _graph_message(sojourn, time)
        sojourn = next(sojourns, None)


def _in_order(trajectory: Run, block_numbers: int) -> Iterator[tuple[IntArray, IntArray, IntArray]]:
    """Steps, agents and times (e,) of all states by time, those of one time by step and agent, a part at once."""
    count, m, made = len(trajectory.states), trajectory.states.shape[1], trajectory.made
    clock = StepClock(trajectory.record.experiment.step_length)
    rows = max(1, block_numbers // trajectory.states[:1].size)
    # Nothing of step k or a later one is earlier than later[k].
    later = np.empty(count + 1, dtype=np.int64)
    later[count] = np.iinfo(np.int64).max
    for first in range(0, count if made is not None else 0, rows):
        assert made is not None
        times = made[first : first + rows]
        later[first : first + len(times)] = np.where(times < 0, later[count], times).min(axis=1)
        release(made)
    later[:count] = np.minimum.accumulate(later[::-1])[::-1][:count]
    waiting = np.empty(0, dtype=np.int64)
    for first in range(0, count, rows):
        end = min(first + rows, count)
        cells = np.concatenate([waiting, np.arange(first * m, end * m)])
        steps, agents = np.divmod(cells, m)
        if made is None:
            yield steps, agents, np.repeat(clock.times(np.arange(first, end)), m)
            continue
        times = made[steps, agents]
        by = np.lexsort((cells, times))
        ready, behind = np.split(by, [int(np.searchsorted(times[by], later[end], side="left"))])
        waiting = cells[behind]
        yield steps[ready], agents[ready], times[ready]


def _graph_message(sojourn: ActiveGraph, time: Callable[[int], int]) -> _Message:
    return f"/{GRAPH.name}", sojourn.encode(), sojourn.stamp, time(sojourn.last_step + 1)


def _names(topic: Topic, agents: int) -> list[str]:
    return [f"/{topic.of(i)}" for i in range(agents)]


def _heard(trajectory: Run) -> Callable[[int, int, int], list[int]]:
    """Function of (k, agent and graph from 0): ``heard`` of that state, the steps used in the step that led there.

    Empty in lockstep where nothing was lost; complete in real time.
    """
    lost, values = trajectory.lost, trajectory.used
    if lost is None and values is None:
        return lambda _k, _i, _graph: []
    model, delay = trajectory.record.model, trajectory.record.experiment.noise.delay
    modes, agents = range(model.modes), range(model.agents)
    counts = [[len(model.neighbours(mode, i)) for i in agents] for mode in modes]

    def listed(k: int, i: int, graph: int) -> list[int]:
        if k == 0:
            return []
        neighbours = counts[graph][i]
        newest = max(0, k - 1 - delay)
        if values is not None:
            steps = values[k - 1, i, :neighbours].tolist()
            if trajectory.made is None and all(step == newest for step in steps):
                return []
            return [LOST if step < 0 else step for step in steps]
        if lost is None or not lost[k - 1, i].any():
            return []
        return [LOST if gone else newest for gone in lost[k - 1, i, :neighbours].tolist()]

    return listed


def _sojourns(trajectory: Run) -> Iterator[ActiveGraph]:
    """The stretches of equal graph, without those whose graph is not known."""
    experiment, modes = trajectory.record.experiment, trajectory.modes
    time = StepClock(experiment.step_length).nanoseconds
    first = np.flatnonzero(np.diff(modes, prepend=-2))
    last = np.append(first[1:], len(modes)) - 1
    known = modes[first] >= 0
    for sequence, (start, end) in enumerate(zip(first[known].tolist(), last[known].tolist(), strict=True)):
        graph = experiment.graph_list[modes[start]]
        yield ActiveGraph(
            stamp=time(start),
            run=trajectory.record.run.bytes,
            sequence=sequence,
            mode=int(modes[start]) + 1,
            name=graph.name,
            first_step=start,
            last_step=end,
            arcs=graph.arcs,
        )
