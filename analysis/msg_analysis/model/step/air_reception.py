"""What all agents hear in a step with noise or loss on the air: the vectorised part of ``model.air``, for the twin."""

from __future__ import annotations

import numpy as np

from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK
from msg_analysis.model.experiment.experiment import Experiment
from msg_analysis.model.step.air import Air
from msg_analysis.model.step.step_model import StepModel
from msg_analysis.types import BoolArray, FloatArray, IntArray


def padded_inputs(model: StepModel, mode: int) -> tuple[IntArray, BoolArray]:
    """(d, m) the d-th input of every agent (agents from 0, ascending), padded with 0; and which entries are inputs."""
    inputs = [model.inputs(mode, i) for i in range(model.agents)]
    columns = np.zeros((max(len(row) for row in inputs), model.agents), dtype=np.int64)
    there = np.zeros(columns.shape, dtype=np.bool_)
    for i, row in enumerate(inputs):
        columns[: len(row), i] = row
        there[: len(row), i] = True
    return columns, there


class AirReception:
    """The values that go into ``law.step``, step after step, and what is logged of them."""

    def __init__(self, experiment: Experiment, model: StepModel) -> None:
        self._air = Air(experiment)
        self._model = model
        self._replicas = experiment.run.replicas
        self._links = np.argwhere(model.listens())  # (links, 2): receiver, sender
        self._padded = [padded_inputs(model, mode) for mode in range(model.modes)]
        self._used = [self._link_numbers(*padded) for padded in self._padded]
        self._block: int | None = None

    def values(self, k: int, mode: int, state: FloatArray) -> list[FloatArray]:
        """For each d, (m, replicas): what every agent uses for its d-th input in step k; see ``padded_inputs``.

        ``state`` is x(k), (m, replicas). ``k`` must not go back to an earlier block of steps.
        """
        within = self._draw(k)
        air, (columns, _), used = self._air, self._padded[mode], self._used[mode]
        heard = (state + self._broadcast[:, within] if air.broadcast else state)[columns]
        if air.link:
            heard += self._noise[used, within]
        return list(np.where(self._own[used, within, None], state, heard))

    def log(self, states: FloatArray, modes: IntArray) -> tuple[FloatArray | None, BoolArray | None]:
        """``Trajectory.published`` and ``Trajectory.lost`` of a run: states (N + 1, m, replicas), modes (N,).

        None where there is no broadcast noise, or no loss.
        """
        air, agents = self._air, self._model.agents
        published = None
        if air.broadcast:
            published = states.copy()
            for first in range(0, len(states), STEPS_PER_BLOCK):
                part = published[first : first + STEPS_PER_BLOCK]
                for i in range(agents):
                    part[:, i] += air.broadcast_noise(i, first // STEPS_PER_BLOCK)[: len(part)]
        return published, self._losses(modes) if air.loss else None

    def _losses(self, modes: IntArray) -> BoolArray:
        links = {link: number for number, link in enumerate(map(tuple, self._links.tolist()))}
        numbers = np.full((self._model.modes, self._model.agents, self._model.most_neighbours), len(links))
        for mode in range(self._model.modes):
            for i in range(self._model.agents):
                neighbours = self._model.neighbours(mode, i).tolist()
                numbers[mode, i, : len(neighbours)] = [links[i, j] for j in neighbours]
        lost = np.empty((len(modes), *numbers.shape[1:]), dtype=np.bool_)
        for first in range(0, len(modes), STEPS_PER_BLOCK):
            drawn = self._lost(first // STEPS_PER_BLOCK)
            drawn[-1] = False  # padding, no link
            last = min(len(modes), first + STEPS_PER_BLOCK)
            within = np.arange(last - first)[:, None, None]
            lost[first:last] = drawn[numbers[modes[first:last]], within]
        return lost

    def _link_numbers(self, columns: IntArray, there: BoolArray) -> IntArray:
        """(d, m) number of the link of each padded input; the number of links for own values and padding."""
        agents = self._model.agents
        numbers = np.full((agents, agents), len(self._links))
        numbers[self._links[:, 0], self._links[:, 1]] = np.arange(len(self._links))
        return np.where(there, numbers[np.arange(agents), columns], len(self._links))

    def _draw(self, k: int) -> int:
        """Draw the random numbers of the block of step k, unless done; the index of the step in its block."""
        block, within = divmod(k, STEPS_PER_BLOCK)
        if block != self._block:
            self._block = block
            air, links = self._air, self._links.tolist()
            self._own = self._lost(block)
            if air.broadcast:
                agents = range(self._model.agents)
                self._broadcast = np.stack([air.broadcast_noise(i, block) for i in agents])
            if air.link:
                # The last row is never used: it stands for own values.
                self._noise = np.zeros((len(links) + 1, STEPS_PER_BLOCK, self._replicas))
                for number, (i, j) in enumerate(links):
                    self._noise[number] = air.link_noise(i, j, block)
        return within

    def _lost(self, block: int) -> BoolArray:
        """(links + 1, STEPS_PER_BLOCK): which messages are lost; the last row, for an agent's own value, is True."""
        lost = np.ones((len(self._links) + 1, STEPS_PER_BLOCK), dtype=np.bool_)
        for number, (i, j) in enumerate(self._links.tolist()):
            lost[number] = self._air.losses(i, j, block) if self._air.loss else False
        return lost
