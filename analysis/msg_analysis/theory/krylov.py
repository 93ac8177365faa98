# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Krylov methods for stacks of equations: each of the q right-hand sides has its own iteration, all step together.

Conjugate gradients after Hestenes and Stiefel (1952), GMRES after Saad and Schultz (1986).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import scipy.linalg

from msg_analysis.common.arrays import FloatArray

MAX_BASIS = 150  # most iterations of GMRES, which keeps a vector of each
MAX_BASIS_BYTES = 1.2e9  # of these vectors together
STRIP = 8192  # entries of every graph that are worked on together, to stay in the caches


class Preconditioned(Protocol):
    """A X = B with a preconditioner; stacks are (q, n, d, d)."""

    def precondition(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(Z, A Z) for Z near A^-1 R."""


class Equations(Preconditioned, Protocol):
    """The same with the inner product in which A may be self-adjoint."""

    weights: FloatArray
    definite: bool

    def average(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(Z, A Z) for a start Z from which the preconditioner acts as a symmetric one."""


def conjugate_gradients(
    equations: Equations, right: FloatArray, goal: FloatArray, tolerance: float, most: int
) -> tuple[FloatArray, int]:
    """(X, iterations) for A X = B (q, n, d, d), ``definite``, with conjugate gradients in the product with the weights.

    It ends when the norms of the preconditioned residuals are at most ``goal`` (q,), or ``tolerance`` relative to X.
    """
    weights = equations.weights
    x, moved = equations.average(right)  # the preconditioner is symmetric where the residual has mean zero
    residual = right - moved
    p, ap, buffer, before = np.zeros_like(x), np.zeros_like(x), np.empty_like(x), np.ones(len(x))
    for iteration in range(1, most + 1):
        z, az = equations.precondition(residual)
        now = _product(residual, z, weights)
        if (weighted_norm(z, weights) <= np.maximum(goal, tolerance * weighted_norm(x, weights))).all():
            return x + z, iteration
        ratio = _broadcast(now / before, x)
        p *= ratio
        p += z
        ap *= ratio
        ap += az
        before = np.where(now > 0.0, now, 1.0)
        curvature = _product(p, ap, weights)
        step = _broadcast(np.divide(now, curvature, out=np.zeros_like(now), where=curvature > 0.0), x)
        x += np.multiply(step, p, out=buffer)
        residual -= np.multiply(step, ap, out=buffer)
    return x, most


def plain_conjugate_gradients(
    apply: Callable[[FloatArray, float], FloatArray], right: FloatArray, tolerance: FloatArray, most: int
) -> tuple[FloatArray, int]:
    """(X, iterations) for A X = B (q, n, d, d) with conjugate gradients, without preconditioner; overwrites ``right``.

    ``apply`` maps X and the relative error that is allowed to A X, for a positive definite A: products may become less
    accurate as the residual gets smaller (van den Eshof and Sleijpen 2004). ``tolerance``: (q,), relative to B.
    """
    x, residual, p = np.zeros_like(right), right, right.copy()
    axpy = scipy.linalg.blas.get_blas_funcs("axpy", (right,))  # in place, in one pass
    now = _squares(right, right)
    small = tolerance**2 * now
    for iteration in range(1, most + 1):
        accuracy = np.sqrt(np.divide(small, now, out=np.ones_like(now), where=now > 0.0))
        moved = apply(p, float(accuracy.min()))
        curvature = _squares(p, moved)
        steps = np.divide(now, curvature, out=np.zeros_like(now), where=curvature > 0.0)
        for k, step in enumerate(steps):
            axpy(p[k].ravel(), x[k].ravel(), a=step)
            axpy(moved[k].ravel(), residual[k].ravel(), a=-step)
        before, now = now, _squares(residual, residual)
        if (now <= small).all():
            return x, iteration
        p *= _broadcast(np.divide(now, before, out=np.zeros_like(now), where=before > 0.0), p)
        p += residual
    return x, most


def gmres(equations: Preconditioned, right: FloatArray, tolerance: FloatArray, most: int) -> tuple[FloatArray, int]:
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


def flat(stack: FloatArray) -> FloatArray:
    """The (q, n, d^2) view of a stack (q, n, d, d)."""
    return stack.reshape(*stack.shape[:2], -1)


def strips(length: int) -> list[slice]:
    """Slices of the rows of a flat stack, each of which stays in the caches while it is worked on."""
    return [slice(first, first + STRIP) for first in range(0, length, STRIP)]


def norms(a: FloatArray) -> FloatArray:
    """(q, n) Frobenius norms of (q, n, d, d) matrices."""
    return np.asarray(np.sqrt(np.einsum("qnab,qnab->qn", a, a)))


def _product(a: FloatArray, b: FloatArray, weights: FloatArray) -> FloatArray:
    """(q,): sum_i pi_i tr(A_i^T B_i)."""
    if len(a) == 1:  # BLAS is faster than einsum
        return np.array([sum(w * float(np.vdot(x, y)) for w, x, y in zip(weights, a[0], b[0], strict=True))])
    return np.asarray(np.einsum("qnab,qnab->qn", a, b) @ weights)


def weighted_norm(a: FloatArray, weights: FloatArray) -> FloatArray:
    """(q,): sqrt(sum_i pi_i |A_i|^2), from (q, n, d, d) matrices A and the weights pi (n,)."""
    return np.asarray(np.sqrt(_product(a, a, weights)))


def _squares(a: FloatArray, b: FloatArray) -> FloatArray:
    """(q,): sum_i tr(A_i^T B_i)."""
    return np.array([float(np.vdot(x, y)) for x, y in zip(a, b, strict=True)])


def _broadcast(factors: FloatArray, like: FloatArray) -> FloatArray:
    return np.asarray(factors[:, None, None, None], dtype=like.dtype)
