# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Indices of single graphs, bounds of the system error for all switching rates, and the closed form for two graphs.

The errors and certainties themselves are properties of ``prediction.Moments``.
"""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.experiment.graphs import Graph, hops, widest_reaching
from msg_analysis.theory import jump_system as systems
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.solvers import mode_operators

if TYPE_CHECKING:
    from msg_analysis.theory.prediction import Prediction


@dataclass(frozen=True, slots=True, eq=False)
class GraphIndices:
    """Indices of one undirected connected graph from its resistances r_uv (Klein and Randić 1993), weights 1 / r."""

    name: str
    # Sum of r_uv over pairs, m tr(L^+) (Klein and Randić 1993): 2 m times the system error of the graph with F = I.
    kirchhoff_index: float
    # (m,) 1 / sum_v r_uv, the convention of networkx; Stephenson and Zelen (1989) have m times that.
    information_centrality: FloatArray

    def to_json(self) -> dict[str, Any]:
        """The document of one graph."""
        return asdict(self) | {"information_centrality": self.information_centrality.tolist()}


def algebraic_connectivity(graph: Graph) -> float:
    """Second smallest real part of the Laplacian's eigenvalues, at least 0: the rate of agreement (Fiedler 1973)."""
    leads = graph.adjacency.T > 0
    # Exactly, where rounding would leave a little.
    if graph.parts > 1 or (hops(leads, widest_reaching(leads)[:1]) < 0).any():
        return 0.0
    laplacian = graph.laplacian
    values = np.linalg.eigvalsh(laplacian) if graph.symmetric else np.linalg.eigvals(laplacian)
    return max(float(np.sort(values.real)[1]), 0.0)


def graph_indices(graph: Graph) -> GraphIndices | None:
    """Kirchhoff index and information centrality; None for a directed or disconnected graph.

    From r_uv = L^+_uu + L^+_vv - 2 L^+_uv (Klein and Randić 1993): sum_v r_uv = m L^+_uu + tr(L^+).
    """
    if not graph.symmetric or (hops(graph.adjacency > 0, [0]) < 0).any():
        return None
    m = graph.agents
    helmert = scipy.linalg.helmert(m)
    inverse = helmert.T @ scipy.linalg.solve(helmert @ graph.laplacian @ helmert.T, helmert, assume_a="pos")
    trace = float(np.trace(inverse))
    return GraphIndices(graph.name, m * trace, 1.0 / (m * np.diag(inverse) + trace))


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Bounds of the system error for a given stationary law, whatever the rates (docs/theory.md, "Bounds")."""

    lower: float | None  # error of the averaged graph; None where it is not a bound
    upper: float | None  # static baseline: mean error of the graphs held fixed; None where it is no bound, or infinite
    note: str  # why there are these bounds and no others

    def to_json(self) -> dict[str, Any]:
        """The document."""
        return asdict(self)

    @classmethod
    def none(cls, reason: str) -> Bounds:
        """No bounds."""
        return cls(None, None, f"the averaged graph and the graphs held fixed give no bounds here: {reason}")


def error_bounds(prediction: Prediction) -> Bounds:
    """Bounds of the system error of the paper's law: continuous time, or discrete time with W = exp(-Z).

    For undirected graphs and independent noise of equal variance q for every agent and graph (F = sqrt(q) I), in
    consensus and tracking, and any ergodic chain, with Zbar = sum pi_i Z_i (proof: docs/theory.md, "Bounds"):

        continuous time    q tr(Zbar^-1) / 2 <= E <= E_static         (pseudo-inverse in consensus)
        discrete time                           E <= E_static

    In discrete time the averaged graph gives no lower bound: graphs that alternate can be better than independent
    draws. With unequal or correlated noise, or directed graphs, E can lie outside on both sides.

    Parameters
    ----------
    prediction
        of the experiment
    """
    experiment = prediction.experiment
    if experiment.protocol:
        return Bounds.none("they belong to the built-in law, not to a protocol")
    if experiment.time == "continuous" and prediction.continuous_moments is None:
        return Bounds.none("they belong to the law without noise on the air, loss, delay or activation")
    system = systems.continuous(experiment) if experiment.time == "continuous" else prediction.system
    if not all(graph.symmetric for graph in experiment.graph_list):
        return Bounds.none("a graph is directed")
    if not _equal_noise(system):
        return Bounds.none("the noise is not the same, and independent, for every agent")
    upper = prediction.static.system_error if prediction.static_moments else None
    if system.time == "discrete":
        return Bounds(None, upper, "undirected graphs and equal noise: E is at most that of the graphs held fixed")
    # The limit of infinitely fast switching, averaged over pi.
    averaged = replace(
        system,
        matrices=np.tensordot(system.stationary, system.matrices, axes=1)[None],
        noise=np.tensordot(system.stationary, system.noise, axes=1)[None],
        chain=np.zeros((1, 1)),
        stationary=np.ones(1),
    )
    try:
        lower = float(np.trace(MomentSolver(averaged).steady()[0]))
    except InputError:  # connected, but so weakly that rounding hides it
        lower = None
    note = "undirected graphs and equal noise: E lies between the averaged graph and the graphs held fixed"
    return Bounds(lower, upper, note)


def _equal_noise(system: JumpSystem) -> bool:
    """Whether the noise is equal and independent, in every mode, in all coordinates not held at the reference."""
    scale = float(np.abs(system.noise).max(initial=0.0))
    pinned = (system.matrices == 0.0).all(axis=(0, 1)) & (system.matrices == 0.0).all(axis=(0, 2))
    pinned &= (system.noise == 0.0).all(axis=(0, 1))
    expected = scale * np.diag((~pinned).astype(float))
    return not system.lossy and bool(np.abs(system.noise - expected).max(initial=0.0) <= 1e-12 * scale)


MAX_UNKNOWNS = 2000  # largest p = d (d + 1) / 2 for which the p x p matrices are built: about 60 agents


@dataclass(frozen=True, slots=True, eq=False)
class TwoTopology:
    """Error = static baseline + switching term (Propositions 4 and 5 of the paper), for every agent and for all."""

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
