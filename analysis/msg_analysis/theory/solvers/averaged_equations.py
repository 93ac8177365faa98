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

"""The "averaged" preconditioner of the coupled equations: every graph is replaced by the average of all graphs.

For symmetric graphs that do not switch slowly. It needs more iterations than the two-level preconditioner of
``equations``, but each costs a quarter as much or less, and it needs no eigenvectors of single graphs.
docs/accuracy.md, "How the equations are solved", says when it is used.
"""

from __future__ import annotations

import numpy as np

from msg_analysis.theory.solvers.coupled_equations import CoupledEquations
from msg_analysis.theory.solvers.krylov import flat, strips
from msg_analysis.theory.solvers.lyapunov import single
from msg_analysis.types import FloatArray

SLOWEST = 0.1  # least rate of leaving a graph, relative to the mean decay, from which this pays
LARGEST_INVERSE = 100.0  # largest norm of the inverse of the transition matrix that single precision allows
NEGLIGIBLE = 3.0  # d_i X d_i is left out where the error allowed is this many times its usual contribution


def suitable(equations: CoupledEquations) -> bool:
    """Whether M is positive, single precision suffices, and every graph is left fast enough for this to pay."""
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
    """The preconditioned equations I + S. Unknowns: U = M^1/2 X; right-hand sides: M^-1/2 B. All in single precision.

    For equal graphs, the eigenvectors of the average and of the chain (its reversible part) make the equations
    diagonal: this diagonal is the preconditioner M. S is what distinguishes the graphs from their average: in the
    eigenvectors of the average, L its eigenvalues and d_i = D_i - L, the map X -> G + G^T with

        continuous: G = d_i X
        discrete:   G = d_i X (I - L - d_i / 2)

    In discrete time the equations are first multiplied by the inverse of the transition matrix T: T^-1 X - K[X] =
    T^-1 B has the form of continuous time, and is self-adjoint if the chain is reversible. What of the chain is not
    reversible is a part of S, too.
    """

    def __init__(self, equations: CoupledEquations) -> None:
        whole = equations.whole
        assert whole.eigenvectors is not None
        self.definite = equations.reversible  # I + S is symmetric then, and positive definite if moments stay bounded
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
        """M^-1/2 B / scale, (q, n, d, d), from right-hand sides B (q, n, d, d) of the equations and scales (q,)."""
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
        """X = M^-1/2 U, (q, n, d, d), in the eigenvectors of the average; the next call of any method overwrites it."""
        x = self._workspace(scaled.shape)[0]
        for part in self._strips:
            np.matmul(self._back, self._scale[:, part] * flat(scaled)[..., part], out=flat(x)[..., part])
        return x

    def leave(self, scaled: FloatArray, scale: FloatArray, total: FloatArray) -> None:
        """Add scale * X, symmetrised and in the coordinates of the equations, to ``total`` (q, n, d, d), in place."""
        solution = self.solution(scaled)
        for place in np.ndindex(solution.shape[:2]):
            moved = self._vectors @ solution[place] @ self._vectors.T
            total[place] += 0.5 * scale[place[0]] * (moved + moved.T).astype(float)

    def apply(self, x: FloatArray, accuracy: float = 0.0) -> FloatArray:
        """(I + S) X, (q, n, d, d), to about the relative error ``accuracy``; the next call overwrites it."""
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
        """(R, (I + S) R): the equations are preconditioned already."""
        return right, self.apply(right)

    def _second(self, half: FloatArray, out: FloatArray, accuracy: float) -> FloatArray:
        """G from ``half`` = d_i X, up to an antisymmetric part. Discrete time.

        d_i X d_i is symmetric, so its upper right block is not computed: the lower left one counts twice.
        """
        if accuracy > NEGLIGIBLE * self._usual:
            return np.multiply(half, self._kept, out=out)
        k = half.shape[-1] // 2
        np.matmul(half[..., :k, :], self._upper, out=out[..., :k, :k])
        np.matmul(half[..., k:, :], self._lower, out=out[..., k:, :])
        np.multiply(half[..., :k, k:], self._kept[k:], out=out[..., :k, k:])
        return out

    def _inside(self, matrix: FloatArray) -> FloatArray:
        """The matrix in the eigenvectors of the average."""
        return np.asarray(self._vectors.T @ single(matrix) @ self._vectors)

    def _workspace(self, shape: tuple[int, ...]) -> list[FloatArray]:
        """Two stacks that are kept between calls: fresh memory costs as much as a product."""
        if not self._buffers or self._buffers[0].shape != shape:
            self._buffers = [np.empty(shape, np.float32) for _ in range(2)]
        return self._buffers


def _transition(equations: CoupledEquations) -> FloatArray:
    """(n, n) T. Discrete time."""
    return np.asarray(np.diag(1.0 - equations.leaving) + equations.rates)


def _flow(equations: CoupledEquations) -> tuple[FloatArray, FloatArray]:
    """(n, n) symmetric part and antisymmetric part of -T (continuous time) or T^-1 - I, symmetrised by the weights."""
    flow = np.diag(equations.leaving) - equations.rates
    if equations.system.time == "discrete":
        flow = np.linalg.inv(_transition(equations)) - np.eye(len(flow))
    root = np.sqrt(equations.weights)
    flow = root[:, None] * flow / root
    return 0.5 * (flow + flow.T), 0.5 * (flow - flow.T)
