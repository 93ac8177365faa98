"""The Markov chain that switches between the graphs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import networkx as nx
import numpy as np
import scipy.linalg

from msg_analysis.types import FloatArray

Time = Literal["continuous", "discrete"]


def stationary_law(matrix: FloatArray) -> FloatArray:
    """Stationary law of an irreducible chain by the GTH algorithm.

    Uses no subtraction, so every entry is accurate to machine precision whatever the rates
    (Grassmann, Taksar, Heyman 1985).

    Parameters
    ----------
    matrix : (n, n) generator (rows sum to 0) or transition matrix (rows sum to 1); only off-diagonal entries are used

    Returns
    -------
    (n,) probabilities
    """
    rates = np.array(matrix, dtype=float)
    n = len(rates)
    for k in range(n - 1, 0, -1):
        rates[:k, k] /= rates[k, :k].sum()
        rates[:k, :k] += np.outer(rates[:k, k], rates[k, :k])
    law = np.ones(n)
    for k in range(1, n):
        law[k] = law[:k] @ rates[:k, k]
    return np.asarray(law / law.sum())


@dataclass(frozen=True, slots=True, eq=False)
class MarkovChain:
    """An ergodic chain on the n graphs.

    Attributes
    ----------
    time : "continuous" (matrix is the generator Gamma [1 / unit of time]) or "discrete" (matrix is P, one jump a step)
    matrix : (n, n)
    """

    time: Time
    matrix: FloatArray

    @property
    def modes(self) -> int:
        """Number of graphs n."""
        return len(self.matrix)

    def _graph(self) -> nx.DiGraph:
        digraph: nx.DiGraph = nx.DiGraph()
        digraph.add_nodes_from(range(self.modes))
        digraph.add_edges_from((int(i), int(j)) for i, j in np.argwhere(self.matrix > 0))
        return digraph

    @property
    def irreducible(self) -> bool:
        """Whether every graph can be reached from every other one."""
        return bool(nx.is_strongly_connected(self._graph()))

    @property
    def ergodic(self) -> bool:
        """Irreducible and, in discrete time, aperiodic (assumption 1 of the paper)."""
        return self.irreducible and (self.time == "continuous" or bool(nx.is_aperiodic(self._graph())))

    @property
    def stationary(self) -> FloatArray:
        """(n,) stationary law pi."""
        return stationary_law(self.matrix)

    def transition(self, dt: float) -> FloatArray:
        """(n, n) law of the graph one step later: expm(Gamma dt), or P itself in discrete time."""
        if self.time == "discrete":
            return self.matrix.copy()
        transition = np.clip(np.asarray(scipy.linalg.expm(self.matrix * dt), dtype=float), 0.0, None)
        return np.asarray(transition / transition.sum(axis=1, keepdims=True))

    def sojourns(self, initial: FloatArray, random: np.random.Generator) -> Iterator[tuple[int, float]]:
        """Exact path of the chain, for ever: (mode from 0, time spent in it).

        Holding times are exponential [units of time] in continuous time, geometric [steps] in discrete time; the
        next graph is drawn from the jump chain.

        Parameters
        ----------
        initial : (n,) law of the first graph
        random : the stream to draw from; equal streams give equal paths
        """
        off_diagonal = self.matrix - np.diag(np.diag(self.matrix))
        leaving = off_diagonal.sum(axis=1)
        mode = _draw(initial, random)
        while True:
            if leaving[mode] == 0.0:
                yield mode, np.inf
                return
            if self.time == "continuous":
                held = random.exponential(1.0 / leaving[mode])
            else:
                held = float(random.geometric(min(leaving[mode], 1.0)))
            yield mode, held
            mode = _draw(off_diagonal[mode] / leaving[mode], random)


def _draw(law: FloatArray, random: np.random.Generator) -> int:
    """Index drawn by inversion from one uniform number."""
    cumulative = np.cumsum(law)
    return int(np.searchsorted(cumulative, random.random() * cumulative[-1], side="right"))
