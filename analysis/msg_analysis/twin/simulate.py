# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The offline twin: a run without ROS, from its start, block by block.

In real time it has ideal timers: every agent steps when it is due, and hears at once what others made.
"""

from __future__ import annotations

import math
import secrets
import uuid
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.arithmetic.reproducible import STEPS_PER_BLOCK, StepClock, Stream, normals
from msg_analysis.arithmetic.update_law import ManySteps, Round, from_payload, to_payload, weighted_sum
from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray, large_zeros, release
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.limits import unpredictable
from msg_analysis.experiment.problems import problem
from msg_analysis.experiment.protocols import AgentProtocol
from msg_analysis.model.agent_law import ProcessNoise, ProtocolLaw
from msg_analysis.model.graph_path import holding_periods, mode_path, past_modes
from msg_analysis.model.reception import Air, AirReception, MessagesUsed, add_broadcast_noise
from msg_analysis.model.run import Completeness, Run
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import StepMatrices, StepModel, Wiring, ahead, build_model, phases, turns


def ideal_log(experiment: Experiment, model: Wiring, modes: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """``agent_modes``, ``used`` and ``made`` of ``Run`` for a run with these graphs (N,), from 0."""
    agent_modes, made = ideal_times(experiment, modes)
    messages, shape = MessagesUsed(experiment, model), (len(modes), model.agents, model.most_neighbours)
    used = large_zeros(shape, np.int64, total=8 * math.prod(shape))
    for first in range(0, len(modes), STEPS_PER_BLOCK):
        now = slice(first, first + STEPS_PER_BLOCK)
        used[now] = messages.used(first, modes[now])
        release(used)
    return agent_modes, used, made


def ideal_times(experiment: Experiment, modes: IntArray) -> tuple[IntArray, IntArray]:
    """``agent_modes`` and ``made`` alone."""
    shape = len(modes) + 1, experiment.agents
    agent_modes, made = (large_zeros(shape, np.int64, total=8 * shape[0] * shape[1]) for _ in range(2))
    agent_modes[0] = -1
    agent_modes[1:] = modes[:, None]
    for i, phase in enumerate(phases(experiment).tolist()):
        made[1:, i] = StepClock(experiment.step_length, phase).times(np.arange(len(modes)))
    return agent_modes, made


def law_of_all(experiment: Experiment, model: StepModel) -> ManySteps:
    """The steps of all agents under every graph."""
    lead = ahead(turns(experiment), experiment.agents).astype(np.bool_)
    holds = model.listens() if experiment.noise.holds else None
    return ManySteps([_rounds(model, mode, lead, holds) for mode in range(model.modes)])


def noise_of_all(experiment: Experiment, model: StepModel, *, kept: bool = False) -> ProcessNoise:
    """The process noise of all agents; ``kept`` as of ``ProcessNoise``."""
    return ProcessNoise(experiment.run.seed, model.noise_gain, experiment.run.replicas, kept=kept)


def states_of_all(
    experiment: Experiment,
    model: StepModel,
    modes: IntArray,
    start: FloatArray,
    first: int = 0,
    law: ManySteps | None = None,
    noise: ProcessNoise | None = None,
) -> Iterator[FloatArray]:
    """x(first + 1), x(first + 2), ..., from x(first) under the graphs ``modes`` from there on, in blocks (k, m, R)."""
    # first is a multiple of STEPS_PER_BLOCK; steps before a run are negative.
    air = AirReception(experiment, model, start, first) if experiment.noise.on_messages else None
    law, noise = law or law_of_all(experiment, model), noise or noise_of_all(experiment, model)
    past = np.repeat(start[None], experiment.noise.delay + 1, axis=0)  # before the start the states are those of it
    for begin, now, drives in _blocks(noise, model, modes, first):
        made = law.advance(now, past, drives, air.block(begin, len(now)) if air else None)
        yield made
        past = np.concatenate([past, made])[-len(past) :]


Block = tuple[int, IntArray, FloatArray]
"""First step, graphs (k,), and for every step (k, m, R) the noise of all agents plus what the reference adds."""


def _blocks(noise: ProcessNoise, model: StepModel, modes: IntArray, first: int) -> Iterator[Block]:
    """A path of graphs in blocks of STEPS_PER_BLOCK steps, the last one shorter."""
    for begin in range(0, len(modes), STEPS_PER_BLOCK):
        now, number = modes[begin : begin + STEPS_PER_BLOCK], (first + begin) // STEPS_PER_BLOCK
        drives, steps = np.empty((len(now), model.agents, noise.replicas)), np.arange(len(now))
        for i in range(model.agents):
            of_modes = noise.block(i, number, len(now))
            alike = all(each is of_modes[0] for each in of_modes)
            drives[:, i] = of_modes[0] if alike else np.stack(of_modes)[now, steps]
        drives += model.offsets[now][:, :, None]
        yield first + begin, now, drives


def _rounds(model: StepModel, mode: int, lead: BoolArray, heard: BoolArray | None) -> list[Round]:
    """The agents in rounds: each in the first one after those that step before it (``lead``) and that it uses."""
    # heard (m, m): whom it hears whatever the graph, and must wait for, too.
    m, every = model.agents, np.arange(model.agents)
    inputs = [model.inputs(mode, i) for i in range(m)]
    columns = np.zeros((max(len(row) for row in inputs), m), dtype=np.int64)  # the d-th input of every agent
    there = np.zeros(columns.shape, dtype=np.bool_)
    for i, row in enumerate(inputs):
        columns[: len(row), i] = row
        there[: len(row), i] = True
    weights = np.where(there, model.nominal[mode, every, columns], 0.0)  # 0 for padding changes no sum
    earlier = there & lead[every, columns]
    waits = np.zeros((m, m), dtype=np.bool_) if heard is None else heard & lead
    np.logical_or.at(waits, (np.broadcast_to(every, columns.shape)[earlier], columns[earlier]), True)
    number = np.zeros(m, dtype=np.int64)
    for i in np.argsort(lead.sum(axis=1), kind="stable").tolist():
        number[i] = 1 + max(number[waits[i]], default=-1)
    rows = columns + m * earlier
    chosen = [np.flatnonzero(number == one) for one in range(int(number.max()) + 1)]
    return [Round(agents, rows[:, agents], there[:, agents], weights[:, agents]) for agents in chosen]


@dataclass(frozen=True, slots=True)
class RunBlock:
    """What ``Run`` has from step ``first`` on. The last step of a run has a state, and nothing lost or used."""

    first: int
    states: FloatArray  # (K, m, width)
    published: FloatArray | None = None  # (K, m, R)
    lost: BoolArray | None = None  # (K, m, D)
    used: IntArray | None = None  # (K, m, D)

    @property
    def steps(self) -> slice:
        """The places of these steps in an array of all steps."""
        return slice(self.first, self.first + len(self.states))


def run_blocks(record: RunRecord, modes: IntArray) -> Iterator[RunBlock]:
    """A run with these graphs (N,), from x(0) to x(N): in lockstep, or with ideal timers and no latency."""
    experiment, model = record.experiment, record.model
    realtime, noise = experiment.run.pace == "realtime", experiment.noise
    looks_back = realtime or bool(noise.delay or noise.holds)
    messages = MessagesUsed(experiment, model) if looks_back or noise.loss.any else None
    values = _all_at_once(record, model, modes) if isinstance(model, StepModel) else _one_by_one(record, modes)
    for first, states, published in values:
        lost = used = None
        if messages is not None:
            now = modes[first : first + len(states)]
            used = messages.used(first, now)
            if not realtime and noise.loss.any:
                lost = messages.lost(first, used, now)
        yield RunBlock(first, states, published, lost, used if looks_back else None)


_Values = tuple[int, FloatArray, FloatArray | None]
"""First step, (K, m, width) states, and what is published of them, (K, m, R), if that is something else."""


def from_start(start: FloatArray, made: Iterable[FloatArray]) -> Iterator[tuple[int, FloatArray]]:
    """First step and states of blocks that begin with x(0) = ``start``; those of ``made`` begin with x(1)."""
    first, last = 0, start[None]
    for block in made:
        states = np.concatenate([last, block])
        yield first, states[:-1]
        first, last = first + len(block), states[-1:]
    yield first, last


def _all_at_once(record: RunRecord, model: StepModel, modes: IntArray) -> Iterator[_Values]:
    """A run of a linear law."""
    experiment = record.experiment
    air = Air(experiment) if experiment.noise.broadcast else None
    for first, states in from_start(record.start, states_of_all(experiment, model, modes, record.start)):
        yield first, states, add_broadcast_noise(air, states, first) if air else None


def _one_by_one(record: RunRecord, modes: IntArray) -> Iterator[_Values]:
    """The same by the laws of the single agents, one after the other, as the network has them."""
    experiment, model = record.experiment, record.model
    agents, replicas, count = model.agents, experiment.run.replicas, len(modes) + 1
    laws = [ProtocolLaw(record, model, i) for i in range(agents)]
    neighbours = [[law.neighbours(mode) for mode in range(model.modes)] for law in laws]
    lead = ahead(turns(experiment), experiment.agents)
    order = np.argsort(lead.sum(axis=1), kind="stable").tolist()
    # All of it, since a message that is held may be of any earlier step.
    published = large_zeros((count, agents, replicas), np.float64, total=8 * count * agents * replicas)

    def advance(k: int, i: int) -> None:
        mode = int(modes[k])
        senders = neighbours[i][mode]
        used = [laws[i].air.source(j, k + int(lead[i, j])) for j in senders]
        laws[i].advance(mode, [to_payload(published[s, j]) for s, j in zip(used, senders, strict=True)], used)

    for first in range(0, count, STEPS_PER_BLOCK):
        states = np.empty((min(STEPS_PER_BLOCK, count - first), *record.start.shape))
        for k in range(first, first + len(states)):
            for i in order:
                if k:
                    advance(k - 1, i)
                states[k - first, i] = from_payload(laws[i].state)
                published[k, i] = from_payload(laws[i].published(k, laws[i].state))
        yield first, states, published[first : first + len(states)].copy() if experiment.truth else None
        release(published)


TOLERANCE = 2.0**-10  # a change of x(0) this small, relative to its size, ends the search for a beginning
MAX_PAST = 2**16  # longest past, in steps,
MAX_NUMBERS = 2**24  # and in numbers (steps x agents x replicas): a second or two of computing
GRID = 2.0**-12  # unit of x(0), in standard deviations, where it would be longer: far above what processors differ by


def draw_start(experiment: Experiment, model: Wiring, first_mode: int) -> FloatArray:
    """(m, replicas) x(0): zero, the given values, or drawn from the stationary law given g(0) = ``first_mode``."""
    known = experiment.known_start
    if known is not None:
        return np.repeat(known[:, None], experiment.run.replicas, axis=1)
    assert isinstance(model, StepModel), "experiments without a prediction start from given values"
    found = _from_the_past(experiment, model, first_mode)
    if found is None and (reason := unpredictable(experiment)):
        wanted = f"expected 'zero' or one value per agent, since a past would take too long, and {reason}"
        raise InputError(f"{experiment.source}: {problem('run.start', 'stationary', wanted, 'give x(0)')}")
    return _gaussian(experiment, first_mode) if found is None else found


def _from_the_past(experiment: Experiment, model: StepModel, first_mode: int) -> FloatArray | None:
    """x(0) at the end of a past that is long enough; None where that would take too long."""
    # Coupling from the past (Propp and Wilson 1996): the steps of the past have negative numbers, the same law and
    # streams of their own, and graphs drawn backwards from g(0). It is long enough when one twice as long does not
    # change x(0), which so has the stationary law, not only its second moments; and no linear algebra, whose last bits
    # depend on the processor, takes part.
    size = experiment.agents * experiment.run.replicas
    steps, before, law = STEPS_PER_BLOCK, None, law_of_all(experiment, model)
    noise = noise_of_all(experiment, model, kept=True)  # the past that is twice as long ends with the same steps
    while steps <= MAX_PAST and steps * size <= MAX_NUMBERS:
        start, floor = _end_of_the_past(experiment, model, law, noise, first_mode, steps)
        if before is not None and _same(start - before, start - model.reference, floor):
            return start
        before, steps = start, 2 * steps
    return None


def _end_of_the_past(
    experiment: Experiment, model: StepModel, law: ManySteps, noise: ProcessNoise, first_mode: int, steps: int
) -> tuple[FloatArray, float]:
    """x(0) of a past of so many steps that begins at the reference, and the size of its rounding errors."""
    state = np.full((experiment.agents, experiment.run.replicas), model.reference)
    for block in states_of_all(experiment, model, past_modes(experiment, first_mode, steps), state, -steps, law, noise):
        state = block[-1]
    rounding = 2.0**-40 * float(np.abs(state).max())
    if experiment.problem == "consensus":  # only differences between agents are stationary
        state = state - weighted_sum([1.0 / len(state)] * len(state), list(state))
    return state, rounding


def _same(change: FloatArray, size: FloatArray, floor: float) -> bool:
    """Whether no agent's change (m, R) matters beside its own size, or that of all."""
    changes, sizes = (np.sqrt((each**2).mean(axis=1)) for each in (change, size))
    return bool((changes <= TOLERANCE * np.maximum(sizes, TOLERANCE * sizes.max()) + floor).all())


