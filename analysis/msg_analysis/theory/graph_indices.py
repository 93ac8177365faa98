# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Indices of single graphs, for comparison, and bounds of the system error that hold for all switching rates.

The errors and certainties themselves are properties of ``prediction.Moments``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.experiment.graphs import Graph, hops
from msg_analysis.theory import jump_system as systems
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.moments import MomentSolver

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
        return Bounds.none("they belong to the law without noise on the air, loss or delay")
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
