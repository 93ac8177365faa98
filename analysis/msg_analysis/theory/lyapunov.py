# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Lyapunov and Stein solves of uncoupled systems: one in every graph, and one on the average of the graphs.

With the eigenvectors of D a solve is a division, entry by entry, between products of matrices. Symmetric matrices use
them always, others if they are well conditioned, else the complex Schur form (Bartels and Stewart 1972).
"""

from __future__ import annotations

import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg

from msg_analysis.common.arrays import AnyArray, ComplexArray, FloatArray
from msg_analysis.experiment.markov_chain import Time

# Largest condition of eigenvectors that are used: a solve has errors of its square times 1e-16, before refinement.
MAX_CONDITION = 1e4
MAX_CONDITION_NEARLY = 1e6  # the same where a solve need not be exact
APART = 1e-6  # relative size of changes of the diagonal that keep eigenvectors apart
MILD = 1e-4  # slowest decay, relative to the fastest, for which single precision suffices in a preconditioner
EIGENVALUE_ROUNDING = 8.0 * float(np.finfo(float).eps)  # eigenvalues below this * dimension * largest one are 0


class Eigenvectors(NamedTuple):
    """D = vectors diag(values) inverse, for k matrices; complex unless they are symmetric."""

    values: FloatArray | ComplexArray
    vectors: FloatArray | ComplexArray
    inverse: FloatArray | ComplexArray


class LocalSolves:
    """k uncoupled solves, factorised: with the matrix D (Z, or I - W in discrete time) of a system left at the rate a,

        continuous: D X + X D^T + a X = F
        discrete:   X - W X W^T + a W X W^T = F

    D: ``drift`` (k, d, d), treated as symmetric only if symmetric to the last bit; a: ``leaving`` (k,). Eigenvalues
    that are zero but for rounding (in a disconnected graph) count as zero: such directions are left at the rate a only,
    however slow that is. ``nearly``: a solve that is right to about ``APART`` will do, where that is much faster.
    """

    def __init__(
        self,
        time: Time,
        drift: FloatArray,
        leaving: FloatArray,
        eigenvectors: Eigenvectors | None = None,
        *,
        nearly: bool = False,
    ) -> None:
        self._nearly = nearly
        self.time, self.drift, self.leaving = time, drift, leaving
        self.symmetric = np.array_equal(drift, drift.transpose(0, 2, 1))
        self.eigenvectors = eigenvectors or _eigenvectors(drift, symmetric=self.symmetric)
        if self.eigenvectors is None and nearly:
            self.eigenvectors = _eigenvectors(_separated(drift), symmetric=False, nearly=True)
        if self.eigenvectors is None:
            forms = [scipy.linalg.schur(d, output="complex") for d in drift]
            self._schur = np.stack([t for t, _ in forms]), np.stack([u for _, u in forms])
            values = np.diagonal(self._schur[0], axis1=1, axis2=2)
        else:
            values = self.eigenvectors.values
        size = np.abs(values).max(axis=1, initial=0.0, keepdims=True)
        self._null = np.abs(values) <= EIGENVALUE_ROUNDING * drift.shape[1] * size
        values = np.where(self._null, 0.0, values)
        row, column, rate = values[:, :, None], values[:, None, :], leaving[:, None, None]
        if time == "continuous":
            divisor, self._numerator = row + column + rate, None
        else:
            self._numerator = (1.0 - row) * (1.0 - column)
            divisor = row + column - row * column + rate * self._numerator
        self._divisor = np.where(divisor == 0.0, 1.0, divisor)  # such a solve is wrong, which the residual shows
        # Whether single precision gives useful solutions.
        self.mild = self.symmetric and bool((np.abs(divisor).min(axis=(1, 2)) >= MILD * size[:, 0]).all())

    def transposed(self) -> LocalSolves:
        """The same for D^T."""
        if self.eigenvectors is None:
            return LocalSolves(self.time, self.drift.transpose(0, 2, 1).copy(), self.leaving, nearly=self._nearly)
        values, vectors, inverse = self.eigenvectors
        swapped = Eigenvectors(values, inverse.transpose(0, 2, 1), vectors.transpose(0, 2, 1))
        return LocalSolves(self.time, self.drift.transpose(0, 2, 1), self.leaving, swapped, nearly=self._nearly)

    def single(self) -> LocalSolves:
        """The same in single precision."""
        other = copy.copy(self)
        other.__dict__.pop("_null_factors", None)  # of these eigenvectors
        other.drift, other.leaving = single(self.drift), single(self.leaving)
        if self.eigenvectors is not None:
            other.eigenvectors = Eigenvectors(*[single(part) for part in self.eigenvectors])
        other._divisor = single(self._divisor)
        other._numerator = None if self._numerator is None else single(self._numerator)
        return other

    def __call__(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(X, Y) for symmetric F (..., k, d, d); for the coupling, Y = X in continuous and W X W^T in discrete time."""
        if self.eigenvectors is None:
            return self._by_schur(right)
        _, vectors, inverse = self.eigenvectors
        inner = inverse @ right @ inverse.transpose(0, 2, 1)
        inner /= self._divisor
        if self._numerator is not None:
            inner *= self._numerator
        moved = _symmetric((vectors @ inner @ vectors.transpose(0, 2, 1)).real)
        if self.time == "continuous":
            return moved, moved
        return right + (1.0 - self.leaving)[:, None, None] * moved, moved

    def _by_schur(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        triangles, vectors = self._schur
        adjoint = vectors.conj().transpose(0, 2, 1)
        inner = adjoint @ right @ vectors
        for k, triangle in enumerate(triangles):
            inner[..., k, :, :] = _triangular(self.time, triangle, float(self.leaving[k]), inner[..., k, :, :])
        moved = _symmetric((vectors @ inner @ adjoint).real)
        if self.time == "continuous":
            return moved, moved
        step = np.eye(self.drift.shape[1]) - self.drift
        return moved, _symmetric(step @ moved @ step.transpose(0, 2, 1))

    @property
    def amplification(self) -> float:
        """How much inverting D, scaled, magnifies relative errors, from the diagonal of D^-1; inf if singular."""
        size = np.abs(np.diagonal(self.drift, axis1=1, axis2=2)) if self.time == "continuous" else 1.0
        if self._null.any():
            return np.inf
        if self.symmetric and self.eigenvectors is not None:
            inverse = (self.eigenvectors.vectors**2 / self.eigenvectors.values[:, None, :]).sum(axis=2)
        else:
            inverse = np.diagonal(np.linalg.inv(self.drift), axis1=1, axis2=2)
        found = float((np.abs(inverse) * size).max(initial=0.0))
        return found if np.isfinite(found) else np.inf

    def without_null(self, matrices: FloatArray) -> FloatArray:
        """(..., k, d, d) without the directions in which D is zero but for rounding."""
        if self._null_factors is None:
            return matrices
        left, right = self._null_factors
        return np.asarray(matrices - (left @ (right @ matrices)).real)

    @cached_property
    def _null_factors(self) -> tuple[AnyArray, AnyArray] | None:
        """(k, d, z) and (k, z, d), whose product is the projection on the directions in which D is zero; None: none."""
        if self.eigenvectors is None or not self._null.any():
            return None
        _, vectors, inverse = self.eigenvectors
        keep = int(self._null.sum(axis=1).max())
        order = np.argsort(~self._null, axis=1, kind="stable")[:, :keep]  # padded where there are fewer
        used = np.take_along_axis(self._null, order, axis=1)
        left = np.take_along_axis(vectors, order[:, None, :], axis=2) * used[:, None, :]
        return left, np.take_along_axis(inverse, order[:, :, None], axis=1)


def _separated(drift: FloatArray) -> FloatArray:
    """The matrices with slightly different diagonals, so that hardly any has defective eigenvectors."""
    size = np.abs(drift).max(axis=(1, 2), initial=0.0)
    apart = APART * np.random.default_rng(0).uniform(-1.0, 1.0, drift.shape[1])
    return np.asarray(drift + size[:, None, None] * np.diag(apart))


def _eigenvectors(drift: FloatArray, *, symmetric: bool, nearly: bool = False) -> Eigenvectors | None:
    """Well-conditioned ones, or None; ``nearly``: right to about ``APART``."""
    most = MAX_CONDITION_NEARLY if nearly else MAX_CONDITION
    if symmetric:
        values, vectors = np.linalg.eigh(drift)
        return Eigenvectors(values, vectors, vectors.transpose(0, 2, 1))
    values, vectors = np.linalg.eig(drift)
    if nearly and (np.abs(values.imag) <= 10.0 * APART * np.abs(values).max(axis=1, initial=0.0, keepdims=True)).all():
        # Real pairs that the change has made complex, p + i q and p - i q: real products take a quarter of the time.
        vectors = np.where(values.imag[:, None, :] < 0.0, vectors.imag, vectors.real)
        values = values.real
    try:
        inverse = np.linalg.inv(vectors)
    except np.linalg.LinAlgError:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        condition = np.linalg.norm(vectors, axis=(1, 2)) * np.linalg.norm(inverse, axis=(1, 2))
    if not (condition <= most * np.sqrt(drift.shape[1])).all():
        return None
    return Eigenvectors(values, vectors, inverse)


def single(array: AnyArray) -> AnyArray:
    """The array in single precision, real or complex."""
    return array.astype(np.complex64 if np.iscomplexobj(array) else np.float32)


def _symmetric(matrices: FloatArray) -> FloatArray:
    """Symmetric to the last bit: the equations hold for symmetric matrices only."""
    total = matrices + matrices.swapaxes(-1, -2)
    total *= 0.5
    return total


def _triangular(time: Time, t: ComplexArray, leaving: float, right: ComplexArray) -> ComplexArray:
    """(..., d, d): the solution X = X^H for the upper triangular matrix D = t, column after column from the last."""
    d = len(t)
    columns = np.moveaxis(right.reshape(-1, d, d), 0, 2).swapaxes(0, 1).copy().reshape(d, -1)  # (column, row and form)
    eye, step, stay = np.eye(d), np.eye(d) - t, 1.0 - leaving
    rows = (t if time == "continuous" else step).conj()
    for k in range(d - 1, -1, -1):
        known = (rows[k, k + 1 :] @ columns[k + 1 :]).reshape(d, -1)
        if time == "continuous":
            matrix = t + (rows[k, k] + leaving) * eye
            known = -known
        else:
            matrix = eye - (stay * rows[k, k]) * step
            known = stay * (step @ known)
        columns[k] = scipy.linalg.lapack.ztrtrs(matrix, columns[k].reshape(d, -1) + known)[0].reshape(-1)
    return np.moveaxis(columns.reshape(d, d, -1).swapaxes(0, 1), 2, 0).reshape(right.shape)
