# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The paper's lemmas on eigenvalues, checked for one network: how many are at 0 (or 1), and where the others are.

The matrices are those of the paper in full Kronecker form, unreduced, n m^2 rows, because the lemmas are about these.
They are used for nothing else.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from msg_analysis.arithmetic.reproducible import exponential
from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.model.step_model import build_step_model

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment


MAX_UNKNOWNS = 1500  # largest n m^2: all eigenvalues of a matrix of this size take a few seconds

# In units of rows times largest entry: what is smaller is 0, what is larger is not, between them it is unknown.
_BLURRED = 1e-13, 1e-10


@dataclass(frozen=True, slots=True, eq=False)
class Fact:
    """One matrix of the paper and what a lemma says about its eigenvalues."""

    name: str  # the matrix, as in the paper
    statement: str  # what the lemma says, corrected where the paper is wrong (docs/errata.md)
    holds: bool  # whether it is true of this network
    target: float  # the special eigenvalue: 0 in continuous time, 1 in discrete time
    expected: int  # number of eigenvalues at the target, by the lemma
    multiplicity: int  # the same counted,
    nullity: int  # and counted as null vectors
    others: float  # least real part of the others (continuous time, must be > 0), or largest modulus (must be < 1)
    residual: float  # largest entry of (matrix - target) @ v, v the null vectors of the lemma, over that of the matrix

    def to_json(self) -> dict[str, Any]:
        """The document of one fact."""
        return asdict(self)


def check_facts(experiment: Experiment) -> list[Fact]:
    """Check every lemma on eigenvalues that applies to this experiment's time and problem (Lemmas 1 to 4 of the paper).

    Continuous time: N_c, M_c and their projections (consensus), or N_k, M_k (tracking). Discrete time: H_c, A_c and
    their projections, or H_k, A_k. Graphs may be directed, weighted and disconnected, if their union connects all
    agents. Leaders of infinite gain are deleted. With a linear protocol, its steps take the place of W = exp(-Z) in
    discrete time. With z_i zero eigenvalues of L_i (1 if graph i is connected), the nullities of the projected matrices
    in continuous time are (docs/errata.md, 1):

        Nbar_c    n                     vectors e_i (x) 1, not pi (x) 1 alone
        Mbar_c    n + 2 sum (z_i - 1)   vectors e_i (x) 1 (x) 1; and e_i (x) 1 (x) w, e_i (x) w (x) 1 with L_i w = 0

    Parameters
    ----------
    experiment
        with n m^2 up to ``MAX_UNKNOWNS``

    Raises
    ------
    InputError
        n m^2 is too large, or rates and gains differ by so much that rounding hides which eigenvalues are 0
    """
    gains = experiment.leader_gains
    follows = np.isfinite(gains)
    block = np.ix_(follows, follows)
    drifts = [(graph.laplacian + np.diag(np.where(follows, gains, 0.0)))[block] for graph in experiment.graph_list]
    n, m = len(drifts), len(drifts[0])
    if n * m * m > MAX_UNKNOWNS:
        raise InputError(
            f"facts: {n} graphs of {m} agents give matrices of n m^2 = {n * m * m} rows, expected at most "
            f"{MAX_UNKNOWNS}: check a smaller network of the same kind"
        )
    chain, law = experiment.chain.matrix, experiment.switching_law.stationary
    consensus = experiment.problem == "consensus"
    if experiment.protocol:
        step = build_step_model(experiment)
        return _discrete([w[block] for w in step.nominal], step.transition, law, consensus)
    if experiment.time == "continuous":
        return _continuous(drifts, chain, law, consensus)
    return _discrete([exponential(-z) for z in drifts], chain, law, consensus)