def _gaussian(experiment: Experiment, first_mode: int) -> FloatArray:
    """x(0) with the second moments of the stationary law, rounded so that processors agree."""
    from msg_analysis.theory.prediction import stationary_start_factor  # here, since it is seldom needed

    replicas = experiment.run.replicas
    factor = stationary_start_factor(experiment, first_mode)
    factor[np.isinf(experiment.leader_gains)] *= experiment.time == "discrete"  # a grounded leader has no error
    sources = [normals(experiment.run.seed, Stream.START, j, 0, (replicas,)) for j in range(experiment.agents)]
    deviations = np.array([weighted_sum([float(w) for w in row], sources) for row in factor])
    sizes = np.sqrt((factor**2).sum(axis=1, keepdims=True))
    units = GRID * 2.0 ** np.floor(np.log2(sizes, out=np.zeros_like(sizes), where=sizes > 0.0))
    return np.asarray(np.rint(deviations / units) * units + experiment.reference)


KEY_SIZE = 32  # bytes


def new_record(experiment: Experiment, run: uuid.UUID | None = None) -> RunRecord:
    """Everything that a new run of an experiment starts from; ``run``: its id, a new random one if not given."""
    model = build_model(experiment)
    start = draw_start(experiment, model, next(holding_periods(experiment, model.initial)).mode)
    if experiment.protocol and not isinstance(model, StepModel):
        start = np.array([AgentProtocol(experiment.protocol, i).start(x).ravel() for i, x in enumerate(start)])
    matrices = None
    if isinstance(model, StepModel) and (experiment.time == "discrete" or experiment.protocol):
        matrices = StepMatrices(model.nominal, model.noise_gain)
    record = RunRecord(run or uuid.uuid4(), experiment, start, matrices=matrices, key=secrets.token_bytes(KEY_SIZE))
    record.__dict__["model"] = model  # what this cached property would compute again
    return record


