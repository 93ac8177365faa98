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

"""The random matrix of a step, as stages: in each, some messages may be lost, independently of each other.

In a stage, z becomes (M + sum_e eta_e u_e v_e^T) z, with eta_e = 1 - p_e if message e arrives and -p_e if it is lost,
which happens with probability p_e. M is the mean, u_e what the message acts on, v_e the difference between what it
brings and what takes its place. The noise is left out. See docs/theory.md, "Messages one by one".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_analysis.model.step.step_model import StepModel
from msg_analysis.theory.system.jump_system import JumpSystem
from msg_analysis.theory.system.message_steps import Move, message_steps
from msg_analysis.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """Messages that are used, or lost, at the same time; E of them may be lost."""

    matrix: FloatArray  # (k, k) M
    into: FloatArray  # (E, k) u
    differences: FloatArray  # (E, k) v
    losses: FloatArray  # (E,) p


@dataclass(frozen=True, slots=True, eq=False)
class RandomSteps:
    """Steps of a jump linear system: y (d,) is embedded as z (k,), goes through the stages, and is read again."""

    chain: FloatArray  # (n, n) P
    stages: list[list[Stage]]  # of each mode
    # (k, d) with orthonormal columns: z = embedding @ y before, y = embedding^T z after; None: z is y
    embedding: FloatArray | None

    @property
    def shape(self) -> tuple[int, int]:
        """Modes n, and dimension d."""
        k = len(self.stages[0][0].matrix)
        return len(self.chain), k if self.embedding is None else self.embedding.shape[1]


def random_steps(step: StepModel, system: JumpSystem) -> RandomSteps:
    """The steps of ``system``, which ``jump_system.emulated`` made of ``step``.

    Parameters
    ----------
    step
        in real time that of the sequential law
    system
        its reduced system, whose coordinates y are used

    Raises
    ------
    InputError
        as of ``message_steps``
    """
    if step.by_message:
        whole = message_steps(step)
        embedding = np.zeros((whole.entries, system.dimension))
        embedding[whole.kept] = system.lift
        stages = [[_stage(move, whole.entries) for move in moves] for moves in whole.moves]
        return RandomSteps(system.chain, stages, embedding)
    lift = system.lift
    older = len(lift) - step.agents  # the states that others use come last; without a delay they are the only ones
    stages = []
    for mode, matrix in enumerate(system.matrices):
        possible = step.loss_variance[mode] > 0.0
        i, j = np.nonzero(possible)
        into = step.nominal[mode][possible][:, None] * lift[i]
        stages.append([Stage(matrix, into, lift[older + j] - lift[i], step.losses[possible])])
    return RandomSteps(system.chain, stages, None)


def _stage(move: Move, size: int) -> Stage:
    matrix = np.eye(size)
    matrix[move.rows] = move.matrix
    into, differences = np.zeros((2, len(move.losses), size))
    for event, (entry, brings, instead, _, weight) in enumerate(move.losses):
        into[event, entry] = weight
        differences[event, brings] += 1.0
        differences[event, instead] -= 1.0
    return Stage(matrix, into, differences, np.array([loss[3] for loss in move.losses]))
