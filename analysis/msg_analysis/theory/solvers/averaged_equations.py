"""A cheaper preconditioner for symmetric graphs that do not switch slowly: every graph replaced by their average.

In the eigenvectors of the average the coupled equations of equal graphs fall apart into one small system for each
entry, of the n graphs, which the eigenvectors of the chain (made reversible) solve: all that is left of the
preconditioner M is a division. Applied from both sides it turns the equations into I + S, where S is what distinguishes
the graphs from their average: one product of matrices per graph, in single precision. In discrete time the equations
are first multiplied by the inverse of the transition matrix: T^-1 X - K[X] = T^-1 B has the form of continuous time,
and with a reversible chain it is self-adjoint. With d_i = D_i - L, L the eigenvalues of the average, S stands for

    continuous: d_i X + X d_i
    discrete:   G + G^T,  G = d_i X (I - L - d_i / 2)

It takes more iterations than the two-level preconditioner, at a fifth of the work each or less, and no eigenvectors of
single graphs.

docs/accuracy.md says when it is used.
"""

from __future__ import annotations

import numpy as np

from msg_analysis.theory.solvers.coupled_equations import CoupledEquations
from msg_analysis.theory.solvers.krylov import flat, strips
from msg_analysis.theory.solvers.lyapunov import single
from msg_analysis.types import FloatArray

SLOWEST = 0.1
"""Leaving of a graph for which this pays, relative to the mean decay."""

LARGEST_INVERSE = 100.0
"""Of the transition matrix: what single precision can bear."""

NEGLIGIBLE = 3.0
"""Accuracy asked of S, in units of what d_i X d_i usually contributes, from which that is left out."""


def suitable(equations: CoupledEquations) -> bool:
    """Whether M is positive, single precision will do, and the graphs do not switch too slowly for this to pay.

    Parameters
    ----------
    equations
        in continuous time or not
    """
    whole = equations.whole
    if not (equations.symmetric and whole.mild and equations.leaving.min() >= SLOWEST * equations.decay.mean()):
        return False
    if (
        whole.time == "discrete"
        and not np.linalg.svd(_transition(equations), compute_uv=False)[-1] * LARGEST_INVERSE > 1.0
    ):
        return False
    rates = np.linalg.eigvalsh(_flow(equations)[0])
    return whole.definite and bool(rates[0] >= -1e-10 * rates[-1])


