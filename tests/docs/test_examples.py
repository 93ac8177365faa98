"""The examples' predictions, by direct solutions of the equations that share no code with the package."""

from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest
import scipy.linalg
import yaml
from pages import EXPERIMENTS, ROOT
from scipy.sparse.linalg import LinearOperator, cg

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory.prediction import predict

SMALL = sorted(EXPERIMENTS.glob("*.yaml"))
SMALL = [file for file in SMALL if file.stem not in {"hundred_agents", "line_ring_realtime"}]


def links(given: dict[str, Any]) -> list[tuple[int, int, float]]:
    """Edges of a graph of an example, agents from 0."""
    ((kind, value),) = given.items()
    if kind == "edges":
        return [(edge[0] - 1, edge[1] - 1, edge[2] if len(edge) > 2 else 1.0) for edge in value]
    if kind == "grid":
        rows, columns = value
        grid = nx.grid_2d_graph(rows, columns)
        return [(a[0] * columns + a[1], b[0] * columns + b[1], 1.0) for a, b in grid.edges]
    if kind == "complete":
        return [(a, b, 1.0) for a in range(4) for b in range(a)]
    if kind == "star":
        return [(value["center"] - 1, b, 1.0) for b in range(4) if b != value["center"] - 1]
    nodes = [node - 1 for node in value]
    return [(a, b, 1.0) for a, b in zip(nodes, nodes[1:] + nodes[:1] * (kind == "cycle"), strict=kind == "cycle")]


def laplacian(edges: list[tuple[int, int, float]], m: int) -> np.ndarray:
    result = np.zeros((m, m))
    for a, b, weight in edges:
        difference = np.zeros(m)
        difference[[a, b]] = 1.0, -1.0
        result += weight * np.outer(difference, difference)
    return result


def generator(switching: dict[str, Any], names: list[str]) -> np.ndarray:
    if "generator" in switching:
        return np.array(switching["generator"])
    rates = np.array([[switching["rates"].get(a, {}).get(b, 0.0) for b in names] for a in names])
    rates *= switching.get("scale", 1.0)
    return rates - np.diag(rates.sum(axis=1))


class Example:
    """Matrices of an example, straight from its file."""

    def __init__(self, file: Path) -> None:
        document = yaml.safe_load(file.read_text(encoding="utf-8"))
        names, noise = list(document["graphs"]), document["noise"]
        edges = [links(document["graphs"][name]) for name in names]
        self.m = m = 1 + max(max(a, b) for graph in edges for a, b, _ in graph)
        self.discrete = document["time"] == "discrete"
        self.graphs = [laplacian(graph, m) for graph in edges]
        self.noise = np.diag(np.broadcast_to(np.square(noise["process"]), m).astype(float))
        self.loss, self.link = noise.get("loss", 0.0), noise.get("link", 0.0)
        self.chain = None if self.discrete else generator(document["switching"], names)
        step = 1.0 if self.discrete else document["run"]["dt"]
        self.step = step
        self.jumps = np.array(document["switching"]["transition"]) if self.discrete else scipy.linalg.expm(
            self.chain * step
        )  # fmt: skip
        values, vectors = np.linalg.eig(self.jumps.T)
        law = np.real(vectors[:, np.argmax(values.real)])
        self.law = law / law.sum()
        if "leaders" in document:
            leaders = np.array(document["leaders"]["agents"]) - 1
            gain = float(document["leaders"]["gain"])
            if gain == float("inf"):
                self.basis = np.delete(np.eye(m), leaders, axis=0)
            else:
                self.basis = np.eye(m)
                for graph in self.graphs:
                    graph[leaders, leaders] += gain
        else:
            self.basis = scipy.linalg.null_space(np.ones((1, m))).T

    def project(self, matrix: np.ndarray) -> np.ndarray:
        return self.basis @ matrix @ self.basis.T

    def errors(self, stacked: np.ndarray) -> np.ndarray:
        d = len(self.basis)
        return np.diag(self.basis.T @ stacked.reshape(-1, d, d).sum(axis=0) @ self.basis)

    def continuous(self) -> np.ndarray:
        """Z_i C_i + C_i Z_i' - sum_j Gamma_ji C_j = pi_i Q, one unknown for every number."""
        drifts = [self.project(graph) for graph in self.graphs]
        identity = np.eye(len(self.basis))
        matrix = scipy.linalg.block_diag(*(np.kron(z, identity) + np.kron(identity, z) for z in drifts))
        matrix -= np.kron(self.chain.T, np.eye(len(self.basis) ** 2))
        return self.errors(np.linalg.solve(matrix, np.kron(self.law, self.project(self.noise).ravel())))

    def steps(self) -> np.ndarray:
        """C_i = sum_j P_ji (K_j[C_j] + pi_j N_j), likewise; every lost message changes K, link noise changes N."""
        operators, noises = [], []
        for graph in self.graphs:
            full = scipy.linalg.expm(-graph) if self.discrete else np.eye(self.m) - self.step * graph
            kept, squares = 1.0 - self.loss, np.zeros((self.m, self.m))
            mean, spread = np.eye(self.m) - kept * (np.eye(self.m) - full), 0.0
            for a in range(self.m):
                for b in range(self.m):
                    if a != b and full[a, b]:
                        one = np.zeros((self.m, self.m))
                        one[a, a], one[a, b] = -full[a, b], full[a, b]
                        spread += self.loss * kept * np.kron(self.project(one), self.project(one))
                        squares[a, a] += full[a, b] ** 2
            operators.append(np.kron(self.project(mean), self.project(mean)) + spread)
            amount = self.noise * self.step + kept * self.link**2 * squares
            noises.append(self.project(amount).ravel())
        size = len(self.basis) ** 2
        matrix = np.eye(len(self.law) * size) - np.kron(self.jumps.T, np.eye(size)) @ scipy.linalg.block_diag(
            *operators
        )
        weighted = np.concatenate([share * noise for share, noise in zip(self.law, noises, strict=True)])
        return self.errors(np.linalg.solve(matrix, np.kron(self.jumps.T, np.eye(size)) @ weighted))


