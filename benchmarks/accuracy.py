"""How accurate the predicted second moments are, and how long they take: the table of docs/accuracy.md.

Every row compares the solver with another route to the same numbers: the paper's formulas in full Kronecker form,
which share the experiment's graphs and chain with the solver and nothing else; the same in 60 digits at extreme rates
and gains; resistances from networkx; certainties printed in the paper. The last column is the largest difference
between two covariances (or numbers), over their largest entry. Prints Markdown; takes a few seconds on one core.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import mpmath
import networkx as nx
import numpy as np
import scipy.linalg
from threadpoolctl import threadpool_limits

from msg_analysis.common.arrays import FloatArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory.jump_system import continuous
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.prediction import predict

Result = TypeVar("Result")

PAPER = {(1.0, 1.0): 0.73561, (0.1, 1.0): 0.53439, (1.0, 0.1): 0.94031}
"""System certainty of example 1 by the rates line -> ring and ring -> line, times 0.5; to five digits."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    case: str
    oracle: str
    seconds: float
    oracle_seconds: float | None
    difference: float


def random_experiment(seed: int, agents: int, graphs: int, *, rate: float = 1.0, dt: float = 0.02) -> Experiment:
    """Connected random graphs with random weights, correlated noise, and rates of about the given size."""
    random = np.random.default_rng(seed)
    documents = {}
    for mode in range(graphs):
        links = [[i, i + 1, float(random.uniform(0.2, 1.5))] for i in range(1, agents)]
        links += [
            [i, j, float(random.uniform(0.2, 1.5))]
            for i in range(1, agents + 1)
            for j in range(i + 2, agents + 1)
            if random.random() < 2.0 / agents
        ]
        documents[f"graph_{mode + 1}"] = {"edges": links}
    switching = {}
    if graphs > 1:
        rates = random.uniform(0.2, 2.0, (graphs, graphs)) * rate
        np.fill_diagonal(rates, 0.0)
        switching = {"generator": (rates - np.diag(rates.sum(axis=1))).tolist()}
    return Experiment.parse(
        {
            "name": "accuracy",
            "graphs": documents,
            "switching": switching,
            "noise": {"process": random.standard_normal((agents, agents)).tolist()},
            "run": {"dt": dt, "duration": 1000 * dt},
        }
    )


def kronecker_continuous(experiment: Experiment) -> FloatArray:
    """(m, m) covariance by the paper's steady-state formula as printed, its n m^2 matrix inverted by pinv."""
    m, n, chain = experiment.agents, experiment.chain.modes, experiment.chain
    projector, eye = np.eye(m) - 1 / m, np.eye(m)
    laplacians = [projector @ graph.laplacian @ projector for graph in experiment.graph_list]
    matrix = scipy.linalg.block_diag(*[np.kron(z, eye) + np.kron(eye, z) for z in laplacians])
    matrix -= np.kron(chain.matrix.T, np.kron(projector, projector))
    gain = experiment.noise_gain[0]
    noise = projector @ gain @ gain.T @ projector
    right = np.concatenate([share * noise.ravel() for share in chain.stationary])
    solution = np.linalg.pinv(matrix, rcond=1e-11) @ right
    return np.asarray(solution.reshape(n, m, m).sum(axis=0))


def kronecker_emulated(experiment: Experiment) -> FloatArray:
    """(m, m) covariance of the run's Euler steps by the unreduced discrete equations."""
    m, n, dt = experiment.agents, experiment.chain.modes, experiment.step_length
    projector = np.eye(m) - 1 / m
    steps = [projector @ (np.eye(m) - dt * graph.laplacian) for graph in experiment.graph_list]
    transition = scipy.linalg.expm(experiment.chain.matrix * dt)
    gain = experiment.noise_gain[0]
    noise = (dt * projector @ gain @ gain.T @ projector).ravel()
    share = experiment.chain.stationary
    matrix = np.eye(n * m * m)
    right = np.zeros((n, m * m))
    for j, step in enumerate(steps):
        operator = np.kron(step, step)
        for i in range(n):
            matrix[i * m * m : (i + 1) * m * m, j * m * m : (j + 1) * m * m] -= transition[j, i] * operator
            right[i] += transition[j, i] * share[j] * noise
    return np.asarray(np.linalg.solve(matrix, right.ravel()).reshape(n, m, m).sum(axis=0))


