"""The steps of all agents at once: the same sums as those of the single agents, to the last bit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK
from msg_analysis.model.arithmetic.update_law import step
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.air_reception import AirReception, padded_inputs
from msg_analysis.model.step.process_noise import ProcessNoise
from msg_analysis.model.step.step_model import StepModel
from msg_analysis.twin.ideal_timers import IdealTimers
from msg_analysis.types import FloatArray, IntArray


def states(
    experiment: ValidExperiment,
    model: StepModel,
    modes: IntArray,
    start: FloatArray,
    first: int = 0,
    reception: AirReception | None = None,
) -> Iterator[FloatArray]:
    """x(first + 1), x(first + 2), ..., each (m, R), from x(first) under the graphs ``modes`` from there on.

    ``first`` is a multiple of STEPS_PER_BLOCK; steps before a run are negative. ``reception``: one that keeps a log.
    """
    drives = _drives(experiment, model, modes, first)
    if experiment.run.pace == "realtime":
        return IdealTimers(experiment, model).states(modes, start, drives)
    if experiment.noise.on_air and reception is None:
        reception = AirReception(experiment, model)
    return _synchronous(model, modes, start, drives, reception, first)


def _drives(experiment: ValidExperiment, model: StepModel, modes: IntArray, first: int) -> Iterator[FloatArray]:
    """For every step of a path of graphs, (m, R): the noise of all agents, plus what the reference adds."""
    noise = ProcessNoise(experiment.run.seed, model.noise_gain, experiment.run.replicas)
    offsets = [offset[:, None] for offset in model.offsets]
    for k, mode in enumerate(modes, start=first):
        within = k % STEPS_PER_BLOCK
        if within == 0:
            noises = [noise.block(i, k // STEPS_PER_BLOCK) for i in range(model.agents)]
            drives: dict[int, FloatArray] = {}
        if mode not in drives:
            drives[mode] = np.stack([of_agent[mode] for of_agent in noises], axis=1) + offsets[mode]
        yield drives[mode][within]


def _synchronous(
    model: StepModel,
    modes: IntArray,
    start: FloatArray,
    drives: Iterator[FloatArray],
    reception: AirReception | None,
    first: int,
) -> Iterator[FloatArray]:
    rows = [_padded_rows(model, mode) for mode in range(model.modes)]
    state = start
    for k, (mode, drive) in enumerate(zip(modes, drives, strict=True), start=first):
        weights, inputs = rows[mode]
        values = reception.values(k, mode, state) if reception else [state[j] for j in inputs]
        state = step(weights, values, drive)
        yield state


def _padded_rows(model: StepModel, mode: int) -> tuple[list[FloatArray], list[IntArray]]:
    """All rows of W_mode at once: its d-th entries list holds every agent's d-th input, ascending, padded with zeros.

    Adding 0 * x at the end of a row changes nothing, so every row comes out as the agent computes it alone.
    """
    columns, there = padded_inputs(model, mode)
    weights = np.where(there, model.nominal[mode, np.arange(model.agents), columns], 0.0)
    return list(weights[:, :, None]), list(columns)
