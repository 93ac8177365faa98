# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What lost messages add to a step's map of second moments, and the adjoint of that, matrix-free.

Without kept values, a message from j to i that may be lost adds variance_ij E[(x_i - x_j)^2] to the second moment of
agent i. In general it changes the stack z by xi u v^T z, with xi of mean 0 and variance 1, independent of all others:
u is what it acts on, v the difference between what it brings and what takes its place. One loss may act on the
difference that a later one of the same step sees: with q_e = E[(v_e^T z)^2] at the moment of e,

    q_e = v_e^T C v_e + sum_(f before e) R_ef q_f,    L[C] = sum_e q_e u_e u_e^T

is added to A C A^T; all v are for the z at the beginning of the step, all u for that at its end (docs/theory.md,
"Messages one by one").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray


def lost(lift: FloatArray, variance: FloatArray, moments: FloatArray) -> FloatArray:
    """(..., n, d, d): sum_ij variance_ij <(e_i - e_j)(e_i - e_j)^T, C> e_i e_i^T in reduced coordinates.

    ``lift``: (k, d), see ``JumpSystem``; ``variance``: (n, k, k), see ``StepModel``; ``moments``: symmetric C.
    """
    full = lift @ moments @ lift.T
    own = np.diagonal(full, axis1=-2, axis2=-1)
    squares = own[..., :, None] + own[..., None, :] - 2.0 * full
    spread = (variance * squares).sum(axis=-1)
    return np.asarray(lift.T @ (spread[..., None] * lift))


def lost_adjoint(lift: FloatArray, variance: FloatArray, forms: FloatArray) -> FloatArray:
    """(..., n, d, d): sum_ij variance_ij <e_i e_i^T, Y> (e_i - e_j)(e_i - e_j)^T, the adjoint of ``lost``."""
    seen = variance * ((lift @ forms) * lift).sum(axis=-1)[..., None]
    laplacian = -(seen + seen.swapaxes(-1, -2))
    laplacian += np.eye(len(lift)) * (seen.sum(axis=-1) + seen.sum(axis=-2))[..., None]
    return np.asarray(lift.T @ laplacian @ lift)


@dataclass(frozen=True, slots=True, eq=False)
class LossEvents:
    """The losses of one step under each of n graphs; zeros where a graph has fewer than L."""

    into: FloatArray  # (n, L, d) u
    differences: FloatArray  # (n, L, d) v
    chain: FloatArray | None  # (n, L, L) (I - R)^-1; None where no loss acts on what another one sees

    def lost(self, moments: FloatArray) -> FloatArray:
        """(..., n, d, d): L[C] of the moments C (..., n, d, d)."""
        seen = ((self.differences @ moments) * self.differences).sum(axis=-1)
        if self.chain is not None:
            seen = (self.chain @ seen[..., None])[..., 0]
        return np.asarray(self.into.swapaxes(-1, -2) @ (seen[..., None] * self.into))

    def adjoint(self, forms: FloatArray) -> FloatArray:
        """(..., n, d, d): the adjoint of ``lost``, of forms Y (..., n, d, d)."""
        felt = ((self.into @ forms) * self.into).sum(axis=-1)
        if self.chain is not None:
            felt = (self.chain.swapaxes(-1, -2) @ felt[..., None])[..., 0]
        return np.asarray(self.differences.swapaxes(-1, -2) @ (felt[..., None] * self.differences))

    def uses(self) -> BoolArray:
        """(d, d): whether a loss changes coordinate a by what it sees in b, in any graph; too often with a chain."""
        found = np.zeros((self.into.shape[2],) * 2, dtype=np.bool_)
        for changed, seen in zip(self.into != 0.0, self.differences != 0.0, strict=True):
            if self.chain is None:
                found |= (changed.T.astype(float) @ seen.astype(float)) > 0.0
            else:
                found |= np.outer(changed.any(axis=0), seen.any(axis=0))
        return found

    def of_mode(self, mode: int) -> LossEvents:
        """Those of one graph, from 0."""
        chain = None if self.chain is None else self.chain[mode : mode + 1]
        return LossEvents(self.into[mode : mode + 1], self.differences[mode : mode + 1], chain)

    def projected(self, basis: FloatArray) -> LossEvents:
        """In the coordinates that the columns of ``basis`` (d, d') span."""
        return LossEvents(self.into @ basis, self.differences @ basis, self.chain)
