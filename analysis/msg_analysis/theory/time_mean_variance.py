# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Variance of the time mean of the system error over a run, before any run. Discrete time.

Given the path (graphs and losses), a stationary state is y ~ N(0, M), and replicas are independent. M obeys
M' = A M A^T + noise with the random matrix A of a step, so T_i = E[M M; mode i] solves linear equations, those of
``fourth_moments`` with noise. It has all fourth moments of y, for E[(y^T S y)^2 | M] = tr(S M)^2 + 2 tr(S M S M).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.errors import InputError
from msg_analysis.model.step_model import build_run_model
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.fourth_moments import RandomSteps, Stage, before_jump, random_steps
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.moments import MomentSolver, mode_potential
from msg_analysis.theory.prediction import Prediction

MAX_WORK = 1e8  # multiplications of a step of T, up to which it is solved for
SAMPLED = 2e9  # multiplications of the steps that are sampled otherwise
PATHS, REPLICAS = 32, 8  # that are sampled, for at least so many steps:
FEWEST = 200
SPARSE = 0.1  # share of entries that are not 0 below which a matrix is multiplied as a sparse one
ROUNDING = 1e-12  # of entries of a root, relative to its diagonal
STAGE = 2000.0  # multiplications that take as long as the rest of a stage
HEAVY = (
    "system error: its time mean has no finite variance, because fourth moments of the states do not exist; lower the "
    "weights, losses or run.dt, or look at the innovations only"
)


@dataclass(frozen=True, slots=True)
class MeanVariance:
    """N times the variance of the time mean over N steps, for large N: path + replica / R with R replicas."""

    path: float  # of graphs and losses, which replicas share
    replica: float  # of the noise, independent in every replica
    samples: FloatArray | None = None  # (B, 2) path and replica of single sampled paths; None: both are exact

    def of(self, replicas: float) -> float:
        """With so many replicas."""
        return self.path + self.replica / replicas

    @property
    def exact(self) -> bool:
        """Whether it is not sampled."""
        return self.samples is None

    def error(self, replicas: float) -> float:
        """Relative standard error of the square root of ``of``, because it was sampled; 0 where it is exact."""
        if self.samples is None:
            return 0.0
        scatter = (self.samples @ [1.0, 1.0 / replicas]).std(ddof=1) / math.sqrt(len(self.samples))
        return 0.5 * float(scatter) / self.of(replicas)


def mean_variance(prediction: Prediction, *, most_work: float = MAX_WORK, sampled: float = SAMPLED) -> MeanVariance:
    """Asymptotic variance of the time mean of the system error h = y^T H y, from its Poisson equation.

    Its solution f(y, g) = y^T Y_g y + kappa_g (adjoint solutions Y, potential kappa of the graphs) makes
    D_k = f(next) - f(now) + h - E[h] a martingale difference (docs/statistics.md, "Standard errors"), whose variance is
    that of the time mean times N. f has the same distribution before and after a step, so

        E[D^2] = 2 E[f (h - E[h])] - E[(h - E[h])^2]

    which follows from T. In a system too large for T (``most_work`` multiplications), D^2 is averaged over sampled
    steps (of ``sampled`` multiplications) of several paths, each with several replicas. InputError: the variance is not
    finite, or cannot be computed.
    """
    system, solver = prediction.system, prediction.solver
    if not system.dimension:
        return MeanVariance(0.0, 0.0)
    if prediction.fourth_moment.finite is False:
        raise InputError(HEAVY)
    form = system.output.T @ system.output
    values = solver.dual(form[None])
    kappa = mode_potential(system, values)[1][0]
    steps = random_steps(build_run_model(prediction.experiment, prediction.step), system)
    size = float(len(steps.embedding))
    work = sum(size**4 * (4.0 * size + 4.0 * len(one.losses)) for stages in steps.stages for one in stages)
    if work <= most_work:
        try:
            return _exact(steps, system, prediction.steady, form, values[0], kappa)
        except InputError:  # the equations of T are too ill-conditioned
            pass
    return _Sampler(steps, system, prediction.steady).variance(system.output, values[0], kappa, sampled)


