# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Transients of large systems in continuous time: a rational Krylov subspace for c(t) and pi(t) together.

A few dozen solves of shifted equations, (sigma + M) X = R, span a space in which exp(A t) z(0) is accurate for all
times at once; shifts from the slowest to the fastest rate cover stiff systems (Ruhe 1984; Guettel 2013). A shifted
system is the system with Z_i + sigma / 2, which the solver of the steady state solves.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import scipy.linalg

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.propagator import Flow
from msg_analysis.theory.solvers import IterativeSolver

TOLERANCE = 1e-10  # change of the course between two checks, relative to the start, below which the space suffices
MAX_RATIONAL_BASIS = 100
CHECK_EVERY = 5
MAX_BYTES = 2e9


class RationalFlow(Flow):
    """The course of one start, reduced to a small matrix; InputError where it is too large, too stiff or not stable."""

    # start: (n, p + 1) packed second moments and probability of every mode, or (decays) their distance from the steady
    # state, which dies out entirely. slow: slowest rate of interest, or 1 / longest time [1 / unit of time].
    # The space grows until two checks in a row change the course by at most TOLERANCE of the start.

    def __init__(
        self, system: JumpSystem, start: FloatArray, slow: float, *, decays: bool, most_bytes: float = MAX_BYTES
    ) -> None:
        if (needed := 2 * MAX_RATIONAL_BASIS * start.nbytes) > most_bytes:
            raise InputError(
                f"transient: {system.modes} graphs of {len(system.output)} agents need {needed / 1e9:.1f} GB in "
                f"continuous time, expected at most {most_bytes / 1e9:.0f} GB: take the steps' law (emulated), or "
                "fewer agents"
            )
        self._system, self._decays = system, decays
        # Weighted with 1 / pi the equations are self-adjoint where the network is reversible and undirected.
        self._root = np.sqrt(system.stationary)
        # A distance has total probability zero. Rounding must not add any, which would never die out: so the law of
        # the graph is represented by vectors of total zero.
        self._laws = scipy.linalg.null_space(self._root[None]) if decays else np.eye(system.modes)
        size, part = np.linalg.norm(start[:, :-1] / self._root[:, None]), np.abs(start[:, -1]).max()
        self._law_weight = 10.0 * float(size / part) if size > 0.0 and part > 0.0 else 1.0
        self._basis = np.zeros((0, start[:, :-1].size + self._laws.shape[1]))
        super().__init__("continuous", np.zeros((0, 0)))
        if start.any():
            self._build(self._joined(packed_symmetric.unpack(start[:, :-1], system.dimension), start[:, -1]), slow)

    def rotated(self, z: FloatArray) -> FloatArray:
        """(k,) of the start, the only z that is represented."""
        moments = packed_symmetric.unpack(z[:, :-1], self._system.dimension)
        return np.asarray(self._basis @ self._joined(moments, z[:, -1]))

    def restored(self, y: FloatArray) -> FloatArray:
        """(n, p + 1) of (k,)."""
        packed, law = self._parts(y @ self._basis)
        return np.concatenate([packed, law[:, None]], axis=1)

    def _build(self, start: FloatArray, slow: float) -> None:
        """Extend the space until the course does not change any more."""
        system = self._system
        largest = float(np.linalg.norm(system.matrices, 2, axis=(1, 2)).max())
        fast = 2.0 * largest - float(system.chain.diagonal().min())
        basis = [start / np.linalg.norm(start)]
        images = [self._apply(basis[0])]
        before, calm = np.zeros((0, 0)), 0
        while len(basis) <= MAX_RATIONAL_BASIS:
            matrix = np.array([[np.vdot(v, image) for image in images] for v in basis])
            if len(basis) % CHECK_EVERY == 0:
                with np.errstate(over="ignore", invalid="ignore"):  # too small a space may grow beyond all bounds
                    now = _course(matrix, 0.25 / fast, 10.0 / slow)
                    known = before.shape[1]
                    change = np.hstack([now[:, :known] - before, now[:, known:]]) if known else now
                    calm = calm + 1 if np.linalg.norm(change, axis=1).max() <= TOLERANCE else 0
                if calm == 2:
                    break
                before = now
            shift = slow * (fast / slow) ** _van_der_corput(len(basis))
            v = self._solve(basis[-1], shift)
            whole = np.linalg.norm(v)
            for _ in range(2):
                for u in basis:
                    v = v - np.vdot(u, v) * u
            size = np.linalg.norm(v)
            if not size > 1e-11 * whole:
                break  # the space is invariant
            basis.append(v / size)
            images.append(self._apply(basis[-1]))
        else:
            raise InputError(
                "transient: the network is too stiff for its size in continuous time (rates from "
                f"{slow:.1e} to {fast:.1e}): take the steps' law (emulated), or fewer agents"
            )
        self._basis, self._matrix = np.array(basis), matrix
        # Ritz values of undirected networks are always stable; those of directed ones need not be.
        if (self.slowest <= 0.0) if self._decays else (self.slowest < -0.01 * slow):
            raise InputError(
                "transient: the reduced equations of this large directed network are unstable, though the network is "
                "not: take the steps' law (emulated), or fewer agents"
            )

    def _parts(self, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Packed second moments (n, p) and probabilities (n,)."""
        count = self._laws.shape[1]
        packed = self._root[:, None] * v[: -count or None].reshape(self._system.modes, -1)
        return packed, self._root * (self._laws @ v[len(v) - count :]) / self._law_weight

    def _joined(self, moments: FloatArray, law: FloatArray) -> FloatArray:
        """The vector of both, whose length is that of the weighted inner product."""
        weighted = self._law_weight * self._laws.T @ (law / self._root)
        return np.concatenate([(packed_symmetric.pack(moments) / self._root[:, None]).ravel(), weighted])

    def _apply(self, v: FloatArray) -> FloatArray:
        """The right-hand side of the equations."""
        system = self._system
        packed, law = self._parts(v)
        moments = packed_symmetric.unpack(packed, system.dimension)
        half = system.matrices @ moments
        jumps = system.chain.T - np.diag(system.chain.diagonal())
        # Differences per unit of probability: fast switching makes them small, and they lose nothing.
        pi = system.stationary
        rates = jumps * pi / pi[:, None]
        share, part = moments / pi[:, None, None], law / pi
        moved = np.stack([np.tensordot(rates[i], share - share[i], axes=1) for i in range(system.modes)])
        change = pi[:, None, None] * moved - half - half.swapaxes(-1, -2) + law[:, None, None] * system.noise
        return self._joined(change, pi * (rates * (part[None, :] - part[:, None])).sum(axis=1))

    def _solve(self, v: FloatArray, shift: float) -> FloatArray:
        """(shift - A)^-1 v."""
        system = self._system
        packed, law = self._parts(v)
        moments = packed_symmetric.unpack(packed, system.dimension)
        law = np.asarray(np.linalg.solve(shift * np.eye(system.modes) - system.chain.T, law), dtype=float)
        right = moments + law[:, None, None] * system.noise
        shifted = dataclasses.replace(
            system,
            matrices=system.matrices + 0.5 * shift * np.eye(system.dimension),
            noise=right / system.stationary[:, None, None],
        )
        return self._joined(IterativeSolver(shifted).steady(), law)


def _course(matrix: FloatArray, first: float, last: float) -> FloatArray:
    """(T, k): exp(A t) e_1 at first, 2 first, 4 first, ... up to last or beyond."""
    power = Flow("continuous", matrix).over(first)
    course = []
    while first < 2.0 * last:
        course.append(power(np.eye(len(matrix))[0]))
        power, first = power.then(power), 2.0 * first
    return np.array(course)


def slowest_rate(system: JumpSystem, steady: FloatArray) -> float:
    """Rate of the slowest part of second moments and graph [1 / unit of time], estimated. Continuous time."""
    moments, rate = steady, math.inf  # four inverse iterations, from the steady second moments (n, d, d)
    for _ in range(4):
        before = np.linalg.norm(moments)
        noise = moments / system.stationary[:, None, None]
        moments = IterativeSolver(dataclasses.replace(system, noise=noise)).steady()
        rate = float(before / np.linalg.norm(moments))
    if system.modes > 1:
        values = np.sort(np.linalg.eigvals(-system.chain).real)
        rate = min(rate, float(values[1]))
    return rate


def _van_der_corput(index: int) -> float:
    """Numbers that fill (0, 1) evenly, however many are taken: the bits of the index, reversed behind the point."""
    value, weight = 0.0, 0.5
    while index:
        value += weight * (index & 1)
        index, weight = index >> 1, 0.5 * weight
    return value
