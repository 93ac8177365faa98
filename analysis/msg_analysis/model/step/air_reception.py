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

"""What all agents hear in steps with noise or loss on the air: ``air`` for all at once, for the twin."""

from __future__ import annotations

import numpy as np

from msg_analysis.model.arithmetic.many_steps import Reception
from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.air import Air
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.model.step.step_model import StepModel
from msg_analysis.types import BoolArray, FloatArray, IntArray


class AirReception:
    """The reception of block after block of steps; with ``logged_steps`` (N), also what is logged of it."""

    def __init__(self, experiment: ValidExperiment, model: StepModel, logged_steps: int | None = None) -> None:
        self._air = Air(experiment)
        self._model = model
        self._replicas = experiment.run.replicas
        links = np.argwhere(model.listens())  # (links, 2): receiver, sender
        self._pairs: list[list[int]] = links.tolist()
        # Number of each link; the number of links where there is none, for own values and padding.
        self._numbers = np.full((model.agents, model.agents), len(links))
        self._numbers[links[:, 0], links[:, 1]] = np.arange(len(links))
        self._published: FloatArray | None = None
        if logged_steps is not None and self._air.broadcast:
            self._published = np.empty((logged_steps + 1, model.agents, self._replicas))
        self._lost_blocks: list[BoolArray] | None = None if logged_steps is None else []

    def block(self, number: int) -> Reception:
        """Of the steps of a block."""
        air, count = self._air, len(self._pairs)
        own = np.ones((count + 1, STEPS_PER_BLOCK), dtype=np.bool_)
        for link, (i, j) in enumerate(self._pairs):
            own[link] = air.losses(i, j, number) if air.loss else False
        broadcast = link_noise = None
        if air.broadcast:
            broadcast = np.stack([air.broadcast_noise(i, number) for i in range(self._model.agents)])
        if air.link:
            # The last row is never used: it stands for own values.
            link_noise = np.zeros((count + 1, STEPS_PER_BLOCK, self._replicas))
            for link, (i, j) in enumerate(self._pairs):
                link_noise[link] = air.link_noise(i, j, number)
        return Reception(self._numbers, own, broadcast, link_noise)

    def note(self, first: int, before: FloatArray, made: FloatArray, reception: Reception) -> None:
        """Log the reception of the steps of a block from x(first) = ``before`` on, which made the states (K, m, R)."""
        if self._published is not None:
            assert reception.broadcast is not None
            states, count = np.concatenate([before[None], made[:-1]]), len(made)
            self._published[first : first + count] = states + reception.broadcast[:, :count].transpose(1, 0, 2)
        if self._lost_blocks is not None:
            self._lost_blocks.append(reception.own)

    def log(self, last: FloatArray, modes: IntArray) -> tuple[FloatArray | None, BoolArray | None]:
        """``Trajectory.published`` and ``Trajectory.lost`` of the run with these graphs (N,), which ended with x(N).

        None where there is no broadcast noise, or no loss.
        """
        if self._published is not None:
            self._published[-1] = [self._air.published(i, len(modes), state) for i, state in enumerate(last)]
        return self._published, self._losses(modes) if self._air.loss else None

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