def _exact(
    steps: RandomSteps, system: JumpSystem, steady: FloatArray, form: FloatArray, values: FloatArray, kappa: FloatArray
) -> MeanVariance:
    """From T, with replicas that share M: E[y^T Y y y^T H y] of one is tr(Y M) tr(H M) + 2 tr(Y M H M)."""
    moments = _moments_of_path(steps, system, steady)
    error = np.einsum("nab,ab->n", steady, form)
    mean = float(error.sum())
    twice = 2.0 * values - form
    path = float(np.einsum("nabcd,nab,cd->", moments, twice, form, optimize=True) + 2.0 * (kappa @ error))
    path -= mean * (2.0 * float((values * steady).sum() + kappa @ system.stationary) - mean)
    replica = 2.0 * float(np.einsum("nbcda,nab,cd->", moments, twice, form, optimize=True))
    return MeanVariance(max(path, 0.0), max(replica, 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Covariances(JumpSystem):
    """The packed M as a jump linear system, with K_i in place of W_i; "lost" is all that losses add to K T K^T."""

    steps: RandomSteps | None = None

    @property
    def lossy(self) -> bool:
        """Whether K_i alone is not all."""
        return self.steps is not None

    def lost(self, moments: FloatArray) -> FloatArray:
        """(..., n, p, p) of T (..., n, p, p)."""
        assert self.steps is not None
        d = self.steps.embedding.shape[1]
        tensors = [
            _packed(before_jump(self.steps, _unpacked(one, d))) for one in moments.reshape(-1, *self.noise.shape)
        ]
        return np.reshape(tensors, moments.shape) - self.matrices @ moments @ self.matrices.swapaxes(-1, -2)


def _packed(tensors: FloatArray) -> FloatArray:
    """(n, p, p) of (n, d, d, d, d)."""
    first = packed_symmetric.pack(tensors)  # the last pair
    return packed_symmetric.pack(np.moveaxis(first, -1, 1))


def _unpacked(moments: FloatArray, d: int) -> FloatArray:
    return packed_symmetric.unpack(np.moveaxis(packed_symmetric.unpack(moments, d), 1, -1), d)


def _moments_of_path(steps: RandomSteps, system: JumpSystem, steady: FloatArray) -> FloatArray:
    """(n, d, d, d, d) T, before a step."""
    n, d, law = system.modes, system.dimension, system.stationary
    p = packed_symmetric.size(d)
    basis = packed_symmetric.unpack(np.eye(p), d)[:, None]  # (p, 1, d, d)
    images = packed_symmetric.pack(system.propagate(np.broadcast_to(basis, (p, n, d, d))))
    added = _packed(before_jump(steps, np.zeros((n, d, d, d, d)), steady, law))
    covariances = _Covariances(
        time="discrete",
        matrices=np.ascontiguousarray(images.transpose(1, 2, 0)),
        noise=added / law[:, None, None],
        chain=system.chain,
        stationary=law,
        lift=np.eye(p),
        steps=steps if system.lossy else None,
    )
    return _unpacked(MomentSolver(covariances).steady(), d)


class _Sampler:
    """Paths of graphs and losses, with replicas of the states z (B R, k) that go through the stages."""

    def __init__(self, steps: RandomSteps, system: JumpSystem, steady: FloatArray) -> None:
        self._steady, self._rng, self._embedding = steady, np.random.default_rng(0), steps.embedding
        self._chain = system.chain.cumsum(axis=1)
        self._stages = [[_Drawn.of(stage) for stage in stages] for stages in steps.stages]
        self._modes = self._rng.choice(system.modes, PATHS, p=system.stationary)
        self._states = np.empty((PATHS, REPLICAS, len(self._embedding)))
        for mode, at in self._groups():
            root = self._embedding @ _root(steady[mode] / system.stationary[mode])
            self._states[at] = (self._normal(len(at), root.shape[1]) @ root.T).reshape(len(at), REPLICAS, -1)

    def variance(self, output: FloatArray, values: FloatArray, kappa: FloatArray, work: float) -> MeanVariance:
        """From the means of D^2 over about so many multiplications of steps."""
        mean = float((self._steady * (output.T @ output)).sum())
        output, values = output @ self._embedding.T, self._embedding @ values @ self._embedding.T
        each = max(sum(stage.work for stage in stages) for stages in self._stages)
        count = max(FEWEST, round(work / (PATHS * REPLICAS * each)))
        found = np.zeros((PATHS, 2))
        for _ in range(count // 4):  # M becomes stationary: at first it is its mean
            self._advance()
        value = self._values(values, kappa)
        for _ in range(count):
            expected = value - np.square(self._states @ output.T).sum(axis=-1) + mean
            self._advance()
            value = self._values(values, kappa)
            within = (value - expected).var(axis=1, ddof=1)
            found += np.stack([(value - expected).mean(axis=1) ** 2 - within / REPLICAS, within], axis=1)
        found /= count
        path, replica = found.mean(axis=0).tolist()
        return MeanVariance(max(path, 0.0), replica, found)

    def _values(self, values: FloatArray, kappa: FloatArray) -> FloatArray:
        """(B, R): f."""
        found = np.empty(self._states.shape[:2])
        for mode, at in self._groups():
            found[at] = ((self._states[at] @ values[mode]) * self._states[at]).sum(axis=-1) + kappa[mode]
        return found

    def _advance(self) -> None:
        for mode, at in self._groups():
            z = self._states[at].reshape(len(at) * REPLICAS, -1)
            for stage in self._stages[mode]:
                moved = z.copy()
                moved[:, stage.rows] = z @ stage.matrix.T + self._normal(len(at), stage.root.shape[1]) @ stage.root.T
                if len(stage.losses):
                    arrives = (self._rng.random((len(at), len(stage.losses))) >= stage.losses).astype(float)
                    arrives = arrives.repeat(REPLICAS, axis=0)
                    change = (arrives - 1.0 + stage.losses) * (z @ stage.differences.T)
                    if stage.heard:
                        change += math.sqrt(stage.heard) * arrives * self._normal(len(at), len(stage.losses))
                    moved += change @ stage.into
                z = moved
            self._states[at] = z.reshape(len(at), REPLICAS, -1)
        drawn = self._rng.random((PATHS, 1))
        self._modes = np.minimum((drawn >= self._chain[self._modes]).sum(axis=1), len(self._chain) - 1)

    def _normal(self, paths: int, size: int) -> FloatArray:
        """(B R, size) of these paths."""
        return self._rng.standard_normal((paths * REPLICAS, size))

    def _groups(self) -> list[tuple[int, IntArray]]:
        """Every mode that some path is in, and these paths."""
        return [(mode, np.flatnonzero(self._modes == mode)) for mode in np.unique(self._modes).tolist()]


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """A ``Stage`` to be drawn, in sparse matrices where most entries are 0, as those of messages one by one."""

    rows: IntArray
    matrix: Any
    root: Any  # (r, r) B with B B^T the covariance of the noise without that in messages that may be lost
    into: Any
    differences: Any
    losses: FloatArray
    heard: float
    work: float  # multiplications, if nothing were sparse

    @classmethod
    def of(cls, stage: Stage) -> _Drawn:
        """The same."""
        heard = stage.into[:, stage.rows]
        unheard = stage.noise - stage.heard * (heard.T * (1.0 - stage.losses)) @ heard
        matrix, root, into, differences = map(_sparse, (stage.matrix, _root(unheard), stage.into, stage.differences))
        work = stage.matrix.size + 2.0 * stage.into.size + STAGE
        return cls(stage.rows, matrix, root, into, differences, stage.losses, stage.heard, work)


def _sparse(matrix: FloatArray) -> Any:
    """The matrix, sparse where that is less work."""
    return scipy.sparse.csr_array(matrix) if np.count_nonzero(matrix) < SPARSE * matrix.size else matrix


def _root(covariance: FloatArray) -> FloatArray:
    """(k, k) B = B^T with B B = covariance: unlike a root of eigenvectors, the same samples on every processor."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-14 * np.abs(values).max(initial=0.0)
    root = vectors[:, kept] * np.sqrt(values[kept]) @ vectors[:, kept].T
    scale = np.sqrt(np.abs(np.diagonal(root)))
    return np.where(np.abs(root) > ROUNDING * np.outer(scale, scale), root, 0.0)
