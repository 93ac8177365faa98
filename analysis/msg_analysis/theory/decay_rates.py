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

"""How fast the effect of the start dies out in the end.

See docs/theory.md, "Transients".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse.linalg

from msg_analysis.errors import InputError
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.solvers.iterative import IterativeSolver
from msg_analysis.theory.solvers.moment_operators import homogeneous_propagator, mean_propagator
from msg_analysis.theory.solvers.rational_krylov import RationalFlow, slowest_rate
from msg_analysis.theory.system import packed_symmetric
from msg_analysis.theory.system.components import Component, components
from msg_analysis.theory.system.jump_system import JumpSystem
from msg_analysis.theory.transient import MAX_UNKNOWNS, Snapshot, joint_stack, unknowns
from msg_analysis.types import FloatArray

CERTAIN = 1e-6  # largest relative change of a rate by changes of the matrices of relative size ``components.CHANGE``
MAX_ARNOLDI = 10_000  # unknowns in continuous time: each of some 50 iterations solves the coupled equations


@dataclass(frozen=True, slots=True)
class Rates:
    """Rates, like exp(-rate t), or exp(-rate k) in steps; infinite for what is gone in finitely many steps.

    None: not found, or so sensitive to the last digits of the matrices that rounding may have made it.
    """

    mean: float | None  # of the means: least real part of the eigenvalues of N, or -log of the spectral radius of H
    second_moment: float | None  # the same of M, or A
    graph: float | None  # of the law of the graph; None for one graph


def asymptotic_rates(system: JumpSystem) -> Rates:
    """Rates of a reduced system, per unit of time or per step.

    From the eigenvalues of the matrices of Propositions 1 and 6 of the paper, for each strongly connected component;
    where one is large, those of its second moments are found in a Krylov space.
    """
    parts = components(system)
    graph = mean_propagator(system).slowest_jump if system.modes > 1 else None
    return Rates(_slowest(system, parts, _methods_of_means), _slowest(system, parts, _methods_of_second_moments), graph)


Method = Callable[[JumpSystem, np.random.Generator | None], float | None]
"""Gives a rate; by a chance of its own where it begins somewhere."""


def _slowest(
    system: JumpSystem, parts: list[Component], methods_of: Callable[[JumpSystem], Iterator[Method]]
) -> float | None:
    """Rate of the slowest component; None if one of them is not certain."""
    slowest = math.inf
    for part in parts:
        reduced = part.system(system)
        rate = _certain(system, part, reduced, methods_of(reduced))
        if rate is None:
            return None
        slowest = min(slowest, rate)
    return slowest


def _certain(system: JumpSystem, part: Component, reduced: JumpSystem, methods: Iterator[Method]) -> float | None:
    """The first rate that another rounding and another beginning would have given too."""
    for method in methods:
        rate = method(reduced, None)
        if rate is None or part.normal:
            return rate
        rng = np.random.default_rng(0)
        other = method(part.changed(rng).system(system), rng)
        if other is not None and (rate == other or abs(other - rate) <= CERTAIN * abs(rate)):
            return rate
    return None


def _methods_of_means(_: JumpSystem) -> Iterator[Method]:
    yield lambda system, _: mean_propagator(system).slowest


def _methods_of_second_moments(system: JumpSystem) -> Iterator[Method]:
    if unknowns(system) <= MAX_UNKNOWNS:
        yield lambda system, _: homogeneous_propagator(system).slowest
    elif system.time == "discrete":
        yield _by_arnoldi
    else:
        yield _by_rational_krylov
        if unknowns(system) <= MAX_ARNOLDI:
            yield _by_arnoldi


def _by_rational_krylov(system: JumpSystem, rng: np.random.Generator | None) -> float | None:
    """From the steady second moments of some noise; close, but how close is not known. Continuous time."""
    sizes = np.ones(system.dimension) if rng is None else rng.uniform(0.1, 10.0, system.dimension)
    try:
        steady = MomentSolver(replace(system, noise=np.stack([np.diag(sizes)] * system.modes))).steady()
    except InputError:
        return None
    stack = joint_stack(Snapshot(np.zeros(system.modes), np.zeros(0), steady))
    return RationalFlow(system, stack, slowest_rate(system, steady), decays=True).slowest


def _by_arnoldi(system: JumpSystem, _: np.random.Generator | None) -> float | None:
    """From the largest eigenvalue of A, or of the inverse of M, which is that of the slowest part.

    Both maps are positive, so no other eigenvalue is larger in size.
    """
    shape = (system.modes, packed_symmetric.size(system.dimension))

    def forward(packed: FloatArray) -> FloatArray:
        moments = packed_symmetric.unpack(packed.reshape(shape), system.dimension)
        after = np.tensordot(system.chain, system.propagate(moments), axes=(0, 0))
        return packed_symmetric.pack(after).ravel()

    def inverse(packed: FloatArray) -> FloatArray:
        moments = packed_symmetric.unpack(packed.reshape(shape), system.dimension)
        noise = moments / system.stationary[:, None, None]
        return packed_symmetric.pack(solver.steady(noise)).ravel()

    size = math.prod(shape)
    start = packed_symmetric.pack(np.broadcast_to(np.eye(system.dimension), system.matrices.shape)).ravel()
    try:
        step = forward
        if system.time == "continuous":
            step, solver = inverse, IterativeSolver(system)
        operator = scipy.sparse.linalg.LinearOperator((size, size), matvec=step, dtype=float)
        values = scipy.sparse.linalg.eigs(operator, k=1, v0=start, tol=1e-9, maxiter=1000, return_eigenvectors=False)
    except (scipy.sparse.linalg.ArpackNoConvergence, InputError):
        return None
    radius = float(np.abs(values).max())
    if system.time == "continuous":
        return 1.0 / radius
    return -math.log(radius) if radius > 0.0 else math.inf
