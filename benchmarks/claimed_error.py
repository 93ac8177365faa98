"""How the solver's claimed error compares with the true one: the table of docs/accuracy.md.

Random networks with weights and rates over many orders of magnitude, solved in 80 digits from the numbers of the file.
Prints Markdown; takes about three minutes on one core.
"""

from __future__ import annotations

import argparse
import itertools
from typing import Any

import mpmath
import numpy as np
from threadpoolctl import threadpool_limits

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.step_model import build_step_model
from msg_analysis.theory import jump_system
from msg_analysis.theory.moments import MomentSolver

DIGITS = 80
DECADES = (2, 6, 12)


def random_experiment(seed: int, decades: float, *, steps: bool) -> Experiment:
    """3 or 4 agents, 2 or 3 graphs, directed or not; weights and rates are log-uniform over so many decades.

    With ``steps``, dt is log-uniform from 1e-4 to 1 times half the length at which an agent overshoots. InputError
    where the graphs do not connect the agents.
    """
    random = np.random.default_rng(seed)
    agents, graphs = int(random.integers(3, 5)), int(random.integers(2, 4))

    def size() -> float:
        return float(10.0 ** random.uniform(-decades / 2, decades / 2))

    drawn: dict[str, Any] = {}
    for number in range(graphs):
        kind = "edges" if random.random() < 0.5 else "arcs"
        pairs = itertools.permutations(range(1, agents + 1), 2)
        chosen = [(i, j) for i, j in pairs if (kind == "arcs" or i < j) and random.random() < 0.6]
        drawn[f"graph_{number}"] = {kind: [[i, j, size()] for i, j in chosen]}
    rates = np.array([[size() for _ in range(graphs)] for _ in range(graphs)])
    np.fill_diagonal(rates, 0.0)
    document = {
        "name": "extreme",
        "agents": agents,
        "graphs": drawn,
        "switching": {"generator": (rates - np.diag(rates.sum(axis=1))).tolist()},
        "noise": {"process": [float(10.0 ** random.uniform(-1, 1)) for _ in range(agents)]},
        "run": {"dt": 1e-12, "duration": 1e-9},
    }
    if random.random() < 0.4:
        leader = {"agents": [int(random.integers(1, agents + 1))], "gain": size()}
        document |= {"problem": "tracking", "leaders": leader}
    experiment = Experiment.parse(document)
    if not steps:
        return experiment
    pull = max((g.adjacency.sum(axis=1) + experiment.leader_gains).max() for g in experiment.graph_list)
    dt = float(0.5 / pull * 10.0 ** random.uniform(-4.0, 0.0))
    return Experiment.parse(document | {"run": {"dt": dt, "duration": 1000 * dt}})


def exact(experiment: Experiment, *, steps: bool) -> FloatArray:
    """(m,) node errors of the continuous law, or of the steps, from the weights, rates and noise of the file."""
    with mpmath.workdps(DIGITS):
        m, n = experiment.agents, experiment.chain.modes
        basis = mpmath.eye(m)
        if experiment.problem == "consensus":
            rows = [[1] * k + [-k] + [0] * (m - k - 1) for k in range(1, m)]
            basis = mpmath.matrix([[x / mpmath.sqrt(k * k + k) for x in row] for k, row in enumerate(rows, 1)])
        d = basis.rows
        drift, noise = [], []
        for graph, gain in zip(experiment.graph_list, experiment.noise_gain, strict=True):
            weights = mpmath.matrix(graph.adjacency.tolist())
            pulls = [sum(weights[i, j] for j in range(m)) + float(experiment.leader_gains[i]) for i in range(m)]
            drift.append(basis * (mpmath.diag(pulls) - weights) * basis.T)
            noise.append(basis * mpmath.matrix(gain.tolist()) * mpmath.matrix(gain.tolist()).T * basis.T)
        chain = mpmath.matrix(experiment.chain.matrix.tolist())
        for i in range(n):
            chain[i, i] = -sum(chain[i, j] for j in range(n) if j != i)
        balance = chain.T.copy()
        for j in range(n):
            balance[n - 1, j] = 1
        law = mpmath.lu_solve(balance, mpmath.matrix([0] * (n - 1) + [1]))
        # sum_j flow[j, i] (C_j after a step of graph j), and what the noise adds to it
        matrix, right = mpmath.zeros(n * d * d), mpmath.zeros(n * d * d, 1)
        dt = mpmath.mpf(experiment.run.dt) if steps else 0
        flow = mpmath.expm(chain * dt) if steps else mpmath.eye(n)
        moved = [mpmath.eye(d) - dt * z for z in drift]
        for i, a, b in itertools.product(range(n), range(d), range(d)):
            row = (i * d + a) * d + b
            if not steps:
                right[row] = law[i] * noise[i][a, b]
                for c in range(d):
                    matrix[row, (i * d + c) * d + b] += drift[i][a, c]
                    matrix[row, (i * d + a) * d + c] += drift[i][b, c]
                for j in range(n):
                    matrix[row, (j * d + a) * d + b] -= chain[j, i]
                continue
            matrix[row, row] += 1
            for j in range(n):
                right[row] += flow[j, i] * law[j] * dt * noise[j][a, b]
                for c, e in itertools.product(range(d), range(d)):
                    matrix[row, (j * d + c) * d + e] -= flow[j, i] * moved[j][a, c] * moved[j][b, e]
        solution = mpmath.lu_solve(matrix, right)
        total = mpmath.matrix(d, d)
        for i, a, b in itertools.product(range(n), range(d), range(d)):
            total[a, b] += solution[(i * d + a) * d + b]
        return np.array([float(x) for x in np.diag(np.array((basis.T * total * basis).tolist()))])


def errors(experiment: Experiment, *, steps: bool) -> tuple[float, float]:
    """(true, claimed) relative error, the true one of the node errors over the largest; InputError: refused."""
    law = jump_system.emulated(build_step_model(experiment), experiment.problem) if steps else None
    system = law or jump_system.continuous(experiment)
    solver = MomentSolver(system)
    measured = np.diag(system.lifted(solver.steady().sum(axis=0)))
    oracle = exact(experiment, steps=steps)
    assert solver.report is not None
    return float(np.abs(measured - oracle).max() / oracle.max()), solver.report.error


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--networks", type=int, default=150, help="of each kind; 150 by default")
    arguments = parser.parse_args()
    print("| law | decades | solved | refused | largest true error | true > claimed | > 10 x | median claimed / true |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    for steps, decades in itertools.product((False, True), DECADES):
        found, refused = [], 0
        for seed in range(arguments.networks):
            try:
                experiment = random_experiment(seed, decades, steps=steps)
            except InputError:
                continue
            try:
                with threadpool_limits(1):
                    found.append(errors(experiment, steps=steps))
            except InputError:
                refused += 1
        true, claimed = np.array(found).T
        above = int((true > claimed).sum()), int((true > 10.0 * claimed).sum())
        ratio = float(np.median(claimed / np.maximum(true, np.finfo(float).eps)))
        print(
            f"| {'steps' if steps else 'continuous'} | {decades} | {len(found)} | {refused} | {true.max():.1e} | "
            f"{above[0]} | {above[1]} | {ratio:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
