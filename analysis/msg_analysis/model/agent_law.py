# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""One agent: one row of the Markov jump linear system, and its share of the random numbers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from msg_analysis.arithmetic.reproducible import STEPS_PER_BLOCK, Stream, normals
from msg_analysis.arithmetic.update_law import combine, from_payload, to_payload, weighted_sum
from msg_analysis.common.arrays import FloatArray
from msg_analysis.experiment.protocols import AgentProtocol
from msg_analysis.model.reception import NOTHING, AgentAir
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import StepModel, Wiring, step_noise_gain
from msg_analysis.protocol import Heard


class ProcessNoise:
    """The process noise of any agent at any step: row i of B_g v(k), with B_g (n, m, m) = ``noise_gain``."""

    # Correlated noise needs no communication: an agent draws the sources v_j that its rows use by itself. kept: all
    # that was drawn stays in memory, for another pass over the same steps.

    def __init__(self, seed: int, noise_gain: FloatArray, replicas: int, *, kept: bool = False) -> None:
        self.replicas = replicas
        agents = noise_gain.shape[1]
        sources = int(np.count_nonzero(noise_gain.any(axis=0), axis=1).max(initial=1))

        # An agent asks for its own row only, the twin for every row of a block: keep one block of every source.
        @lru_cache(maxsize=None if kept else agents if sources > 1 else 1)
        def source(agent: int, block: int, steps: int) -> FloatArray:
            return normals(seed, Stream.PROCESS, agent, block, (steps, replicas))

        self._source = source
        self._rows = lru_cache(maxsize=None)(lambda agent: _different_rows(noise_gain[:, agent]))

    def block(self, agent: int, block: int, steps: int = STEPS_PER_BLOCK) -> list[FloatArray]:
        """For each mode, the noise of one agent (from 0) in the first steps of a block; equal ones share an array."""
        rows, of_mode = self._rows(agent)
        drawn = [
            weighted_sum(weights, [self._source(j, block, steps) for j in used])
            if used
            else np.zeros((steps, self.replicas))
            for used, weights in rows
        ]
        return [drawn[row] for row in of_mode]


def _different_rows(rows: FloatArray) -> tuple[list[tuple[list[int], list[float]]], list[int]]:
    """Sources (from 0) and weights of each different one of an agent's rows (n, m), and for each mode which it is."""
    keys = [row.tobytes() for row in rows]
    different = dict(zip(keys, rows, strict=True))
    places = list(different)
    used = [(np.flatnonzero(row).tolist(), row[row != 0.0].tolist()) for row in different.values()]
    return used, [places.index(key) for key in keys]


