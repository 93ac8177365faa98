# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The matrix exponential, the same to the last bit on every processor.

The libraries' own differs from processor to processor, because the order of the sums in a matrix product does. Here
products are made of slices of few bits, whose sums are exact in any order (Ozaki, Ogita, Oishi and Rump 2012).
"""

from __future__ import annotations

import math

import numpy as np

from msg_analysis.common.arrays import FloatArray

SLICES = 3
TERMS = 13
"""Of the Taylor series, at a norm of at most 1/8: the next one is below 1e-22."""


def exponential(matrix: FloatArray) -> FloatArray:
    """(m, m) exp(A) by scaling and squaring of exp(A) - I, which keeps the accuracy of small entries."""
    norm = float(np.abs(matrix).sum(axis=1).max(initial=0.0))
    squarings = max(0, math.frexp(norm)[1] + 3)
    scaled = matrix * 2.0**-squarings
    less_one = term = scaled
    for k in range(2, TERMS + 1):
        term = reproducible_product(term, scaled) / k
        less_one = less_one + term
    for _ in range(squarings):
        less_one = 2.0 * less_one + reproducible_product(less_one, less_one)
    return np.asarray(np.eye(len(matrix)) + less_one)


def reproducible_product(a: FloatArray, b: FloatArray) -> FloatArray:
    """(m, m) A B, the same on every processor; its error is about 1e-16 of the largest entries of A and B."""
    bits = (53 - math.frexp(len(a))[1]) // 2
    left, right = _slices(a, bits), _slices(b, bits)
    total = np.zeros(a.shape)
    for depth in range(SLICES - 1, -1, -1):  # small ones first
        for i in range(depth + 1):
            total += left[i] @ right[depth - i]  # every sum in it is exact
    return total


def _slices(matrix: FloatArray, bits: int) -> list[FloatArray]:
    """The matrix as a sum of matrices of whole multiples of 2^-bits, 2^-2bits, ... of its largest entry."""
    unit = 2.0 ** math.frexp(float(np.abs(matrix).max(initial=0.0)))[1]
    slices, rest = [], matrix
    for _ in range(SLICES):
        unit *= 2.0**-bits
        slices.append(np.rint(rest / unit) * unit)
        rest = rest - slices[-1]
    return slices