def _continuous(drifts: list[FloatArray], generator: FloatArray, law: FloatArray, consensus: bool) -> list[Fact]:
    n, m = len(drifts), len(drifts[0])
    first = scipy.linalg.block_diag(*drifts) - _kron(generator.T, np.eye(m))
    second = scipy.linalg.block_diag(*map(_kronecker_sum, drifts)) - _kron(generator.T, np.eye(m * m))
    if not consensus:
        return [_fact("N_k", first, 0.0, []), _fact("M_k", second, 0.0, [])]
    ones, projector = np.ones(m), np.eye(m) - 1.0 / m
    projected = [projector @ z @ projector for z in drifts]
    first_bar = scipy.linalg.block_diag(*projected) - _kron(generator.T, projector)
    second_bar = scipy.linalg.block_diag(*map(_kronecker_sum, projected))
    second_bar -= _kron(generator.T, _kron(projector, projector))
    modes = np.eye(n)
    second_null = [_kron(e, _kron(ones, ones)) for e in modes]
    for e, z in zip(modes, projected, strict=True):
        # The null space of the projected Laplacian is spanned by 1 and, if the graph is disconnected, by more.
        for w in scipy.linalg.null_space(np.vstack([z, ones]), rcond=1e-10).T:
            second_null += [_kron(e, _kron(ones, w)), _kron(e, _kron(w, ones))]
    return [
        _fact("N_c", first, 0.0, [_kron(law, ones)]),
        _fact("M_c", second, 0.0, [_kron(law, _kron(ones, ones))]),
        _fact("Nbar_c", first_bar, 0.0, [_kron(e, ones) for e in modes]),
        _fact("Mbar_c", second_bar, 0.0, second_null),
    ]


def _discrete(steps: list[FloatArray], transition: FloatArray, law: FloatArray, consensus: bool) -> list[Fact]:
    m = len(steps[0])

    def matrices(weights: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
        first = _kron(transition.T, np.eye(m)) @ scipy.linalg.block_diag(*weights)
        squares = [_kron(w, w) for w in weights]
        return first, _kron(transition.T, np.eye(m * m)) @ scipy.linalg.block_diag(*squares)

    first, second = matrices(steps)
    if not consensus:
        return [_fact("H_k", first, 1.0, []), _fact("A_k", second, 1.0, [])]
    ones, projector = np.ones(m), np.eye(m) - 1.0 / m
    first_bar, second_bar = matrices([projector @ w @ projector for w in steps])
    return [
        _fact("H_c", first, 1.0, [_kron(law, ones)]),
        _fact("A_c", second, 1.0, [_kron(law, _kron(ones, ones))]),
        _fact("Hbar_c", first_bar, 1.0, []),
        _fact("Abar_c", second_bar, 1.0, []),
    ]


def _kron(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.kron(a, b), dtype=float)


def _kronecker_sum(z: FloatArray) -> FloatArray:
    eye = np.eye(len(z))
    return _kron(z, eye) + _kron(eye, z)


def _fact(name: str, matrix: FloatArray, target: float, null_vectors: list[FloatArray]) -> Fact:
    """Count the eigenvalues at the target in two ways, and locate the others."""
    shifted = matrix - target * np.eye(len(matrix))
    scale = float(np.abs(matrix).max(initial=0.0)) or 1.0
    values = np.linalg.eigvals(matrix)
    distances = np.abs(values - target) / scale
    singular = np.linalg.svd(shifted, compute_uv=False) / scale
    zero, clear = (limit * len(matrix) for limit in _BLURRED)
    if any(((sizes > zero) & (sizes < clear)).any() for sizes in (distances, singular)):
        raise InputError(
            f"facts: {name} has eigenvalues so near {target:g} that rounding hides whether they are there: expected "
            "rates, weights and gains within about eight orders of magnitude: bring them closer together"
        )
    away = distances > zero
    nullity = int(np.count_nonzero(singular <= zero))
    residual = max((float(np.abs(shifted @ v).max()) for v in null_vectors), default=0.0) / scale
    if target:
        others, where = float(np.abs(values[away]).max(initial=0.0)), "strictly inside the unit circle"
    else:
        others, where = float(values[away].real.min(initial=np.inf)), "strictly in the right half-plane"
    expected, multiplicity = len(null_vectors), int(np.count_nonzero(~away))
    inside = others < 1.0 if target else others > 0.0
    if expected:
        statement = f"exactly {expected} eigenvalue{'s' * (expected > 1)} at {target:g}, all others {where}"
    else:
        statement = f"all eigenvalues {where}"
    holds = inside and multiplicity == nullity == expected and residual <= 1e-9
    return Fact(name, statement, holds, target, expected, multiplicity, nullity, others, residual)