class AgentLaw:
    """The state x(k) of one agent (index from 0) as a payload, and its next states."""

    air: AgentAir | None = None  # None where messages have no noise, none is lost, and none is old

    def __init__(self, record: RunRecord, model: StepModel, agent: int) -> None:
        self.agent, self.step, self.state = agent, 0, to_payload(record.start[agent])
        # In lockstep, by neighbour, the step of the value used in the step to x(k), or LOST; empty where none was lost.
        self.heard: tuple[int, ...] = ()
        self._noise = ProcessNoise(record.experiment.run.seed, model.noise_gain, record.experiment.run.replicas)
        modes = range(model.modes)
        self._inputs = [[int(j) for j in model.inputs(mode, agent)] for mode in modes]
        self._own = [inputs.index(agent) for inputs in self._inputs]
        self._weights = [tuple(map(float, model.nominal[mode, agent, self._inputs[mode]])) for mode in modes]
        self._offsets = [float(offset) for offset in model.offsets[:, agent]]
        self._drives = self._draw(0)

    def resume(self, step: int, state: bytes) -> None:
        """Go on from x(step), a payload. The noise is a function of the seed and the step: nothing else is needed."""
        self.step, self.state = step, state
        self._drives = self._draw(step // STEPS_PER_BLOCK)

    def neighbours(self, mode: int) -> list[int]:
        """The other agents, ascending, with states that this agent uses under a mode (from 0)."""
        return [j for j in self._inputs[mode] if j != self.agent]

    def published(self, step: int, state: bytes) -> bytes:  # noqa: ARG002  what is published is the truth
        """Payload that is published of x(step)."""
        return state

    def advance(self, mode: int, heard: list[bytes], steps: Sequence[int] | None = None) -> bytes:
        """x(k+1) from x(k) under g(k) = ``mode`` (from 0), and what its neighbours, ascending, published: ``heard``."""
        # In lockstep in the steps that air needs, or k; in real time in steps, where NOTHING stands for the own value.
        if steps is not None:
            heard = [self.state if step == NOTHING else value for step, value in zip(steps, heard, strict=True)]
        before = self._own[mode]
        values = [*heard[:before], self.state, *heard[before:]]
        self.state = combine(self._weights[mode], values, self._drives[mode][self.step % STEPS_PER_BLOCK])
        self.step += 1
        if self.step % STEPS_PER_BLOCK == 0:
            self._drives = self._draw(self.step // STEPS_PER_BLOCK)
        return self.state

    def _draw(self, block: int) -> list[list[bytes]]:
        """For each mode, the noise plus offset of every step of a block; equal ones share a list."""
        noises = list(zip(self._noise.block(self.agent, block), self._offsets, strict=True))
        different = {(id(noise), offset): noise + offset for noise, offset in noises}
        made = {key: [to_payload(drive) for drive in drives] for key, drives in different.items()}
        return [made[id(noise), offset] for noise, offset in noises]


class AgentLawOnAir(AgentLaw):
    """The same with noise, loss or delay on the air: see ``model.step.air``."""

    def __init__(self, record: RunRecord, model: StepModel, agent: int) -> None:
        super().__init__(record, model, agent)
        self.air: AgentAir = AgentAir(record.experiment, model, agent)
        self._neighbours = [self.neighbours(mode) for mode in range(model.modes)]

    def published(self, step: int, state: bytes) -> bytes:
        """See AgentLaw."""
        return self.air.published(step, from_payload(state)) if self.air.broadcast else state

    def advance(self, mode: int, heard: list[bytes], steps: Sequence[int] | None = None) -> bytes:
        """See AgentLaw. The own value stands for those that were lost."""
        own = self.state
        values, self.heard = self.air.receive(self._neighbours[mode], self.step, heard, steps)
        return super().advance(mode, [own if value is None else value for value in values])


class ProtocolLaw:
    """The same with a nonlinear protocol, without the lost messages; ``state`` is all of its state, row by row."""

    def __init__(self, record: RunRecord, model: Wiring, agent: int) -> None:
        experiment = record.experiment
        assert experiment.protocol is not None
        self.agent, self.step, self.state = agent, 0, to_payload(record.start[agent])
        self.heard: tuple[int, ...] = ()
        self._protocol = AgentProtocol(experiment.protocol, agent)
        self._shape = (self._protocol.states, experiment.run.replicas)
        modes = range(model.modes)
        self._neighbours = [model.neighbours(mode, agent) for mode in modes]
        self._weights = [experiment.graph_list[mode].adjacency[agent, self._neighbours[mode]] for mode in modes]
        self._noise = ProcessNoise(experiment.run.seed, step_noise_gain(experiment), experiment.run.replicas)
        for shared in (*self._neighbours, *self._weights):
            shared.flags.writeable = False
        self._noises = self._draw(0)
        self.air = air = AgentAir(experiment, model, agent)
        self._plain = not (air.link or air.loss or air.delay)

    def resume(self, step: int, state: bytes) -> None:
        """See AgentLaw."""
        self.step, self.state = step, state
        self._noises = self._draw(step // STEPS_PER_BLOCK)

    def neighbours(self, mode: int) -> list[int]:
        """See AgentLaw."""
        return [int(j) for j in self._neighbours[mode]]

    def published(self, step: int, state: bytes) -> bytes:
        """See AgentLaw."""
        value = self._protocol.publish(step, from_payload(state).reshape(self._shape))
        return self.air.published(step, value)

    def advance(self, mode: int, heard: list[bytes], steps: Sequence[int] | None = None) -> bytes:
        """See AgentLaw."""
        within = self.step % STEPS_PER_BLOCK
        agents, weights = self._neighbours[mode], self._weights[mode]
        if not self._plain or steps is not None:
            found, self.heard = self.air.receive(agents.tolist(), self.step, heard, steps)
            came = [d for d, value in enumerate(found) if value is not None]
            heard = [value for value in found if value is not None]
            agents, weights = agents[came], weights[came]
        values = from_payload(b"".join(heard)).reshape(len(heard), self._shape[1])
        state = from_payload(self.state).reshape(self._shape)
        message = Heard(agents, weights, values)
        self.state = to_payload(self._protocol.step(self.step, mode, state, message, self._noises[mode][within]))
        self.step += 1
        if self.step % STEPS_PER_BLOCK == 0:
            self._noises = self._draw(self.step // STEPS_PER_BLOCK)
        return self.state

    def _draw(self, block: int) -> list[FloatArray]:
        """For each mode, the process noise of every step of a block."""
        noises = self._noise.block(self.agent, block)
        for noise in noises:
            noise.flags.writeable = False
        return noises


def agent_law(record: RunRecord, model: Wiring, agent: int) -> AgentLaw | ProtocolLaw:
    """The law of one agent (index from 0) of a run; ``model`` is that of the record."""
    if not isinstance(model, StepModel):
        return ProtocolLaw(record, model, agent)
    kind = AgentLawOnAir if record.experiment.noise.on_messages else AgentLaw
    return kind(record, model, agent)
