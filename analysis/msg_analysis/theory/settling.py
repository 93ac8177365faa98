# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""How fast errors settle: asymptotic decay rates, and the settling time from a given start.

See docs/theory.md, "Transients".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse.linalg

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.experiment.markov_chain import Time
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.first_steps import MomentsAt, Start
from msg_analysis.theory.jump_system import Component, JumpSystem, components
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.propagator import Flow, Power
from msg_analysis.theory.rational_krylov import RationalFlow, slowest_rate
from msg_analysis.theory.solvers import IterativeSolver, homogeneous_propagator, mean_propagator
from msg_analysis.theory.transient import MAX_UNKNOWNS, advance, distance, joint_flow, joint_stack, unknowns

CERTAIN = 1e-6  # largest relative change of a rate by changes of the matrices of relative size ``components.CHANGE``
MAX_ARNOLDI = 10_000  # unknowns in continuous time: each of some 50 iterations solves the coupled equations


@dataclass(frozen=True, slots=True)
class Rates:
    """Rates, like exp(-rate t), or exp(-rate k) in steps; infinite for what is gone in finitely many steps."""

    # None: not found, or so sensitive to the last digits of the matrices that rounding may have made it.
    mean: float | None  # of the means: least real part of the eigenvalues of N, or -log of the spectral radius of H
    second_moment: float | None  # the same of M, or A
    graph: float | None  # of the law of the graph; None for one graph


def asymptotic_rates(system: JumpSystem, *, most_unknowns: int = MAX_UNKNOWNS) -> Rates:
    """Rates of a reduced system, per unit of time or per step.

    From the eigenvalues of the matrices of Propositions 1 and 6 of the paper, for each strongly connected component;
    where one is large, those of its second moments are found in a Krylov space.
    """

    def of_means(_: JumpSystem) -> list[Method]:
        return [lambda system, _: mean_propagator(system).slowest]

    def of_second_moments(system: JumpSystem) -> list[Method]:
        if unknowns(system) <= most_unknowns:
            return [lambda system, _: homogeneous_propagator(system).slowest]
        if system.time == "discrete":
            return [_by_arnoldi]
        return [_by_rational_krylov, _by_arnoldi] if unknowns(system) <= MAX_ARNOLDI else [_by_rational_krylov]

    graph = mean_propagator(system).slowest_jump if system.modes > 1 else None
    return Rates(_slowest(system, of_means), _slowest(system, of_second_moments), graph)


Method = Callable[[JumpSystem, np.random.Generator | None], float | None]
"""Gives a rate; by a chance of its own where it begins somewhere."""


def _slowest(system: JumpSystem, methods_of: Callable[[JumpSystem], list[Method]]) -> float | None:
    """Rate of the slowest component; None if one of them is not certain."""
    slowest = math.inf
    for part in components(system):
        rate = _certain(system, part, methods_of)
        if rate is None:
            return None
        slowest = min(slowest, rate)
    return slowest


def _certain(system: JumpSystem, part: Component, methods_of: Callable[[JumpSystem], list[Method]]) -> float | None:
    """The first rate that another rounding and another beginning would have given too."""
    reduced = part.system(system)
    for method in methods_of(reduced):
        rate = method(reduced, None)
        if rate is None or part.normal:
            return rate
        rng = np.random.default_rng(0)
        other = method(part.changed(rng).system(system), rng)
        if other is not None and (rate == other or abs(other - rate) <= CERTAIN * abs(rate)):
            return rate
    return None


def _by_rational_krylov(system: JumpSystem, rng: np.random.Generator | None) -> float | None:
    """From the steady second moments of some noise; close, but how close is not known. Continuous time."""
    sizes = np.ones(system.dimension) if rng is None else rng.uniform(0.1, 10.0, system.dimension)
    try:
        steady = MomentSolver(replace(system, noise=np.stack([np.diag(sizes)] * system.modes))).steady()
    except InputError:
        return None
    stack = joint_stack(MomentsAt(np.zeros(system.modes), np.zeros(0), steady))
    return RationalFlow(system, stack, slowest_rate(system, steady), decays=True).slowest


def _by_arnoldi(system: JumpSystem, _: np.random.Generator | None) -> float | None:
    """From the largest eigenvalue of A, or of the inverse of M, which is that of the slowest part."""
    # Both maps are positive, so no other eigenvalue is larger in size.
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


FRACTION = 0.05  # of the steady value: the usual definition of settling
SUBSTEPS = 5  # the search looks at 2^5 times between t and 2 t
MAX_DOUBLINGS = 200
MAX_STEPS = 1_000_000


