"""A cheaper preconditioner for symmetric graphs that do not switch slowly: every graph replaced by their average.

In the eigenvectors of the average the coupled equations of equal graphs fall apart into one small system for each
entry, of the n graphs, which the eigenvectors of the chain (made reversible) solve. What is left to do with matrix
products is the operator itself: one or two per graph, in single precision. In discrete time the equations are first
multiplied by the inverse of the transition matrix: T^-1 X - K[X] = T^-1 B has the form of continuous time, and with a
reversible chain it is self-adjoint. It takes more iterations than the two-level
preconditioner, at a fifth of the work each, and no eigenvectors of single graphs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from msg_analysis.theory.local import single
from msg_analysis.types import FloatArray

if TYPE_CHECKING:
    from msg_analysis.theory.equations import CoupledEquations

SLOWEST = 0.1
"""Leaving of a graph for which this pays, relative to the mean decay."""

LARGEST_INVERSE = 100.0
"""Of the transition matrix: what single precision can bear."""


def suitable(equations: CoupledEquations) -> bool:
    """Whether single precision will do, and the graphs do not switch too slowly for this to pay."""
    whole = equations.whole
    if not (equations.symmetric and whole.mild and equations.leaving.min() >= SLOWEST * equations.decay.mean()):
        return False
    if whole.time == "continuous":
        return True
    transition = np.diag(1.0 - equations.leaving) + equations.rates
    smallest = np.linalg.svd(transition, compute_uv=False)[-1]
    return bool(smallest * LARGEST_INVERSE > 1.0)


class AveragedEquations:
    """The equations in the eigenvectors of the average, in single precision.

    Attributes
    ----------
    weights : (n,) as in the equations
    definite : as in the equations
    """

    def __init__(self, equations: CoupledEquations) -> None:
        whole = equations.whole
        assert whole.eigenvectors is not None
        self.weights, self.definite = equations.weights, equations.reversible and whole.definite
        self._discrete = whole.time == "discrete"
        values, vectors = whole.eigenvectors.values[0], whole.eigenvectors.vectors[0]
        self._vectors = single(vectors)
        self._drift = self._vectors.T @ single(equations.drift) @ self._vectors
        generator = equations.rates - np.diag(equations.leaving)
        if self._discrete:
            inverse = np.linalg.inv(np.eye(len(generator)) + generator)
            self._before, generator = single(inverse), np.eye(len(generator)) - inverse
        root = np.sqrt(self.weights)
        flow = -root[:, None] * generator / root
        rates, modes = np.linalg.eigh(0.5 * (flow + flow.T))
        back = modes / root[:, None]
        self._forth, self._back = single(modes.T * root), single(np.concatenate([back, generator @ back]))
        divisor = values[:, None] + values + rates[:, None, None]
        if self._discrete:
            divisor -= values[:, None] * values
        self._divisor = single(divisor)
        self._buffers: list[FloatArray] = []

    def enter(self, matrices: FloatArray) -> FloatArray:
        """Right-hand sides, from those of the equations."""
        inside = self._vectors.T @ single(matrices) @ self._vectors
        return _combine(self._before, inside, np.empty_like(inside)) if self._discrete else inside

    def leave(self, matrices: FloatArray) -> FloatArray:
        """Solutions, to those of the equations."""
        moved = self._vectors @ matrices @ self._vectors.T
        return np.asarray(0.5 * (moved + moved.swapaxes(-1, -2)), dtype=float)

    def precondition(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(Z, A Z) for Z near A^-1 R; the next call overwrites them."""
        shape, n = right.shape, len(self.weights)
        if not self._buffers or self._buffers[0].shape != shape:  # fresh memory costs as much as a product
            both = (shape[0], len(self._back), *shape[2:])
            self._buffers = [np.empty(s, np.float32) for s in (shape, both, shape, shape)]
        half, found, moved, squared = self._buffers
        _combine(self._forth, right, half)
        half /= self._divisor
        _combine(self._back, half, found)
        z, coupled = found[:, :n], found[:, n:]
        np.matmul(self._drift, z, out=half)
        np.add(half, half.swapaxes(-1, -2), out=moved)
        if self._discrete:
            moved -= np.matmul(half, self._drift, out=squared)
        moved -= coupled
        return z, moved

    def average(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Zeros: this preconditioner is symmetric anyhow."""
        return np.zeros_like(right), np.zeros_like(right)


def _combine(factors: FloatArray, stack: FloatArray, out: FloatArray) -> FloatArray:
    """(q, g, d, d): sum_j factors[i, j] stack[:, j]."""
    q, n, d, _ = stack.shape
    np.matmul(factors, stack.reshape(q, n, d * d), out=out.reshape(q, len(factors), d * d))
    return out
