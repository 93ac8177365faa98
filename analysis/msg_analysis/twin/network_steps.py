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

"""The steps of all agents at once: the same sums as those of the single agents, to the last bit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from msg_analysis.model.arithmetic.many_steps import ManySteps, Round
from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.air_reception import AirReception, ahead
from msg_analysis.model.step.process_noise import ProcessNoise
from msg_analysis.model.step.step_model import StepModel
from msg_analysis.types import BoolArray, FloatArray, IntArray


def law_of_all(experiment: ValidExperiment, model: StepModel) -> ManySteps:
    """The steps of all agents under every graph."""
    lead = ahead(experiment).astype(np.bool_)
    holds = model.listens() if experiment.noise.holds else None
    return ManySteps([_rounds(model, mode, lead, holds) for mode in range(model.modes)])


def noise_of_all(experiment: ValidExperiment, model: StepModel, *, kept: bool = False) -> ProcessNoise:
    """The process noise of all agents; ``kept`` as of ``ProcessNoise``."""
    return ProcessNoise(experiment.run.seed, model.noise_gain, experiment.run.replicas, kept=kept)


def states(
    experiment: ValidExperiment,
    model: StepModel,
    modes: IntArray,
    start: FloatArray,
    first: int = 0,
    law: ManySteps | None = None,
    noise: ProcessNoise | None = None,
) -> Iterator[FloatArray]:
    """x(first + 1), x(first + 2), ..., from x(first) under the graphs ``modes`` from there on, in blocks (k, m, R).

    ``first`` is a multiple of STEPS_PER_BLOCK; steps before a run are negative. ``law`` and ``noise``: as of
    ``law_of_all`` and ``noise_of_all``.
    """
    air = AirReception(experiment, model, start, first) if experiment.noise.steps_only else None
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


def _padded_inputs(model: StepModel, mode: int) -> tuple[IntArray, BoolArray]:
    """(d, m) the d-th input of every agent (agents from 0, ascending), padded with 0; and which entries are inputs."""
    inputs = [model.inputs(mode, i) for i in range(model.agents)]
    columns = np.zeros((max(len(row) for row in inputs), model.agents), dtype=np.int64)
    there = np.zeros(columns.shape, dtype=np.bool_)
    for i, row in enumerate(inputs):
        columns[: len(row), i] = row
        there[: len(row), i] = True
    return columns, there


def _rounds(model: StepModel, mode: int, lead: BoolArray, heard: BoolArray | None) -> list[Round]:
    """The agents in rounds: each in the first one after those that step before it (``lead``) and that it uses.

    ``heard`` (m, m): whom it hears whatever the graph, and must wait for, too.
    """
    m, every = model.agents, np.arange(model.agents)
    columns, there = _padded_inputs(model, mode)
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
