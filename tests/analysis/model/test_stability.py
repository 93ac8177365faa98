"""The largest stable step, against powers of the step."""

from __future__ import annotations

import math

import numpy as np
import pytest

from msg_analysis.common.arrays import FloatArray
from msg_analysis.experiment import validation
from msg_analysis.experiment.graphs import Graph


def contracts(laplacian: FloatArray, dt: float) -> bool:
    """Whether powers of I - dt L keep their size (a stable step) by taking one."""
    step = np.linalg.matrix_power(np.eye(len(laplacian)) - dt * laplacian, 5000)
    return bool(np.abs(step).max() < 10)


@pytest.mark.parametrize("seed", range(8))
def test_stability_limit_against_powers_of_the_step(seed: int) -> None:
    random = np.random.default_rng(seed)
    adjacency = random.uniform(0.2, 2, (5, 5)) * (random.random((5, 5)) < 0.6)
    if seed % 2:
        adjacency = adjacency + adjacency.T
    np.fill_diagonal(adjacency, 0)
    graph = Graph("graph", adjacency)
    limit = validation.stability_limit(graph, np.zeros(5))
    assert contracts(graph.laplacian, 0.99 * limit)
    assert not contracts(graph.laplacian, 1.01 * limit)


def test_stability_limit_of_leaders() -> None:
    star = Graph("star", np.array([[0, 1, 1], [1, 0, 0], [1, 0, 0]], dtype=float))
    gains = np.array([math.inf, 0, 0])
    assert validation.stability_limit(star, gains) == 2.0  # followers alone: Z = I
    z = star.laplacian + np.diag([4.0, 0, 0])
    assert validation.stability_limit(star, np.array([4.0, 0, 0])) == pytest.approx(2 / np.linalg.eigvalsh(z)[-1])
    assert validation.stability_limit(Graph("none", np.zeros((3, 3))), np.zeros(3)) == math.inf