def simulate(experiment: Experiment, *, record: RunRecord | None = None) -> Run:
    """Run an experiment without ROS, or repeat the run of a record (then its experiment is used)."""
    experiment = record.experiment if record else experiment
    experiment.require_available()
    record = record or new_record(experiment)
    modes = mode_path(experiment, record.model.initial)
    arrays = _whole(run_blocks(record, modes), len(modes))
    agent_modes = made = None
    if experiment.run.pace == "realtime":
        agent_modes, made = ideal_times(experiment, modes)
    expected = (len(modes) + 1) * experiment.agents * (2 if experiment.truth else 1)
    count = Completeness(expected, expected, 0)
    return Run(record, modes=modes, completeness=count, agent_modes=agent_modes, made=made, **arrays)


def _whole(blocks: Iterable[RunBlock], steps: int) -> dict[str, Any]:
    """The arrays of ``Run`` of a run of so many steps, by name, from its blocks."""
    length = {"states": steps + 1, "published": steps + 1, "lost": steps, "used": steps}
    arrays: dict[str, AnyArray] = {}
    for block in blocks:
        parts = {name: getattr(block, name) for name in length if getattr(block, name) is not None}
        if not arrays:
            total = sum(length[name] * part[0].nbytes for name, part in parts.items())
            for name, part in parts.items():
                arrays[name] = large_zeros((length[name], *part.shape[1:]), part.dtype, total=total)
        for name, part in parts.items():
            arrays[name][block.first : block.first + len(part)] = part
            release(arrays[name])
    return arrays
