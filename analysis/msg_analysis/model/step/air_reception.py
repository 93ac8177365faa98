"""What all agents hear in a step with noise or loss on the air: ``air`` for all at once, for the twin."""

from __future__ import annotations

import numpy as np

from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.air import Air
from msg_analysis.model.step.neighbours import neighbour_tables
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
    """The values that go into ``law.step``, step after step; with ``logged_steps`` (N), also what is logged of them."""

    def __init__(self, experiment: ValidExperiment, model: StepModel, logged_steps: int | None = None) -> None:
        self._air = Air(experiment)
        self._model = model
        self._replicas = experiment.run.replicas
        self._links = np.argwhere(model.listens())  # (links, 2): receiver, sender
        # Number of each link; the number of links where there is none, for own values and padding.
        self._numbers = np.full((model.agents, model.agents), len(self._links))
        self._numbers[self._links[:, 0], self._links[:, 1]] = np.arange(len(self._links))
        self._padded = [padded_inputs(model, mode)[0] for mode in range(model.modes)]
        self._used = [self._link_numbers(mode) for mode in range(model.modes)]
        self._block: int | None = None
        self._published: FloatArray | None = None
        if logged_steps is not None and self._air.broadcast:
            self._published = np.empty((logged_steps + 1, model.agents, self._replicas))
        self._lost_blocks: list[BoolArray] | None = None if logged_steps is None else []

    def values(self, k: int, mode: int, state: FloatArray) -> list[FloatArray]:
        """For each d, (m, replicas): what every agent uses for its d-th input in step k; see ``padded_inputs``.

        ``state`` is x(k), (m, replicas). ``k`` must not go back to an earlier block of steps.
        """
        within = self._draw(k)
        used = self._used[mode]
        heard = self._heard(k, state)[self._padded[mode]]
        if self._air.link:
            heard += self._noise[used, within]
        return list(np.where(self._own[used, within, None], state, heard))

    def log(self, last: FloatArray, modes: IntArray) -> tuple[FloatArray | None, BoolArray | None]:
        """``Trajectory.published`` and ``Trajectory.lost`` of the run with these graphs (N,), which ended with x(N).

        None where there is no broadcast noise, or no loss.
        """
        if self._air.broadcast:
            self._draw(len(modes))
            self._heard(len(modes), last)
        return self._published, self._losses(modes) if self._air.loss else None

    def _heard(self, k: int, state: FloatArray) -> FloatArray:
        """(m, replicas): what is published of x(k)."""
        if not self._air.broadcast:
            return state
        published = state + self._broadcast[:, k % STEPS_PER_BLOCK]
        if self._published is not None:
            self._published[k] = published
        return np.asarray(published)

    def _losses(self, modes: IntArray) -> BoolArray:
        assert self._lost_blocks is not None
        agents = np.arange(self._model.agents)
        numbers = self._numbers[agents[:, None], neighbour_tables(self._model).senders]  # (n, m, D)
        lost = np.empty((len(modes), *numbers.shape[1:]), dtype=np.bool_)
        for block, drawn in enumerate(self._lost_blocks):
            first, last = block * STEPS_PER_BLOCK, min(len(modes), (block + 1) * STEPS_PER_BLOCK)
            drawn[-1] = False  # padding, no link
            lost[first:last] = drawn[numbers[modes[first:last]], np.arange(last - first)[:, None, None]]
        return lost

    def _link_numbers(self, mode: int) -> IntArray:
        """(d, m) number of the link of each padded input."""
        columns, there = padded_inputs(self._model, mode)
        return np.where(there, self._numbers[np.arange(self._model.agents), columns], len(self._links))

    def _draw(self, k: int) -> int:
        """Draw the random numbers of the block of step k, unless done; the index of the step in its block."""
        block, within = divmod(k, STEPS_PER_BLOCK)
        if block != self._block:
            self._block = block
            air, links = self._air, self._links.tolist()
            # Which messages are lost; the last row, for an agent's own value, is True.
            self._own = np.ones((len(links) + 1, STEPS_PER_BLOCK), dtype=np.bool_)
            for number, (i, j) in enumerate(links):
                self._own[number] = air.losses(i, j, block) if air.loss else False
            if air.loss and self._lost_blocks is not None:
                self._lost_blocks.append(self._own)
            if air.broadcast:
                agents = range(self._model.agents)
                self._broadcast = np.stack([air.broadcast_noise(i, block) for i in agents])
            if air.link:
                # The last row is never used: it stands for own values.
                self._noise = np.zeros((len(links) + 1, STEPS_PER_BLOCK, self._replicas))
                for number, (i, j) in enumerate(links):
                    self._noise[number] = air.link_noise(i, j, block)
        return within
