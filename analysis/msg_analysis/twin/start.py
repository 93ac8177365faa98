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

"""Where a run begins: x(0).

The stationary start is the end of a run before the run. Its steps have negative numbers, the same law and streams of
their own; its graphs are drawn backwards from g(0). It begins further and further back, until a beginning twice as far
back no longer changes x(0) (coupling from the past, Propp and Wilson 1996). So x(0) has the stationary law, not only
its second moments, and no linear algebra, whose last bits depend on the processor, takes part.
"""

from __future__ import annotations

import numpy as np

from msg_analysis.errors import InputError
from msg_analysis.model.arithmetic.many_steps import ManySteps
from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK, Stream, normals
from msg_analysis.model.arithmetic.update_law import weighted_sum
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.experiment.problems import problem
from msg_analysis.model.run.graph_path import past_modes
from msg_analysis.model.step.process_noise import ProcessNoise
from msg_analysis.model.step.step_model import StepModel, Wiring
from msg_analysis.twin.network_steps import law_of_all, noise_of_all, states
from msg_analysis.types import FloatArray

TOLERANCE = 2.0**-10
"""A change of x(0) this small, relative to its size, ends the search for a beginning."""

MAX_PAST = 2**16
MAX_NUMBERS = 2**24
"""Longest past, in steps and in numbers (steps x agents x replicas): a second or two of computing."""

GRID = 2.0**-12
"""Unit of x(0), in standard deviations, where the past would be longer: far more than processors differ by."""


def draw_start(experiment: ValidExperiment, model: Wiring, first_mode: int) -> FloatArray:
    """(m, replicas) x(0): zero, the given values, or drawn from the stationary law given g(0) = ``first_mode``."""
    replicas = experiment.run.replicas
    start = experiment.run.start
    if start == "zero":
        return np.zeros((experiment.agents, replicas))
    if start != "stationary":
        return np.repeat(np.array(start, dtype=float)[:, None], replicas, axis=1)
    assert isinstance(model, StepModel), "experiments without a prediction start from given values"
    found = _from_the_past(experiment, model, first_mode)
    if found is None and (reason := experiment.unpredictable()):
        wanted = f"expected 'zero' or one value per agent, since a past would take too long, and {reason}"
        raise InputError(f"{experiment.source}: {problem('run.start', 'stationary', wanted, 'give x(0)')}")
    return _gaussian(experiment, first_mode) if found is None else found


def _from_the_past(experiment: ValidExperiment, model: StepModel, first_mode: int) -> FloatArray | None:
    """x(0) at the end of a past that is long enough; None where that would take too long."""
    size = experiment.agents * experiment.run.replicas
    steps, before, law = STEPS_PER_BLOCK, None, law_of_all(experiment, model)
    noise = noise_of_all(experiment, model, kept=True)  # the past that is twice as long ends with the same steps
    while steps <= MAX_PAST and steps * size <= MAX_NUMBERS:
        start, floor = _end_of_the_past(experiment, model, law, noise, first_mode, steps)
        if before is not None and _same(start - before, start - model.reference, floor):
            return start
        before, steps = start, 2 * steps
    return None


def _end_of_the_past(
    experiment: ValidExperiment, model: StepModel, law: ManySteps, noise: ProcessNoise, first_mode: int, steps: int
) -> tuple[FloatArray, float]:
    """x(0) of a past of so many steps that begins at the reference, and the size of its rounding errors.

    In consensus only differences between agents are stationary: their average is put to 0.
    """
    state = np.full((experiment.agents, experiment.run.replicas), model.reference)
    for block in states(experiment, model, past_modes(experiment, first_mode, steps), state, -steps, law, noise):
        state = block[-1]
    rounding = 2.0**-40 * float(np.abs(state).max())
    if experiment.problem == "consensus":
        state = state - weighted_sum([1.0 / len(state)] * len(state), list(state))
    return state, rounding


def _same(change: FloatArray, size: FloatArray, floor: float) -> bool:
    """Whether no agent's change (m, R) matters beside its own size, or that of all."""
    changes, sizes = (np.sqrt((each**2).mean(axis=1)) for each in (change, size))
    return bool((changes <= TOLERANCE * np.maximum(sizes, TOLERANCE * sizes.max()) + floor).all())


def _gaussian(experiment: ValidExperiment, first_mode: int) -> FloatArray:
    """x(0) with the second moments of the stationary law, rounded so that processors agree."""
    from msg_analysis.theory.prediction import stationary_start_factor  # here, since it is seldom needed

    replicas = experiment.run.replicas
    factor = stationary_start_factor(experiment, first_mode)
    factor[np.isinf(experiment.leader_gains)] *= experiment.time == "discrete"  # a grounded leader has no error
    sources = [normals(experiment.run.seed, Stream.START, j, 0, (replicas,)) for j in range(experiment.agents)]
    deviations = np.array([weighted_sum([float(w) for w in row], sources) for row in factor])
    sizes = np.sqrt((factor**2).sum(axis=1, keepdims=True))
    units = GRID * 2.0 ** np.floor(np.log2(sizes, out=np.zeros_like(sizes), where=sizes > 0.0))
    return np.asarray(np.rint(deviations / units) * units + experiment.reference)