@pytest.mark.parametrize("file", SMALL, ids=lambda file: file.stem)
def test_predictions(file: Path) -> None:
    example, prediction = Example(file), predict(Experiment.load(file))
    np.testing.assert_allclose(prediction.emulated.node_errors, example.steps(), rtol=1e-9, atol=1e-15)
    assert (prediction.continuous_moments is None) == bool(example.discrete or example.loss)
    given, wanted = [], []
    if prediction.continuous_moments is not None:
        given, wanted = prediction.continuous.node_errors, example.continuous()
    np.testing.assert_allclose(given, wanted, rtol=1e-9, atol=1e-15)


def test_hundred_agents() -> None:
    """By conjugate gradients on the equations as they are; the graphs are symmetric, and so is their chain."""
    file = EXPERIMENTS / "hundred_agents.yaml"
    example, prediction = Example(file), predict(Experiment.load(file))
    m, chain = example.m, example.chain
    centre = np.eye(m) - 1.0 / m

    def apply(vector: np.ndarray) -> np.ndarray:
        parts = vector.reshape(2, m, m)
        coupled = np.einsum("ji,jab->iab", chain, parts)
        return np.array([z @ c + c @ z for z, c in zip(example.graphs, parts, strict=True)]).ravel() - coupled.ravel()

    wanted = np.concatenate([share * centre.ravel() for share in example.law])
    solved, failed = cg(LinearOperator((2 * m * m, 2 * m * m), matvec=apply), wanted, rtol=1e-10)
    assert failed == 0
    errors = np.diag(solved.reshape(2, m, m).sum(axis=0))
    np.testing.assert_allclose(prediction.continuous.node_errors, errors, rtol=1e-6)


@pytest.mark.parametrize("name", ["slow_switching", "fast_switching"])
def test_formula_of_slow_and_fast_switching(name: str) -> None:
    """35/12 + 8/(3 q) stands on the page: the ring of half weights, and the price of waiting."""
    file = EXPERIMENTS / f"{name}.yaml"
    rate = 0.1 if name == "slow_switching" else 10.0
    ring = nx.cycle_graph(6)
    halved = nx.effective_graph_resistance(ring, weight=None) / (2 * 6) * 2
    prediction = predict(Experiment.load(file))
    assert prediction.continuous.system_error == pytest.approx(halved + 8 / (3 * rate), rel=1e-12)
    assert halved == pytest.approx(35 / 12)


def test_every_example_stands_on_the_page() -> None:
    text = (ROOT / "docs/examples.md").read_text(encoding="utf-8")
    assert [file.stem for file in EXPERIMENTS.glob("*.yaml") if f"`{file.stem}`" not in text] == []
