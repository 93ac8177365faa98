# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""GMRES for stacks of equations: each of the q right-hand sides has its own iteration, all step together.

After Saad and Schultz (1986).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from msg_analysis.common.arrays import FloatArray

MAX_BASIS = 150  # most iterations of GMRES, which keeps a vector of each
MAX_BASIS_BYTES = 1.2e9  # of these vectors together


class Equations(Protocol):
    """A X = B with a preconditioner; stacks are (q, n, d, d)."""

    def precondition(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(Z, A Z) for Z near A^-1 R."""


def gmres(equations: Equations, right: FloatArray, tolerance: FloatArray, most: int) -> tuple[FloatArray, int]:
    """(X, iterations) for A X = B (q, n, d, d) with GMRES, preconditioned from the right, without restart.

    ``tolerance``: (q,) norms of the residual, relative to B; ``MAX_BASIS`` and ``MAX_BASIS_BYTES`` limit ``most``, too.
    """
    q, shape = len(right), right.shape
    length = right[0].size
    most = max(5, min(most, MAX_BASIS, int(MAX_BASIS_BYTES / right.nbytes)))
    basis = np.empty((q, min(most + 1, 16), length), dtype=right.dtype)
    triangle = np.zeros((q, most, most))
    target = np.zeros((q, most + 1))
    turned = np.ones((q, 1, 1))  # product of all Givens rotations, which make the Hessenberg matrix a triangle
    norm = np.linalg.norm(right.reshape(q, -1), axis=1)
    basis[:, 0] = right.reshape(q, -1) / np.where(norm > 0.0, norm, 1.0)[:, None]
    target[:, 0] = norm
    used = 0
    while used < most:
        if used + 1 == basis.shape[1]:  # allocated as needed: clearing memory takes time
            more = np.empty((q, min(used, most - used), length), dtype=right.dtype)
            basis = np.concatenate([basis, more], axis=1)
        _, moved = equations.precondition(basis[:, used].reshape(shape))
        vector = moved.reshape(q, length)
        column = np.zeros((q, used + 2))
        known = basis[:, : used + 1]
        for _ in range(2):  # Gram-Schmidt twice is enough
            part = known @ vector[:, :, None]
            vector = vector - (part.transpose(0, 2, 1) @ known)[:, 0]
            column[:, : used + 1] += part[:, :, 0]
        size = np.linalg.norm(vector, axis=1)
        column[:, used + 1] = size
        basis[:, used + 1] = vector / np.where(size > 0.0, size, 1.0)[:, None]
        column[:, : used + 1] = (turned @ column[:, : used + 1, None])[:, :, 0]
        pivot = np.hypot(column[:, used], size)
        safe = np.where(pivot > 0.0, pivot, 1.0)
        cosine, sine = column[:, used] / safe, size / safe
        triangle[:, :used, used], triangle[:, used, used] = column[:, :used], safe
        target[:, used + 1] = -sine * target[:, used]
        target[:, used] *= cosine
        last, before, turned = turned[:, used], turned, np.zeros((q, used + 2, used + 2))
        turned[:, :used, : used + 1] = before[:, :used]
        turned[:, used, : used + 1], turned[:, used, used + 1] = cosine[:, None] * last, sine
        turned[:, used + 1, : used + 1], turned[:, used + 1, used + 1] = -sine[:, None] * last, cosine
        used += 1
        if (np.abs(target[:, used]) <= tolerance * norm).all():
            break
    factors = np.linalg.solve(triangle[:, :used, :used], target[:, :used, None])
    combined = (factors.transpose(0, 2, 1).astype(basis.dtype) @ basis[:, :used])[:, 0]
    x, _ = equations.precondition(combined.reshape(shape))
    return x, used


def norms(a: FloatArray) -> FloatArray:
    """(q, n) Frobenius norms of (q, n, d, d) matrices."""
    return np.asarray(np.sqrt(np.einsum("qnab,qnab->qn", a, a)))
