"""Numbers of the page about the examples, by direct solutions that share no code with the package."""

import networkx as nx
import numpy as np
import pytest
from pages import EXPERIMENTS, ROOT
from scipy.sparse.linalg import LinearOperator, cg

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory.prediction import predict


def test_hundred_agents() -> None:
    """Z_i C_i + C_i Z_i - sum_j Gamma_ji C_j = pi_i Q as it is, by conjugate gradients: all of it is symmetric."""
    m, rate = 100, 0.5
    grids = [nx.grid_2d_graph(10, 10), nx.grid_2d_graph(2, 50)]
    laplacians = [nx.laplacian_matrix(grid, nodelist=sorted(grid)).toarray() for grid in grids]

    def apply(vector: np.ndarray) -> np.ndarray:
        parts = vector.reshape(2, m, m)
        leaving = rate * (parts - parts[::-1])
        return np.ravel([z @ c + c @ z for z, c in zip(laplacians, parts, strict=True)] + leaving)

    wanted = np.tile(0.5 * (np.eye(m) - 1.0 / m).ravel(), 2)
    solved, failed = cg(LinearOperator((2 * m * m, 2 * m * m), matvec=apply), wanted, rtol=1e-10)
    assert failed == 0
    errors = np.diag(solved.reshape(2, m, m).sum(axis=0))
    prediction = predict(Experiment.load(EXPERIMENTS / "hundred_agents.yaml"))
    np.testing.assert_allclose(prediction.continuous.node_errors, errors, rtol=1e-6)


@pytest.mark.parametrize("name", ["slow_switching", "fast_switching"])
def test_formula_of_slow_and_fast_switching(name: str) -> None:
    """35/12 + 8/(3 q) stands on the page: the ring of half weights, and the price of waiting."""
    rate = 0.1 if name == "slow_switching" else 10.0
    halved = nx.effective_graph_resistance(nx.cycle_graph(6), weight=None) / (2 * 6) * 2
    prediction = predict(Experiment.load(EXPERIMENTS / f"{name}.yaml"))
    assert prediction.continuous.system_error == pytest.approx(halved + 8 / (3 * rate), rel=1e-12)
    assert halved == pytest.approx(35 / 12)


def test_every_example_stands_on_the_page() -> None:
    text = (ROOT / "docs/examples.md").read_text(encoding="utf-8")
    assert [file.stem for file in EXPERIMENTS.glob("*.yaml") if f"`{file.stem}`" not in text] == []
