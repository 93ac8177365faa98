# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Two graphs: the error as the static baseline minus what switching gains, in closed form.

Propositions 4 and 5 of the paper, and its remark on discrete time; docs/theory.md, "Two graphs in closed form".
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.solvers import mode_operators

MAX_UNKNOWNS = 2000  # largest p = d (d + 1) / 2 for which the p x p matrices are built: about 60 agents


@dataclass(frozen=True, slots=True, eq=False)
class TwoTopology:
    """Error = static baseline + switching term, for every agent and for all of them."""

    rate: float  # beta = q_12 + q_21 [1 / unit of time], or P_12 + P_21
    static: FloatArray  # (m,) pi-weighted mean of the node errors of the two graphs held fixed
    switching: FloatArray  # (m,) what switching adds to them; negative where it helps
    # (m,) limit of ``switching`` for beta to infinity (continuous time), or its value at beta = 1, where the graphs of
    # successive steps are independent (discrete time).
    fast: FloatArray

    @property
    def node_errors(self) -> FloatArray:
        """(m,) E_i."""
        return self.static + self.switching

    @property
    def system_error(self) -> float:
        """E."""
        return float(self.node_errors.sum())

    def to_json(self) -> dict[str, Any]:
        """The document: of the system and of every node."""
        parts = {"static": self.static, "switching": self.switching, "error": self.node_errors, "fast": self.fast}
        return {
            "rate": self.rate,
            "system": {key: float(values.sum()) for key, values in parts.items()},
            "nodes": {key: values.tolist() for key, values in parts.items()},
        }


def two_topology(system: JumpSystem) -> TwoTopology:
    """Closed form of the steady node errors under two graphs, each of which has a steady error of its own.

    With packed symmetric matrices, S_i the operator C -> Z_i C + C Z_i^T, s_i = S_i^-1 Q_i the moments of graph i held
    fixed, and h the packed quadratic form of the error (trace, or one diagonal entry):

        E = E_static - pi_1 pi_2 h (S_2^-1 - S_1^-1) (I / beta + Omega)^-1 (s_2 - s_1)
        Omega = pi_2 S_1^-1 + pi_1 S_2^-1,    beta = q_12 + q_21

    These are Propositions 4 and 5 of the paper, with pi_1 pi_2 (I / beta + Omega)^-1 for alpha (I + beta Omega)^-1,
    which is the same without overflow, and right for every beta > 0. In discrete time, with S_i: C -> C - K_i[C] and
    beta = P_12 + P_21, Omega - I takes the place of Omega. The differences are computed from S_2 - S_1, without
    cancellation. InputError: not two graphs, too many agents, or a graph without a steady error of its own.
    """
    if system.modes != 2:
        raise InputError(f"two-topology form: {system.modes} graphs, expected 2: use predict")
    p = packed_symmetric.size(system.dimension)
    if p > MAX_UNKNOWNS:
        raise InputError(
            f"two-topology form: {len(system.output)} agents give {p} x {p} matrices, expected at most "
            f"{MAX_UNKNOWNS}: use predict, which needs none"
        )
    discrete = system.time == "discrete"
    one, two = mode_operators(system)
    first, second = _factors(one, 1), _factors(two, 2)
    step = one - two
    weight_1, weight_2 = system.stationary
    rate = float(system.chain[0, 1] + system.chain[1, 0])
    noise = packed_symmetric.pack(system.noise)
    forms = packed_symmetric.pack(system.output[:, :, None] * system.output[:, None, :])

    held_2 = scipy.linalg.lu_solve(second, noise[1])
    held_1 = scipy.linalg.lu_solve(first, noise[0])
    apart = scipy.linalg.lu_solve(first, step @ held_2 + noise[1] - noise[0])  # s_2 - s_1
    seen_2 = scipy.linalg.lu_solve(second, forms.T, trans=1)
    seen_apart = scipy.linalg.lu_solve(first, step.T @ seen_2, trans=1)  # (S_2^-1 - S_1^-1)^T h
    omega = weight_2 * scipy.linalg.lu_solve(first, np.eye(p)) + weight_1 * scipy.linalg.lu_solve(second, np.eye(p))
    if discrete:
        omega -= np.eye(p)

    def gained(inverse_rate: float) -> FloatArray:
        inner = np.linalg.solve(omega + inverse_rate * np.eye(p), apart)
        return np.asarray(-weight_1 * weight_2 * (seen_apart.T @ inner))

    return TwoTopology(
        rate=rate,
        static=np.asarray(forms @ (weight_1 * held_1 + weight_2 * held_2)),
        switching=gained(1.0 / rate),
        fast=gained(1.0 if discrete else 0.0),
    )


def _factors(operator: FloatArray, graph: int) -> tuple[FloatArray, Any]:
    """LU factors of S_i, which must be regular."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)  # the condition is judged below
        factors = scipy.linalg.lu_factor(operator)
    reciprocal, _ = scipy.linalg.lapack.dgecon(factors[0], np.linalg.norm(operator, 1))
    if not reciprocal > 1e-13:
        raise InputError(
            f"two-topology form: graph {graph} held fixed has no steady error (reciprocal condition "
            f"{reciprocal:.1e}), expected graphs that each connect all agents: use predict"
        )
    return factors
