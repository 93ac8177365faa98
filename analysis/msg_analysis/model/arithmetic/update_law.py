"""The update law, once: agents, twin and checks all call these functions.

Bit-for-bit equality between a network of processes and the vectorised twin rests on two rules kept here: sums run over
the agents in ascending order, one term at a time (never through BLAS or a reduction, whose order depends on shapes and
threads), and each term is one multiplication and one addition of doubles.
"""

from __future__ import annotations

from collections.abc import Sequence

from msg_analysis.types import FloatArray


def weighted_sum(weights: Sequence[float | FloatArray], values: Sequence[FloatArray]) -> FloatArray:
    """sum_j weights[j] * values[j], term after term, in the order given.

    Parameters
    ----------
    weights
        numbers, or arrays of a shape that broadcasts against the values
    values
        arrays of one shape, at least one

    Returns
    -------
    FloatArray
        of the shape of a value
    """
    terms = zip(values, weights, strict=True)
    value, weight = next(terms)
    total = value * weight
    for value, weight in terms:
        total += value * weight
    return total


def step(weights: Sequence[float | FloatArray], values: Sequence[FloatArray], drive: FloatArray) -> FloatArray:
    """x_i(k+1) = sum_j W_ij x_j(k) + drive_i(k).

    Parameters
    ----------
    weights
        the non-zero W_ij of row i, j ascending; or, of many rows at once, columns of shape (m, 1), padded with zeros
    values
        the matching x_j(k), each (R,), one entry for each replica; of many rows, (m, R)
    drive
        noise_i(k) + offset_i, of the shape of a value, the offset being what a reference adds to the row

    Returns
    -------
    FloatArray
        x_i(k+1), of the shape of a value
    """
    total = weighted_sum(weights, values)
    total += drive
    return total
