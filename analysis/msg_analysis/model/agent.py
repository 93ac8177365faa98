"""One agent: one row of the Markov jump linear system, and its share of the random numbers."""

from __future__ import annotations

from msg_analysis.model.noise import ProcessNoise
from msg_analysis.model.payload import combine, to_payload
from msg_analysis.model.record import RunRecord
from msg_analysis.model.step import StepModel
from msg_analysis.model.streams import STEPS_PER_BLOCK


class AgentLaw:
    """The state of one agent, as it travels, and how it moves on.

    Parameters
    ----------
    record : of the run
    model : its step model
    agent : index of the agent from 0
    """

    def __init__(self, record: RunRecord, model: StepModel, agent: int) -> None:
        self.agent = agent
        self.step = 0
        self.state = to_payload(record.start[agent])
        self._noise = ProcessNoise(record.experiment.run.seed, model.noise_gain, record.experiment.run.replicas)
        modes = range(model.modes)
        self._inputs = [[int(j) for j in model.inputs(mode, agent)] for mode in modes]
        self._own = [inputs.index(agent) for inputs in self._inputs]
        self._weights = [tuple(map(float, model.weights[mode, agent, self._inputs[mode]])) for mode in modes]
        self._offsets = [float(offset) for offset in model.offsets[:, agent]]
        self._drives = self._draw(0)

    def resume(self, step: int, state: bytes) -> None:
        """Go on from x(step). The noise is a function of the seed and the step: nothing else is needed."""
        self.step, self.state = step, state
        self._drives = self._draw(step // STEPS_PER_BLOCK)

    def neighbours(self, mode: int) -> list[int]:
        """The other agents, ascending, whose states this agent uses under a mode (index from 0)."""
        return [j for j in self._inputs[mode] if j != self.agent]

    def advance(self, mode: int, heard: list[bytes]) -> bytes:
        """Move from x(k) to x(k+1).

        Parameters
        ----------
        mode : index of g(k) from 0
        heard : x_j(k) of the mode's neighbours, ascending

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
