"""Linear algebra in many digits: numpy arrays of Decimal, whose arithmetic is compiled."""

from decimal import Decimal, localcontext

import numpy as np
from numpy.typing import ArrayLike, NDArray

DIGITS = 80
Numbers = NDArray[np.object_]


def exactly(values: ArrayLike) -> Numbers:
    """The same numbers, to the last bit."""
    given = np.asarray(values, dtype=float)
    return np.array([Decimal(x) for x in given.ravel().tolist()], dtype=object).reshape(given.shape)


def solve(matrix: Numbers, right: Numbers) -> Numbers:
    """Solution (n,) by elimination with partial pivoting; of zeros alone is made use."""
    with localcontext(prec=DIGITS):
        rows = np.column_stack([matrix, right])
        n = len(rows)
        for k in range(n):
            pivot = k + int(np.argmax(np.abs(rows[k:, k])))
            rows[[k, pivot]] = rows[[pivot, k]]
            filled = np.flatnonzero(rows[k] != 0)
            for i in k + 1 + np.flatnonzero(rows[k + 1 :, k] != 0):
                rows[i, filled] -= rows[i, k] / rows[k, k] * rows[k, filled]
        solution = np.zeros(n, dtype=object)
        for k in reversed(range(n)):
            solution[k] = (rows[k, n] - rows[k, k + 1 : n] @ solution[k + 1 :]) / rows[k, k]
        return solution


def expm(matrix: Numbers) -> Numbers:
    """Taylor series of the matrix over a power of 2, squared as often."""
    with localcontext(prec=DIGITS):
        size = float(np.abs(matrix).sum(axis=1).max())
        squarings = max(0, int(np.ceil(np.log2(size)))) + 8 if size else 0
        scaled = matrix / Decimal(2) ** squarings
        term = total = exactly(np.eye(len(matrix)))
        order = 0
        while np.abs(term).max() > Decimal(10) ** -DIGITS:
            order += 1
            term = term @ scaled / order
            total = total + term
        for _ in range(squarings):
            total = total @ total
        return total