def timed(function: Callable[[Experiment], Result], experiment: Experiment) -> tuple[Result, float]:
    """What a function says about an experiment, and the seconds that it took."""
    began = time.perf_counter()
    result = function(experiment)
    return result, time.perf_counter() - began


def difference(measured: FloatArray, oracle: FloatArray) -> float:
    """Largest difference over the largest entry."""
    return float(np.abs(measured - oracle).max() / np.abs(oracle).max())


def brute_force(largest: int) -> Iterator[Row]:
    """Random networks against the Kronecker forms."""
    for agents, graphs, rate in ((5, 2, 1.0), (10, 3, 1.0), (10, 3, 1e-4), (10, 3, 1e4), (20, 3, 1.0)):
        if agents > largest:
            continue
        experiment = random_experiment(agents, agents, graphs, rate=rate)
        prediction, seconds = timed(predict, experiment)
        case = f"{agents} agents, {graphs} graphs, rates ~ {rate:g}"
        paper, paper_seconds = timed(kronecker_continuous, experiment)
        steps, steps_seconds = timed(kronecker_emulated, experiment)
        error = difference(prediction.continuous.covariance, paper)
        yield Row(f"{case}, continuous", "the paper's formula, pinv", seconds, paper_seconds, error)
        error = difference(prediction.emulated.covariance, steps)
        yield Row(f"{case}, steps", "unreduced discrete equations", seconds, steps_seconds, error)


def resistances() -> Iterator[Row]:
    """One graph and unit noise: E is the Kirchhoff index over 2 m."""
    for name, graph in (
        ("path of 30", nx.path_graph(30)),
        ("ring of 30", nx.cycle_graph(30)),
        ("star of 30", nx.star_graph(29)),
        ("grid of 5 x 6", nx.convert_node_labels_to_integers(nx.grid_2d_graph(5, 6))),
    ):
        links = [[i + 1, j + 1] for i, j in graph.edges]
        experiment = Experiment.parse({"name": "one", "graphs": {"g": {"edges": links}}, "run": {"dt": 0.01}})
        prediction, seconds = timed(predict, experiment)
        kirchhoff = nx.effective_graph_resistance(graph) / (2 * len(graph))
        error = difference(np.array([prediction.continuous.system_error]), np.array([kirchhoff]))
        yield Row(f"one graph, {name}: E", "networkx, resistance", seconds, None, error)


PIECES = {"first": {"edges": [[1, 2], [3, 4]]}, "second": {"edges": [[2, 3]]}}
LINE_RING = {"first": {"path": [1, 2, 3, 4]}, "second": {"cycle": [1, 2, 3, 4]}}