class AveragedEquations:
    """I + S. Its unknowns are U = M^1/2 X, its right-hand sides M^-1/2 B, in the eigenvectors of average and chain.

    Parameters
    ----------
    equations
        ``suitable`` ones

    Attributes
    ----------
    definite
        whether it is known to be symmetric and positive definite
    """

    def __init__(self, equations: CoupledEquations) -> None:
        whole = equations.whole
        assert whole.eigenvectors is not None
        self.definite = equations.reversible
        self._discrete = whole.time == "discrete"
        values, vectors = whole.eigenvectors.values[0], whole.eigenvectors.vectors[0]
        n, d = len(equations.weights), len(values)
        self._vectors, diagonal, k = single(vectors), np.arange(d), d // 2
        self._distance = np.empty((n, d, d), np.float32)
        for distance, drift in zip(self._distance, equations.drift, strict=True):
            distance[:] = self._inside(drift)
        self._distance[:, diagonal, diagonal] -= single(values)
        self._strips = strips(d * d)
        self._buffers: list[FloatArray] = []

        flow, circulation = _flow(equations)
        rates, modes = np.linalg.eigh(flow)
        root = np.sqrt(equations.weights)
        forth = modes.T * root
        self._forth, self._back = single(forth), single(modes / root[:, None])
        self._circulation = None if equations.reversible else single(0.5 * modes.T @ circulation @ modes)
        self._enter = single(forth @ np.linalg.inv(_transition(equations)) if self._discrete else forth)
        divisor = values[:, None] + values
        if self._discrete:
            divisor -= values[:, None] * values
        self._scale = np.empty((n, d * d), np.float32)
        for scale, rate in zip(self._scale, rates, strict=True):
            scale[:] = 1.0 / np.sqrt(divisor.ravel() + max(rate, 0.0))

        if self._discrete:
            self._kept = single(1.0 - values)
            step = -0.5 * self._distance
            self._usual = float(np.square(self._distance).sum(axis=(1, 2)).max() / d * np.square(self._scale).mean())
            self._upper, self._lower = step[:, :, :k].copy(), step
            self._lower[:, :, :k] *= 2.0
            self._upper[:, diagonal[:k], diagonal[:k]] += self._kept[:k]
            self._lower[:, diagonal, diagonal] += self._kept

    def enter(self, matrices: FloatArray, scale: FloatArray) -> FloatArray:
        """M^-1/2 B / scale, from (q, n, d, d) right-hand sides of the equations and (q,) scales.

        Parameters
        ----------
        matrices
            (q, n, d, d) B
        scale
            (q,) by which they are divided
        """
        given = matrices[:, :1] if (matrices == matrices[:, :1]).all() else matrices
        factors = self._enter if given is matrices else self._enter.sum(axis=1, keepdims=True)
        inside = self._workspace(matrices.shape)[0][:, : given.shape[1]]
        for place in np.ndindex(given.shape[:2]):
            inside[place] = self._inside(given[place] / scale[place[0]])
        right: FloatArray = np.empty(matrices.shape, np.float32)
        for part in self._strips:
            np.multiply(factors @ flat(inside)[..., part], self._scale[:, part], out=flat(right)[..., part])
        return right

    def solution(self, scaled: FloatArray) -> FloatArray:
        """X = M^-1/2 U, in the eigenvectors of the average; the next call of any method overwrites it.

        Parameters
        ----------
        scaled
            (q, n, d, d) U

        Returns
        -------
        FloatArray
            (q, n, d, d)
        """
        x = self._workspace(scaled.shape)[0]
        for part in self._strips:
            np.matmul(self._back, self._scale[:, part] * flat(scaled)[..., part], out=flat(x)[..., part])
        return x

    def leave(self, scaled: FloatArray, scale: FloatArray, total: FloatArray) -> None:
        """Add X times the scale to solutions of the equations.

        Parameters
        ----------
        scaled
            (q, n, d, d) U
        scale
            (q,) by which X is multiplied
        total
            (q, n, d, d), is changed
        """
        solution = self.solution(scaled)
        for place in np.ndindex(solution.shape[:2]):
            moved = self._vectors @ solution[place] @ self._vectors.T
            total[place] += 0.5 * scale[place[0]] * (moved + moved.T).astype(float)

    def apply(self, x: FloatArray, accuracy: float = 0.0) -> FloatArray:
        """(I + S) X, about as accurate as asked for, relative to X; the next call of any method overwrites it.

        Parameters
        ----------
        x
            (q, n, d, d)
        accuracy
            relative error that is let through

        Returns
        -------
        FloatArray
            (q, n, d, d)
        """
        z, half = self.solution(x), self._workspace(x.shape)[1]
        np.matmul(self._distance, z, out=half)
        if self._discrete:
            half, z = self._second(half, z, accuracy), half
        for part in self._strips:
            found = self._forth @ flat(half)[..., part]
            if self._circulation is not None:
                found += self._circulation @ (self._scale[:, part] * flat(x)[..., part])
            np.multiply(found, self._scale[:, part], out=flat(z)[..., part])
        np.add(z, z.swapaxes(-1, -2), out=half)
        half += x
        return half

    def precondition(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(R, (I + S) R): nothing is left to precondition.

        Parameters
        ----------
        right
            (q, n, d, d) R

        Returns
        -------
        tuple[FloatArray, FloatArray]
            two of the same shape
        """
        return right, self.apply(right)

    def _second(self, half: FloatArray, out: FloatArray, accuracy: float) -> FloatArray:
        """G from d_i X, but for an antisymmetric part. Discrete time.

        d_i X d_i is symmetric: its lower left block stands for the upper right one, too.
        """
        if accuracy > NEGLIGIBLE * self._usual:
            return np.multiply(half, self._kept, out=out)
        k = half.shape[-1] // 2
        np.matmul(half[..., :k, :], self._upper, out=out[..., :k, :k])
        np.matmul(half[..., k:, :], self._lower, out=out[..., k:, :])
        np.multiply(half[..., :k, k:], self._kept[k:], out=out[..., :k, k:])
        return out

    def _inside(self, matrix: FloatArray) -> FloatArray:
        """In the eigenvectors of the average."""
        return np.asarray(self._vectors.T @ single(matrix) @ self._vectors)

    def _workspace(self, shape: tuple[int, ...]) -> list[FloatArray]:
        """Two stacks, kept: fresh memory costs as much as a product."""
        if not self._buffers or self._buffers[0].shape != shape:
            self._buffers = [np.empty(shape, np.float32) for _ in range(2)]
        return self._buffers


def _transition(equations: CoupledEquations) -> FloatArray:
    """(n, n) T. Discrete time."""
    return np.asarray(np.diag(1.0 - equations.leaving) + equations.rates)


def _flow(equations: CoupledEquations) -> tuple[FloatArray, FloatArray]:
    """(n, n) -T (continuous time) or T^-1 - I, symmetrised by the weights: its symmetric part, and the rest."""
    flow = np.diag(equations.leaving) - equations.rates
    if equations.system.time == "discrete":
        flow = np.linalg.inv(_transition(equations)) - np.eye(len(flow))
    root = np.sqrt(equations.weights)
    flow = root[:, None] * flow / root
    return 0.5 * (flow + flow.T), 0.5 * (flow - flow.T)