def settling_time(
    system: JumpSystem,
    steady: FloatArray,
    start: Start,
    fraction: float = FRACTION,
    *,
    most_unknowns: int = MAX_UNKNOWNS,
) -> float:
    """First time [units of time, or steps] after which the system error stays within a fraction of its steady value.

    0.0 if it does so from the start. The end of the search is certain: if at some time -f C_i <= D_i <= f C_i for every
    mode (D the distance of the second moments from their steady state C) and |pi_i(t) - pi_i| <= f pi_i, then this
    remains so, because both maps are positive (Costa, Fragoso and Marques, Discrete-Time Markov Jump Linear Systems,
    2005) and have (C, pi) as their fixed point. The result is exact (in continuous time, to 1e-9 of 1 / norm of the
    equations) where the error has no excursions shorter than 1/32 of the elapsed time; from zero (known place,
    stationary graph) it has none, because it only rises.
    ``steady``: (n, d, d); ``most_unknowns``: up to which the joint equations are propagated as a whole. InputError:
    fraction out of range; steady error 0 (no noise); too large, or never settles.
    """
    if not 0.0 < fraction < 1.0:
        raise InputError(f"settling fraction: {fraction:g}, expected a number between 0 and 1: for example 0.05")
    weights = system.output.T @ system.output
    error = float(np.einsum("nab,ab->", steady, weights))
    if not error > 0.0:
        raise InputError("settling time: the steady error is 0, expected noise: set noise.process")
    course = [distance(system, now, steady) for now in start]
    judge = _Judge(system, steady, weights, fraction * error, fraction)
    stack = joint_stack(course[-1])
    if unknowns(system) > most_unknowns and system.time == "discrete":
        found = _stepped(system, judge, course[-1])
    else:
        flow = joint_flow(system, stack, lambda: slowest_rate(system, steady), decays=True, most_unknowns=most_unknowns)
        found = _searched(flow, judge, stack, system.time)
    if found:
        return len(start) - 1 + found
    return float(max((k + 1 for k, now in enumerate(course) if judge.outside(joint_stack(now))), default=0))


class _Judge:
    """Whether a distance from the steady state is outside the fraction now, and whether it can be again."""

    def __init__(
        self, system: JumpSystem, steady: FloatArray, weights: FloatArray, allowed: float, fraction: float
    ) -> None:
        self._d = system.dimension
        self._form = packed_symmetric.pack(weights)
        self._stationary, self._allowed, self._fraction = system.stationary, allowed, fraction
        values, vectors = np.linalg.eigh(steady)
        # Directions that noise hardly reaches would never pass the test; they get the size of rounding.
        floor = 1e-12 * values.max(axis=1, keepdims=True)
        self._scale = vectors / np.sqrt(np.maximum(values, floor))[:, None, :]

    def outside(self, joint: FloatArray) -> bool:
        """Whether the system error is further from its steady value than allowed."""
        return self.excess(joint) > 0.0

    def excess(self, joint: FloatArray) -> float:
        """|E(t) - E| - allowed."""
        return abs(float(self._form @ joint[:, :-1].sum(axis=0))) - self._allowed

    def settled(self, joint: FloatArray) -> bool:
        """Whether it can never be outside again."""
        moments = packed_symmetric.unpack(joint[:, :-1], self._d)
        scaled = self._scale.transpose(0, 2, 1) @ moments @ self._scale
        size = np.abs(np.linalg.eigvalsh(scaled)).max(initial=0.0)
        law = np.abs(joint[:, -1] / self._stationary).max()
        return bool(max(size, law) <= self._fraction)


def _searched(flow: Flow, judge: _Judge, start: FloatArray, time: Time) -> float:
    """Doubling until settled, then the last time outside, then bisection with the same powers."""
    tick = flow.tick
    powers: list[Power] = []
    y, reached = flow.rotated(start), 0  # the distance at `reached` ticks
    last = (0, y) if judge.outside(start) else None
    width = 0  # of the step, 2^width ticks, after the last time outside
    for power in flow.doublings():
        powers.append(power)
        k = len(powers) - 1
        fine = max(0, k - 1 - SUBSTEPS)
        while reached < 1 << k:  # from 2^(k-1) (or 0) to 2^k ticks
            y = powers[fine](y)
            if last and last[0] == reached:
                width = fine
            reached += 1 << fine
            if judge.outside(flow.restored(y)):
                last = (reached, y)
        if judge.settled(flow.restored(y)):
            break
        if k == MAX_DOUBLINGS:
            raise InputError("settling time: the errors do not settle: check the rates and noise of the network")
    if last is None:
        return 0.0
    ticks, y = last
    for power, k in zip(powers[width::-1][1:], range(width - 1, -1, -1), strict=True):
        ahead = power(y)
        if judge.outside(flow.restored(ahead)):
            y, ticks = ahead, ticks + (1 << k)
    if time == "discrete":
        return float(ticks + 1)
    from scipy.optimize import brentq  # here, since it takes long to import

    def excess(rest: float) -> float:
        return judge.excess(flow.restored(flow.over(rest)(y)))

    return ticks * tick + float(brentq(excess, 0.0, tick, xtol=1e-9 * tick))


def _stepped(system: JumpSystem, judge: _Judge, away: MomentsAt) -> float:
    """The same by single steps. Discrete time."""
    last = -1
    for step in range(MAX_STEPS):
        joint = joint_stack(away)
        if judge.outside(joint):
            last = step
        elif step % 16 == 0 and judge.settled(joint):
            return float(last + 1)
        away = advance(system, away)
    raise InputError(f"settling time: more than {MAX_STEPS} steps: raise run.dt, or use fewer agents")