def sixty_digits(experiment: Experiment) -> FloatArray:
    """(m, m) covariance in continuous time by the Kronecker form in a Helmert basis, all in 60 digits; F = I."""
    with mpmath.workdps(60):
        m, n = experiment.agents, experiment.chain.modes
        gains = [float(gain) for gain in experiment.leader_gains]
        basis = mpmath.eye(m)
        if not any(gains):
            rows = [[1] * k + [-k] + [0] * (m - k - 1) for k in range(1, m)]
            basis = mpmath.matrix([[x / mpmath.sqrt(k * k + k) for x in row] for k, row in enumerate(rows, 1)])
        d = basis.rows
        z = [basis * (mpmath.matrix(g.laplacian) + mpmath.diag(gains)) * basis.T for g in experiment.graph_list]
        chain = mpmath.matrix(experiment.chain.matrix)
        for i in range(n):
            chain[i, i] = -sum(chain[i, j] for j in range(n) if j != i)
        balance = chain.T.copy()
        for j in range(n):
            balance[n - 1, j] = 1
        law = mpmath.lu_solve(balance, mpmath.matrix([0] * (n - 1) + [1]))
        matrix, right = mpmath.zeros(n * d * d), mpmath.zeros(n * d * d, 1)
        for i, a, b in itertools.product(range(n), range(d), range(d)):
            row = (i * d + a) * d + b
            right[row] = law[i] * (a == b)
            for c in range(d):
                matrix[row, (i * d + c) * d + b] += z[i][a, c]
                matrix[row, (i * d + a) * d + c] += z[i][b, c]
            for j in range(n):
                matrix[row, (j * d + a) * d + b] -= chain[j, i]
        solution = mpmath.lu_solve(matrix, right)
        total = mpmath.matrix(d, d)
        for i, a, b in itertools.product(range(n), range(d), range(d)):
            total[a, b] += solution[(i * d + a) * d + b]
        return np.array((basis.T * total * basis).tolist(), dtype=float)


def extremes() -> Iterator[Row]:
    """Rates and gains over eighteen orders of magnitude; time is that of one solve."""
    cases = (("line and ring of 4", LINE_RING, 1e-8), ("two graphs in pieces, union connected", PIECES, 1e-5))
    for name, graphs, slowest in cases:  # graphs in pieces that switch more seldom are refused
        for rate in (slowest, 1e-4, 1.0, 1e4, 1e6, 1e10):
            yield extreme(f"{name}, rates {rate:g} and {rate / 1000:g}", {"graphs": graphs}, rate)
        for gain in (1e-3, 1e6) if graphs is LINE_RING else (1e-3,):  # with 1e6, graphs in pieces are refused
            leaders = {"problem": "tracking", "leaders": {"agents": [2], "gain": gain}}
            yield extreme(f"{name}, leader's gain {gain:g}", {"graphs": graphs, **leaders}, 1.0)


def extreme(case: str, document: dict[str, Any], rate: float) -> Row:
    """One of them."""
    generator = [[-rate, rate], [rate / 1000, -rate / 1000]]
    experiment = Experiment.parse(
        {"name": "extreme", "agents": 4, "switching": {"generator": generator}, "run": {"dt": 1e-7, "duration": 1e-4}}
        | document
    )
    system = continuous(experiment)
    measured, seconds = timed(lambda _: system.lifted(MomentSolver(system).steady().sum(axis=0)), experiment)
    exact, exact_seconds = timed(sixty_digits, experiment)
    return Row(case, "60 digits (mpmath)", seconds, exact_seconds, difference(measured, exact))


def printed() -> Iterator[Row]:
    """Example 1 of the paper: as good as its five digits."""
    for (forth, back), certainty in PAPER.items():
        experiment = Experiment.parse(
            {
                "name": "example_1",
                "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
                "switching": {"rates": {"line": {"ring": forth}, "ring": {"line": back}}, "scale": 0.5},
            }
        )
        prediction, seconds = timed(predict, experiment)
        error = difference(np.array([1.0 / prediction.continuous.system_error]), np.array([certainty]))
        yield Row(f"example 1, rates {forth:g} and {back:g}: 1/E", "the paper, 5 digits", seconds, None, error)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--largest", type=int, default=20, help="agents of the largest brute-force case")
    arguments = parser.parse_args()
    print("| case | compared with | solver [s] | other [s] | relative difference |")
    print("|---|---|---:|---:|---:|")
    with threadpool_limits(1):
        for rows in (brute_force(arguments.largest), extremes(), resistances(), printed()):
            for row in rows:
                other = "" if row.oracle_seconds is None else f"{row.oracle_seconds:.3g}"
                print(
                    f"| {row.case} | {row.oracle} | {row.seconds:.3g} | {other} | {row.difference:.1e} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
