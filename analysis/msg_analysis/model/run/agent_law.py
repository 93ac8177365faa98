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

"""One agent: one row of the Markov jump linear system, and its share of the random numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np

from msg_analysis.model.arithmetic.payload import combine, from_payload, to_payload
from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK
from msg_analysis.model.experiment.protocol_binding import AgentProtocol
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.step.air import LOST, Air
from msg_analysis.model.step.process_noise import ProcessNoise
from msg_analysis.model.step.step_model import StepModel, Wiring
from msg_analysis.protocol import Heard
from msg_analysis.types import FloatArray, IntArray


class AgentLaw:
    """The state x(k) of one agent (index from 0) as a payload, and its next states.

    ``heard`` has the steps of the values used in the step to x(k), or ``LOST``, by neighbour, ascending; empty where
    all are of the step before.
    """

    def __init__(self, record: RunRecord, model: StepModel, agent: int) -> None:
        self.agent = agent
        self.step = 0
        self.state = to_payload(record.start[agent])
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

    def advance(self, mode: int, heard: list[bytes]) -> bytes:
        """x(k+1) from x(k) under g(k) = ``mode`` (from 0).

        ``heard`` has what the neighbours of this mode, ascending, published of x_j(k).
        """
        before = self._own[mode]
        values = [*heard[:before], self.state, *heard[before:]]
        self.state = combine(self._weights[mode], values, self._drives[mode][self.step % STEPS_PER_BLOCK])
        self.step += 1
        if self.step % STEPS_PER_BLOCK == 0:
            self._drives = self._draw(self.step // STEPS_PER_BLOCK)
        return self.state

    def _draw(self, block: int) -> list[list[bytes]]:
        """For each mode, the noise plus offset of every step of a block."""
        noises = zip(self._noise.block(self.agent, block), self._offsets, strict=True)
        return [[to_payload(drive) for drive in noise + offset] for noise, offset in noises]


class AgentLawOnAir(AgentLaw):
    """The same with noise or loss on the air: see ``model.step.air``."""

    def __init__(self, record: RunRecord, model: StepModel, agent: int) -> None:
        super().__init__(record, model, agent)
        self._air = air = Air(record.experiment)
        self._neighbours = [self.neighbours(mode) for mode in range(model.modes)]
        self._link = _links(air, model, agent)

    def published(self, step: int, state: bytes) -> bytes:
        """See AgentLaw."""
        if not self._air.broadcast:
            return state
        return to_payload(self._air.published(self.agent, step, from_payload(state)))

    def advance(self, mode: int, heard: list[bytes]) -> bytes:
        """See AgentLaw. Own values stand for those that were lost."""
        step, own = self.step, self.state
        block, within = divmod(step, STEPS_PER_BLOCK)
        used: list[int] = []
        values: list[bytes] = []
        for sender, value in zip(self._neighbours[mode], heard, strict=True):
            noise, losses = self._link(sender, block)
            lost = losses[within]
            used.append(LOST if lost else step)
            if lost:
                values.append(own)
            else:
                values.append(value if noise is None else to_payload(from_payload(value) + noise[within]))
        self.heard = tuple(used) if LOST in used else ()
        return super().advance(mode, values)


class ProtocolLaw:
    """The same for an agent with a nonlinear protocol; ``state`` is all of its state, row by row.

    A lost message is not passed to the protocol.
    """

    def __init__(self, record: RunRecord, model: Wiring, agent: int) -> None:
        experiment = record.experiment
        assert experiment.protocol is not None
        self.agent = agent
        self.step = 0
        self.state = to_payload(record.start[agent])
        self.heard: tuple[int, ...] = ()
        self._protocol = AgentProtocol(experiment.protocol, agent)
        self._shape = (self._protocol.states, experiment.run.replicas)
        modes = range(model.modes)
        self._neighbours = [model.neighbours(mode, agent) for mode in modes]
        self._weights = [experiment.graph_list[mode].adjacency[agent, self._neighbours[mode]] for mode in modes]
        self._noise = ProcessNoise(experiment.run.seed, experiment.step_noise_gain, experiment.run.replicas)
        for shared in (*self._neighbours, *self._weights):
            shared.flags.writeable = False
        self._noises = self._draw(0)
        self._air = Air(experiment)
        self._link = _links(self._air, model, agent)

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
        return to_payload(self._air.published(self.agent, step, value) if self._air.broadcast else value)

    def advance(self, mode: int, heard: list[bytes]) -> bytes:
        """See AgentLaw."""
        within = self.step % STEPS_PER_BLOCK
        agents, weights = self._neighbours[mode], self._weights[mode]
        values = from_payload(b"".join(heard)).reshape(len(heard), self._shape[1])
        self.heard = ()
        if self._air.link or self._air.loss:
            agents, weights, values = self._receive(mode, values)
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

    def _receive(self, mode: int, values: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Of the messages that come through the air: senders, weights, and values with the noise of their links."""
        block, within = divmod(self.step, STEPS_PER_BLOCK)
        values, came = values.copy(), np.ones(len(values), dtype=np.bool_)
        for d, sender in enumerate(self._neighbours[mode]):
            noise, losses = self._link(int(sender), block)
            came[d] = not losses[within]
            if noise is not None:
                values[d] += noise[within]
        if not came.all():
            self.heard = tuple(self.step if there else LOST for there in came)
        return self._neighbours[mode][came], self._weights[mode][came], values[came]


def _links(air: Air, model: Wiring, agent: int) -> Callable[[int, int], tuple[FloatArray | None, Sequence[bool]]]:
    """Of a sender and a block of steps: link noise, None without, and which messages to the agent are lost."""

    @lru_cache(maxsize=max(1, int(model.listens()[agent].sum())))
    def link(sender: int, block: int) -> tuple[FloatArray | None, Sequence[bool]]:
        noise = air.link_noise(agent, sender, block) if air.link else None
        return noise, air.losses(agent, sender, block).tolist()

    return link


def agent_law(record: RunRecord, model: Wiring, agent: int) -> AgentLaw | ProtocolLaw:
    """The law of one agent (index from 0) of a run; ``model`` is that of the record."""
    if not isinstance(model, StepModel):
        return ProtocolLaw(record, model, agent)
    kind = AgentLawOnAir if record.experiment.noise.on_air else AgentLaw
    return kind(record, model, agent)
