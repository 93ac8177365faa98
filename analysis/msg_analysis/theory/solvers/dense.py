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

"""The coupled equations as one dense matrix on the half-vectorised unknowns: the reference for small systems.

One LU factorisation serves the steady moments and every dual; the cost grows as (n d (d + 1) / 2)^3.
The equations are those of Propositions 2 and 3 of the paper (7 and 8 in discrete time).
"""

from __future__ import annotations

import warnings
from typing import Literal

import numpy as np
import scipy.linalg

from msg_analysis.errors import InputError
from msg_analysis.theory.solvers.moment_operators import mode_operators
from msg_analysis.theory.solvers.solver_report import MAX_RELATIVE_ERROR, SolverReport, singular_message
from msg_analysis.theory.system import packed_symmetric
from msg_analysis.theory.system.jump_system import JumpSystem
from msg_analysis.types import FloatArray

MAX_UNKNOWNS = 10_000  # largest system that is tried: 2.4 GB and about a minute


class DenseSolver:
    """The coupled equations of ``MomentSolver``, factorised. InputError: too large, singular or too ill-conditioned.

    The last block row is replaced by the sum of all of them, in which the chain cancels exactly, and rows are scaled
    to largest entry 1: so the equations stay well conditioned however fast the graphs switch.
    """

    def __init__(self, system: JumpSystem) -> None:
        self._system = system
        n, p = system.modes, packed_symmetric.size(system.dimension)
        if n * p > MAX_UNKNOWNS:
            raise InputError(
                f"second moments: {n} graphs of {len(system.lift)} agents give {n * p} coupled unknowns, for "
                f"which a dense solve needs about {24e-9 * (n * p) ** 2:.1f} GB; at most {MAX_UNKNOWNS} are "
                "solved: leave the choice of the method to the program, or use fewer agents or graphs"
            )
        local, flow = mode_operators(system), system.chain.T
        matrix = np.zeros((n, p, n, p))
        for j in range(n):
            if system.time == "continuous":
                matrix[:, range(p), j, range(p)] = -flow[:, j, None]
                matrix[j, :, j, :] += local[j]
            else:
                matrix[:, :, j, :] = flow[:, j, None, None] * (local[j] - np.eye(p))
                matrix[j, range(p), j, range(p)] += 1.0
            matrix[-1, :, j, :] = local[j]
        self._matrix = matrix.reshape(n * p, n * p)
        scale = np.maximum(self._matrix.max(axis=1, initial=0.0), -self._matrix.min(axis=1, initial=0.0))
        self._scale = 1.0 / np.where(scale > 0.0, scale, 1.0)
        self._matrix *= self._scale[:, None]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)  # the condition is judged below
            self._factors = scipy.linalg.lu_factor(self._matrix)
        self._norm = float(np.linalg.norm(self._matrix, 1)) if self._matrix.size else 0.0
        self._condition = _reciprocal_condition(self._factors[0], self._norm)
        self._shape = (n, p)
        self.report: SolverReport | None = None
        self._check(float(np.finfo(float).eps))

    def steady(self) -> FloatArray:
        """See ``MomentSolver.steady``."""
        system = self._system
        weighted = packed_symmetric.pack(system.stationary[:, None, None] * system.noise)
        right = weighted.copy() if system.time == "continuous" else system.chain.T @ weighted
        right[-1] = weighted.sum(axis=0)
        solution, self.report = self._solve(right.reshape(-1, 1) * self._scale[:, None], trans=0)
        return packed_symmetric.unpack(solution.reshape(self._shape), system.dimension)

    def dual(self, forms: FloatArray) -> FloatArray:
        """See ``MomentSolver.dual``."""
        n, p = self._shape
        right = np.tile(packed_symmetric.pack(forms), (1, n)).T
        solution, _ = self._solve(right, trans=1)
        blocks = (solution * self._scale[:, None]).reshape(n, p, -1)
        blocks[:-1] += blocks[-1]  # transpose of "replace the last row by the sum"
        return packed_symmetric.unpack(np.moveaxis(blocks, 2, 0), self._system.dimension)

    def _solve(self, right: FloatArray, *, trans: Literal[0, 1]) -> tuple[FloatArray, SolverReport]:
        matrix = self._matrix.T if trans else self._matrix
        solution = scipy.linalg.lu_solve(self._factors, right, trans=trans)
        residual = right - matrix @ solution
        solution += scipy.linalg.lu_solve(self._factors, residual, trans=trans)
        residual = np.abs(right - matrix @ solution).max(initial=0.0)
        given = np.abs(right).max(initial=0.0)
        size = self._norm * np.abs(solution).max(initial=0.0) + given
        backward = float(residual / size) if size > 0.0 else 0.0
        self._check(backward)
        relative = float(residual / given) if given > 0.0 else 0.0
        return np.asarray(solution), SolverReport("dense", "none", 1, relative, backward, backward / self._condition)

    def _check(self, backward: float) -> None:
        """Refuse equations that are too ill-conditioned for this backward error."""
        # Not ">": NaN must be refused, too.
        if self._matrix.size and not backward <= MAX_RELATIVE_ERROR * self._condition:
            raise InputError(singular_message(f" (reciprocal condition {self._condition:.1e})"))


def _reciprocal_condition(factors: FloatArray, norm: float) -> float:
    if factors.size == 0:
        return 1.0
    reciprocal, _ = scipy.linalg.lapack.dgecon(factors, norm)
    return float(reciprocal)
