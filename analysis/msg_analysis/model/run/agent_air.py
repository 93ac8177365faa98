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

"""The air as one agent hears it: which message it uses, and with which noise."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache

from msg_analysis.model.arithmetic.payload import from_payload, to_payload
from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.air import LOST, NOTHING, Air
from msg_analysis.model.step.step_model import Wiring
from msg_analysis.types import FloatArray


class AgentAir:
    """What happens to the messages of an agent (index from 0) and to those for it; see ``model.step.air``."""

    def __init__(self, experiment: ValidExperiment, model: Wiring, agent: int) -> None:
        self._agent = agent
        self._air = air = Air(experiment)
        self.delay, self.broadcast, self.link, self.loss = air.delay, air.broadcast, air.link, air.loss
        # The newest message and the one that is used may be in two blocks.
        links = 2 * max(1, int(model.listens()[agent].sum()))

        @lru_cache(maxsize=links)
        def sources(sender: int, block: int) -> list[int]:
            return air.sources(agent, sender, block).tolist() if air.loss else _own_steps(block)

        @lru_cache(maxsize=links)
        def noise(sender: int, block: int) -> FloatArray:
            return air.link_noise(agent, sender, block)

        self._sources, self._noise = sources, noise

    @property
    def looks_back(self) -> bool:
        """Whether steps can use messages of earlier steps than the newest."""
        return self.delay > 0 or self._air.holds

    def source(self, sender: int, newest: int) -> int:
        """Step of the message that is used when the newest one is of the step ``newest``; NOTHING: the own value."""
        block, within = divmod(max(0, newest - self.delay), STEPS_PER_BLOCK)
        return self._sources(sender, block)[within]

    def lost(self, sender: int, step: int) -> bool:
        """Whether the message of a step is lost."""
        return self._sources(sender, step // STEPS_PER_BLOCK)[step % STEPS_PER_BLOCK] != step

    def needed(self, sender: int, step: int) -> int:
        """Step of the message that an agent waits for to make a step in lockstep: it may be lost all the same."""
        return self.source(sender, step) if self._air.holds else max(0, step - self.delay)

    def oldest_needed(self, step: int, peers: Iterable[int]) -> int:
        """First step of which a message between the agent and one of its peers is used in a step from ``step`` on."""
        oldest = max(0, step - self.delay)
        if not self._air.holds:
            return oldest
        block, within = divmod(oldest, STEPS_PER_BLOCK)
        links = [link for j in peers for link in ((self._agent, j), (j, self._agent))]
        return min((int(self._air.sources(*link, block)[within]) for link in links), default=oldest)

    def receive(
        self, senders: Sequence[int], step: int, heard: Sequence[bytes], steps: Sequence[int] | None
    ) -> tuple[list[bytes | None], tuple[int, ...]]:
        """What is received of these senders in a step, None where the own value is used; and ``AgentLaw.heard``.

        ``heard`` and ``steps`` as in ``AgentLaw.advance``. Hot path.
        """
        logged: tuple[int, ...] = ()
        if steps is None:
            newest = max(0, step - self.delay)
            block, within = divmod(newest, STEPS_PER_BLOCK)
            steps = [self._sources(sender, block)[within] for sender in senders]
            if steps != [newest] * len(steps):
                logged = tuple([LOST if source == NOTHING else source for source in steps])
        values: list[bytes | None] = [*heard]
        for d, source in enumerate(steps):
            if source == NOTHING:
                values[d] = None
            elif self.link:
                values[d] = self._received(senders[d], source, heard[d])
        return values, logged

    def _received(self, sender: int, step: int, value: bytes) -> bytes:
        """A published value, a payload, with the noise of the link."""
        block, within = divmod(step, STEPS_PER_BLOCK)
        return to_payload(from_payload(value) + self._noise(sender, block)[within])

    def published(self, step: int, value: FloatArray) -> bytes:
        """The payload that is published of a value (replicas,)."""
        return to_payload(self._air.published(self._agent, step, value) if self.broadcast else value)


def _own_steps(block: int) -> list[int]:
    return list(range(block * STEPS_PER_BLOCK, (block + 1) * STEPS_PER_BLOCK))
