"""Experiments for tests of the theory: the line and the ring, and random graphs under random chains."""

import numpy as np

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory.moments import MomentSolver

LINE_RING = {
    "name": "line_ring",
    "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
    "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
    "noise": {"process": 1.0},
    "run": {"dt": 0.05, "duration": 10},
}


def network(seed, m, n, *, time="continuous", problem="consensus", directed=True, **run):
    random = np.random.default_rng(seed)
    graphs = {}
    for i in range(n):
        links = [[a, a + 1, float(random.uniform(0.3, 1.5))] for a in range(1, m)]
        if directed:
            links += [[m, 1, float(random.uniform(0.3, 1.5))]] if m > 2 else []
        graphs[f"g{i}"] = {"arcs" if directed else "edges": links}
    chain = random.uniform(0.1, 1.0, (n, n))
    if time == "continuous":
        np.fill_diagonal(chain, 0.0)
        switching = {"generator": (chain - np.diag(chain.sum(axis=1))).tolist()}
    else:
        switching = {"transition": (chain / chain.sum(axis=1, keepdims=True)).tolist()}
    document = {
        "name": "random",
        "problem": problem,
        "time": time,
        "agents": m,
        "graphs": graphs,
        "switching": switching | {"initial": "g0"},
        "noise": {"process": random.standard_normal((m, m)).tolist()},
        "run": ({"dt": 0.05, "duration": 5} if time == "continuous" else {"duration": 10}) | run,
    }
    if problem == "tracking":
        document["leaders"] = {"agents": [1], "gain": 0.8, "reference": 2.0}
    return Experiment.parse(document)


def steady_of(system):
    return MomentSolver(system).steady()
