# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Symmetric matrices as vectors of their p = d (d + 1) / 2 free entries.

Off-diagonal entries carry a factor sqrt(2), so that <A, B> = tr(A B) is the dot product of the vectors, and the adjoint
of a map between symmetric matrices is the transpose of its matrix. This is the vector "svec" of semidefinite
programming (Alizadeh, Haeberly and Overton 1998).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from msg_analysis.common.arrays import FloatArray, IntArray


def size(d: int) -> int:
    """Number of free entries of a d x d matrix, d (d + 1) / 2."""
    return d * (d + 1) // 2


@lru_cache(maxsize=16)
def indices(d: int) -> tuple[IntArray, IntArray, FloatArray]:
    """(row, column, factor), each (p,) and not to be changed, of the entries of the vector."""
    rows, columns = np.tril_indices(d)
    found = rows, columns, np.where(rows == columns, 1.0, np.sqrt(2.0))
    for array in found:
        array.flags.writeable = False
    return found


def pack(matrices: FloatArray) -> FloatArray:
    """(..., p) of symmetric (..., d, d)."""
    rows, columns, factor = indices(matrices.shape[-1])
    return np.asarray(matrices[..., rows, columns] * factor)


def unpack(vectors: FloatArray, d: int) -> FloatArray:
    """(..., d, d) of (..., p)."""
    rows, columns, factor = indices(d)
    matrices = np.zeros((*vectors.shape[:-1], d, d))
    matrices[..., rows, columns] = vectors / factor
    matrices[..., columns, rows] = vectors / factor
    return matrices


def lyapunov(matrix: FloatArray) -> FloatArray:
    """(p, p) matrix of C -> Z C + C Z^T, for Z (d, d)."""
    return 2.0 * product(matrix, np.eye(len(matrix)))


def product(a: FloatArray, b: FloatArray) -> FloatArray:
    """(p, p) matrix of C -> (A C B^T + B C A^T) / 2, for A and B (d, d)."""
    i, j, factor = indices(len(a))
    total = a[np.ix_(i, i)] * b[np.ix_(j, j)]
    total += a[np.ix_(i, j)] * b[np.ix_(j, i)]
    total += b[np.ix_(i, i)] * a[np.ix_(j, j)]
    total += b[np.ix_(i, j)] * a[np.ix_(j, i)]
    # An off-diagonal entry of C stands for two of the terms, hence 1/2 of the sum; a diagonal one 1/4.
    total *= np.where(i == j, 0.25, 0.5)
    return np.asarray(total * factor[:, None] / factor)
