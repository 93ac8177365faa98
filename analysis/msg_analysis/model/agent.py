"""One agent: one row of the Markov jump linear system, and its share of the random numbers."""

from __future__ import annotations

from functools import lru_cache

from msg_analysis.model.air import LOST, Air
from msg_analysis.model.noise import ProcessNoise
from msg_analysis.model.payload import combine, from_payload, to_payload
from msg_analysis.model.record import RunRecord
from msg_analysis.model.step import StepModel
from msg_analysis.model.streams import STEPS_PER_BLOCK
from msg_analysis.types import FloatArray


class AgentLaw:
    """The state of one agent, as it travels, and how it moves on.

    Parameters
    ----------
    record : of the run
    model : its step model
    agent : index of the agent from 0

    Attributes
    ----------
    step, state : k and x(k)
    heard : for the neighbours of the step that led here, ascending: the step of the value that was used, or ``LOST``;
        empty when all of them were of the step before
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
        """Go on from x(step). The noise is a function of the seed and the step: nothing else is needed."""
        self.step, self.state = step, state
        self._drives = self._draw(step // STEPS_PER_BLOCK)

    def neighbours(self, mode: int) -> list[int]:
        """The other agents, ascending, whose states this agent uses under a mode (index from 0)."""
        return [j for j in self._inputs[mode] if j != self.agent]

    def published(self, step: int, state: bytes) -> bytes:  # noqa: ARG002  what is published is the truth
        """What is published of x(step)."""
        return state

    def advance(self, mode: int, heard: list[bytes]) -> bytes:
        """Move from x(k) to x(k+1).

        Parameters
        ----------
        mode : index of g(k) from 0
        heard : what the mode's neighbours, ascending, published of x_j(k)

        Returns
        -------
        x(k+1)
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
    """The same where something becomes of the values between the agents: see ``model.air``."""

    def __init__(self, record: RunRecord, model: StepModel, agent: int) -> None:
        super().__init__(record, model, agent)
        self._air = air = Air(record.experiment)
        self._neighbours = [self.neighbours(mode) for mode in range(model.modes)]
        links = int(model.listens()[agent].sum())

        @lru_cache(maxsize=max(1, links))
        def link(sender: int, block: int) -> tuple[FloatArray | None, list[bool]]:
            noise = air.link_noise(agent, sender, block) if air.link else None
            return noise, air.losses(agent, sender, block).tolist()

        self._link = link

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


def agent_law(record: RunRecord, model: StepModel, agent: int) -> AgentLaw:
    """The law of one agent of a run: see AgentLaw for the parameters."""
    kind = AgentLawOnAir if record.experiment.noise.on_air else AgentLaw
    return kind(record, model, agent)
