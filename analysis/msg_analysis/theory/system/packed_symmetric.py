"""Symmetric matrices as vectors of their d (d + 1) / 2 free entries.

Off-diagonal entries carry a factor sqrt(2), so that <A, B> = tr(A B) is the dot product of the vectors, and
the adjoint of a map between symmetric matrices is the transpose of its matrix.

This is the vector "svec" of semidefinite programming (Alizadeh, Haeberly and Overton 1998).
"""

from __future__ import annotations

import numpy as np

from msg_analysis.types import FloatArray, IntArray


def size(d: int) -> int:
    """Number of free entries, d (d + 1) / 2.

    Parameters
    ----------
    d
        rows of a symmetric matrix
    """
    return d * (d + 1) // 2


def indices(d: int) -> tuple[IntArray, IntArray, FloatArray]:
    """(row, column, factor) of each entry of the vector.

    Parameters
    ----------
    d
        rows of a symmetric matrix
    """
    rows, columns = np.tril_indices(d)
    return rows, columns, np.where(rows == columns, 1.0, np.sqrt(2.0))


def pack(matrices: FloatArray) -> FloatArray:
    """(..., p) of symmetric (..., d, d).

    Parameters
    ----------
    matrices
        (..., d, d) symmetric

    Returns
    -------
    FloatArray
        (..., p)
    """
    rows, columns, factor = indices(matrices.shape[-1])
    return np.asarray(matrices[..., rows, columns] * factor)


def unpack(vectors: FloatArray, d: int) -> FloatArray:
    """(..., d, d) of (..., p).

    Parameters
    ----------
    vectors
        (..., p) packed
    d
        rows of the matrices

    Returns
    -------
    FloatArray
        (..., d, d)
    """
    rows, columns, factor = indices(d)
    matrices = np.zeros((*vectors.shape[:-1], d, d))
    matrices[..., rows, columns] = vectors / factor
    matrices[..., columns, rows] = vectors / factor
    return matrices


def lyapunov(matrix: FloatArray) -> FloatArray:
    """(p, p) matrix of C -> Z C + C Z^T.

    Parameters
    ----------
    matrix
        (d, d) Z
    """
    return 2.0 * product(matrix, np.eye(len(matrix)))


def product(a: FloatArray, b: FloatArray) -> FloatArray:
    """(p, p) matrix of C -> (A C B^T + B C A^T) / 2.

    Parameters
    ----------
    a
        (d, d) A
    b
        (d, d) B
    """
    i, j, factor = indices(len(a))
    total = a[np.ix_(i, i)] * b[np.ix_(j, j)]
    total += a[np.ix_(i, j)] * b[np.ix_(j, i)]
    total += b[np.ix_(i, i)] * a[np.ix_(j, j)]
    total += b[np.ix_(i, j)] * a[np.ix_(j, i)]
    # A diagonal entry of C appears once, an off-diagonal one twice: 1/2 of the sum there, 1/4 here.
    total *= np.where(i == j, 0.25, 0.5)
    return np.asarray(total * factor[:, None] / factor)
